"""IFC import: the reinforcing bars of a building model as bars and meshes.

``process`` runs the package ``reader``, the only one that uses ifcopenshell, in a process with limits;
``answer`` validates what that process returns.
"""
