"""Assembly construction: bars and meshes from an assembly spec."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dataset_builder.scene.model import Assembly
from dataset_builder.specs.config_specs import (
    AssemblySpec,
    GeneratedCageSpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
)
from rebar_depth_bench.data.bars import Bar

if TYPE_CHECKING:
    from dataset_builder.scene.assemblies.cage import Cage


def make_assembly(spec: AssemblySpec, cage: Cage | None = None) -> Assembly:
    """Return the bars and meshes of an assembly (world frame, metres); only modules of its kind are imported.

    A user's file is read unless its ``cage`` is given. Raises ``MeshError`` if the file cannot be used, and
    ``ValueError`` if the bars of a generated assembly would collide or not fit.
    """
    if isinstance(spec, LatticeSpec):
        from dataset_builder.scene.assemblies.lattice import lattice_assembly

        return lattice_assembly(spec)
    if isinstance(spec, PileSpec):
        from dataset_builder.scene.assemblies.pile import pile_assembly

        return pile_assembly(spec)
    if isinstance(spec, PierSpec):
        from dataset_builder.scene.assemblies.pier import pier_assembly

        return pier_assembly(spec)
    if isinstance(spec, GeneratedCageSpec):
        from dataset_builder.scene.cages.generate import cage_assembly, spec_cage

        return cage_assembly(spec_cage(spec))
    from dataset_builder.user_files.cage_file import load_cage

    return load_cage(spec, cage)


def assembly_bars(spec: AssemblySpec) -> tuple[Bar, ...]:
    """Return the bars of an assembly; for a generated cage, without making meshes. Raises as ``make_assembly``."""
    if isinstance(spec, GeneratedCageSpec):
        from dataset_builder.scene.cages.generate import cage_bars, spec_cage

        return tuple(bar.bar for bar in cage_bars(spec_cage(spec)))
    return make_assembly(spec).bars
