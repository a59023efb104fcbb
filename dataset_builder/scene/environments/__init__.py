"""Surfaces of the environments in which the steel stands; they import no Blender."""
