"""Reader of IFC models, the only package that uses ifcopenshell. It runs in its own process.

``user_files.ifc_file`` starts that process, ``python -m`` this package, with limits, and validates its
answer.
"""
