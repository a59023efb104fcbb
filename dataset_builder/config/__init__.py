"""Configs: scenes, camera trajectories, rigs, and the schema of scene files."""
