"""Strict readers of PLY, STL and OBJ content, and checks of glTF content before trimesh loads it."""
