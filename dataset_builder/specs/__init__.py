"""Specs of scenes, cameras, colour and user files: plain data."""
