"""Strict readers of PLY, STL and OBJ content."""
