"""Builds dataset folders: scenes, cameras, colour, exact ground truth, shards."""
