"""Configs by name, from scene files, and the generated config ``cages``."""
