"""Configs: scenes, camera trajectories, stereo rigs, and the schema of scene files."""
