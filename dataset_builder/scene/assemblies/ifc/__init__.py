"""IFC import: the reinforcing bars of a building model as bars and meshes."""
