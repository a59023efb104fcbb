"""Stereo methods: disparity on a rectified pair, converted to depth."""
