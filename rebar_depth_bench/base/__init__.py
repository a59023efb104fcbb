"""Errors, validation, files, limits and names that all packages use."""
