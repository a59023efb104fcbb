"""Assemblies of bars that no file holds."""

from __future__ import annotations

from collections.abc import Sequence

from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.scene.model import Assembly
from dataset_builder.user_files.cage_file import cage_assembly, cage_problems, check_values


def assembly_of(bars: Sequence[CageBar], where: str = "a.ifc") -> Assembly:
    """Return the assembly of bars in the world frame. Raises ``MeshError`` as ``load_cage`` for invalid bars."""
    check_values(bars, where)
    return cage_assembly(Cage(tuple(bars), problems=tuple(cage_problems(bars))), where)
