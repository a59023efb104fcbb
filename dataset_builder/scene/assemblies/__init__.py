"""Assembly construction: bars and meshes from an assembly spec."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from dataset_builder.config.file_specs import CageFileSpec, MeshFileSpec
from dataset_builder.config.specs import (
    AssemblySpec,
    GeneratedCageSpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
)
from dataset_builder.scene.assemblies.cage_file import load_cage
from dataset_builder.scene.assemblies.generated import cage_bars, generated_assembly, spec_cage
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.assemblies.pile import pile_assembly
from dataset_builder.scene.model import Assembly
from rebar_depth_bench.data.bars import Bar

_BUILDERS: Mapping[type, Callable[[Any], Assembly]] = {
    CageFileSpec: load_cage,
    GeneratedCageSpec: generated_assembly,
    LatticeSpec: lattice_assembly,
    MeshFileSpec: load_cage,
    PierSpec: pier_assembly,
    PileSpec: pile_assembly,
}


def make_assembly(spec: AssemblySpec) -> Assembly:
    """Return the bars and meshes of an assembly (world frame, metres).

    Raises ``MeshError`` if a user's file cannot be used, ``ValueError`` if the bars of a generated assembly
    would collide or not fit.
    """
    return _BUILDERS[type(spec)](spec)


def assembly_bars(spec: AssemblySpec) -> tuple[Bar, ...]:
    """Return the bars of an assembly; for a generated cage, without making meshes. Raises as ``make_assembly``."""
    if isinstance(spec, GeneratedCageSpec):
        return tuple(bar.bar for bar in cage_bars(spec_cage(spec)))
    return make_assembly(spec).bars
