"""Stereo rigs and the places of their cameras."""
