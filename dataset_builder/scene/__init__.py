"""Scenes before rendering: bars, meshes, parts, and the ray caster of the ground truth."""
