"""Triangle meshes of bars and plain solids."""
