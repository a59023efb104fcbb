"""Triangle meshes of bars and of simple solids."""
