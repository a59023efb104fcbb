"""Monocular networks that run through their authors' own packages or code."""
