"""Assembly of a generated cage: its bars as built, ribbed if they have few ribs altogether."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, ribs_per_row
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.cages.as_built import BuiltBar
from dataset_builder.scene.cages.generate import VERSION, GeneratedCage, generate_cage
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.specs.config_specs import GeneratedCageSpec
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError

MAX_RIBS = 3000
"""Largest number of ribs in one row of all bars of a cage with ribs.

Hundreds of cages have a mesh each: this number makes about 1.2 million triangles.
"""


def generated_assembly(spec: GeneratedCageSpec) -> Assembly:
    """Return the ``cage_assembly`` of the cage of a spec. Raises ``InputError`` as ``spec_cage``."""
    return cage_assembly(spec_cage(spec))


def spec_cage(spec: GeneratedCageSpec) -> GeneratedCage:
    """Return the cage of a spec.

    Raises ``InputError`` if the spec is of another version of the generator, and as ``generate_cage``.
    """
    if spec.version != VERSION:
        raise InputError(f"the cage is of version {spec.version} of the generator, expected {VERSION}")
    return generate_cage(spec.split, spec.number, spec.seed, spec.family)


def cage_assembly(cage: GeneratedCage) -> Assembly:
    """Return the bars of a generated cage, numbered from 1 in the order of the generator, and their meshes."""
    bars = cage_bars(cage)
    is_ribbed = sum(map(ribs_per_row, bars)) <= MAX_RIBS
    return Assembly.from_meshes((bar.bar, _rounded(bar_mesh(replace(bar, ribs=is_ribbed)))) for bar in bars)


def _rounded(mesh: Mesh) -> Mesh:
    """Return a mesh with vertices rounded to the nanometre, which are the same on every processor."""
    return Mesh(np.round(mesh.vertices_m, 9) + 0.0, mesh.faces)


def cage_bars(cage: GeneratedCage) -> tuple[CageBar, ...]:
    """Return the bars of a generated cage as built, numbered from 1 in their order."""
    return tuple(CageBar(f"bar {number}", _bar(number, bar)) for number, bar in enumerate(cage.bars, start=1))


def _bar(number: int, bar: BuiltBar) -> Bar:
    nominal_m = () if bar.nominal_m is None else axis_of(bar.nominal_m)
    return Bar(number, bar.role, bar.diameter_m, axis_of(bar.line_m), nominal_m)
