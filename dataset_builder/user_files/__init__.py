"""Cages from users' files (scene TOML, mesh and IFC), and ``make_assembly`` for all kinds of steel."""
