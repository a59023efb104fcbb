"""Generators of the Markdown cards: those of dataset folders, and the benchmark card."""
