"""Cages from users' files: scene TOML, mesh and IFC."""
