"""Appearance variants of scenes: their names, their props and panoramas, and the camera's sensor."""
