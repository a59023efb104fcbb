"""Crossings of reinforcing bars: their definition on the axes of bars, and their table in a dataset folder."""
