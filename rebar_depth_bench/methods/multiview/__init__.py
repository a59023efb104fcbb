"""Depth from all views of a config: structure from motion, a scale, and dense depth on its cameras."""
