"""Assembly of a generated cage: its bars as built, ribbed if they have few ribs altogether."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.config.specs import GeneratedCageSpec
from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, ribs_per_row
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.cages.generate import VERSION, GeneratedCage, generate_cage
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError

MAX_RIBS = 3000
"""Largest number of ribs in one row of all bars of a cage with ribs.

Hundreds of cages have a mesh each: this number makes about 1.2 million triangles.
"""


def generated_assembly(spec: GeneratedCageSpec) -> Assembly:
    """Return the bars of a generated cage, numbered from 1 in the order of the generator, and their meshes.

    Raises ``InputError`` if the spec is of another version of the generator, and as ``generate_cage``.
    """
    if spec.version != VERSION:
        raise InputError(f"the cage is of version {spec.version} of the generator, expected {VERSION}")
    bars = cage_bars(generate_cage(spec.split, spec.number, spec.seed, spec.family))
    is_ribbed = sum(map(ribs_per_row, bars)) <= MAX_RIBS
    return Assembly.from_meshes((bar.bar, _rounded(bar_mesh(replace(bar, ribs=is_ribbed)))) for bar in bars)


def _rounded(mesh: Mesh) -> Mesh:
    """Return a mesh with vertices rounded to the nanometre, which are the same on every processor."""
    return Mesh(np.round(mesh.vertices_m, 9) + 0.0, mesh.faces)


def cage_bars(cage: GeneratedCage) -> tuple[CageBar, ...]:
    """Return the bars of a generated cage as built, numbered from 1 in their order."""
    return tuple(
        CageBar(f"bar {number}", Bar(number, bar.role, bar.diameter_m, axis_of(bar.line_m)))
        for number, bar in enumerate(cage.bars, start=1)
    )
