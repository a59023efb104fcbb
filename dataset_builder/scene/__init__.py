"""Scene geometry independent of Blender: bars, meshes, parts, and the ray caster of the ground truth."""
