"""Generators of the cards of dataset folders, their Croissant description, and the benchmark card."""
