"""The lattice: a cube of three orthogonal families of straight ribbed rods, standing on the board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import LatticeSpec
from dataset_builder.scene.model import STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, ribbed_bar_mesh

CLEAR_GAP_M = 2e-4
"""Between rods that pass each other: what a tie wire leaves, and no two surfaces coincide."""

LIFT_M = 5e-5
"""The upright rods' ends stand this far above the paper, lest they coincide with it."""

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class _Rod:
    """A rod's place: the world axis it runs along, its centreline's middle and its diameter."""

    axis: int
    middle_m: tuple[float, float, float]
    diameter_m: float


def lattice_assembly(spec: LatticeSpec) -> Assembly:
    """Return the lattice of ``spec``, centred on x = y = 0, from z = 0 (plus ``LIFT_M``) upwards, metres.

    Bars are numbered from 1: first the rods along x, then along y, then along z. Within a family the
    lower of the two other axes counts slowly, the higher one fast, both from the negative side.
    Raises ``ValueError`` where the rods of ``spec`` would touch or leave the cube.
    """
    _check(spec)
    along_x = {
        diameter_m: ribbed_bar_mesh(_centred_line_m(spec.extent_m), diameter_m) for diameter_m in spec.diameters_m
    }
    bars, parts = [], []
    for bar_id, rod in enumerate(_rods(spec), start=1):
        bar = _bar(bar_id, rod, spec.extent_m)
        bars.append(bar)
        mesh = _placed(along_x[rod.diameter_m], rod)
        parts.append(Part(f"{bar.role}-{bar_id:03d}", mesh, bar_id, STEEL))
    return Assembly(tuple(bars), tuple(parts))


def _layer_offset_m(spec: LatticeSpec) -> float:
    """Return the distance between the centrelines of two crossing thick rods: they pass at ``CLEAR_GAP_M``."""
    return 2 * outer_radius_m(max(spec.diameters_m)) + CLEAR_GAP_M


def _rods_per_axis(spec: LatticeSpec) -> int:
    return round(spec.extent_m / spec.pitch_m)


def _check(spec: LatticeSpec) -> None:
    if min(spec.extent_m, spec.pitch_m, *spec.diameters_m) <= 0:
        raise ValueError(f"extent, pitch and diameters must be positive: {spec}")
    if not np.isclose(_rods_per_axis(spec) * spec.pitch_m, spec.extent_m, rtol=1e-9):
        raise ValueError(f"extent_m {spec.extent_m} is no whole number of pitch_m {spec.pitch_m}")
    # Between two layers of one family lies one layer of each other family, clear of both.
    needed_m = 2 * _layer_offset_m(spec)
    if spec.pitch_m < needed_m:
        raise ValueError(
            f"pitch_m {spec.pitch_m} is too small for crossing rods of {max(spec.diameters_m)} m:"
            f" {needed_m:.5f} m or more keeps them {CLEAR_GAP_M} m apart"
        )


def _rods(spec: LatticeSpec) -> list[_Rod]:
    """Return all rods in the order of their bar ids."""
    count = _rods_per_axis(spec)
    grid_m = (np.arange(count) - (count - 1) / 2) * spec.pitch_m
    return [
        _Rod(axis, _middle_m(axis, grid_m[i], grid_m[j], spec), spec.diameters_m[(i + j) % 2])
        for axis in range(3)
        for i in range(count)
        for j in range(count)
    ]


def _middle_m(axis: int, slow_m: float, fast_m: float, spec: LatticeSpec) -> tuple[float, float, float]:
    """Return the world middle of the rod along ``axis`` at the grid position (``slow_m``, ``fast_m``).

    Each family steps half a layer offset aside, in opposite senses along its two grid axes, so that any
    two families are a full offset apart along the axis which neither runs along.
    """
    half_m = _layer_offset_m(spec) / 2
    following, last = (axis + 1) % 3, (axis + 2) % 3
    middle = np.array([0.0, 0.0, spec.extent_m / 2 + LIFT_M])
    slow, fast = sorted((following, last))
    middle[slow] += slow_m
    middle[fast] += fast_m
    middle[following] += half_m
    middle[last] -= half_m
    return (float(middle[0]), float(middle[1]), float(middle[2]))


def _centred_line_m(length_m: float) -> Float64[ndarray, "2 3"]:
    return np.array([[-length_m / 2, 0.0, 0.0], [length_m / 2, 0.0, 0.0]])


def _placed(along_x: Mesh, rod: _Rod) -> Mesh:
    """Turn a mesh along x to the rod's axis and move it there; a cyclic swap of axes turns without rounding."""
    return Mesh(np.roll(along_x.vertices_m, rod.axis, axis=1) + np.array(rod.middle_m), along_x.faces)


def _bar(bar_id: int, rod: _Rod, length_m: float) -> Bar:
    ends = np.roll(_centred_line_m(length_m), rod.axis, axis=1) + np.array(rod.middle_m)
    axis_m = tuple((float(x), float(y), float(z)) for x, y, z in ends)
    return Bar(bar_id, f"{AXES[rod.axis]}-rod", rod.diameter_m, axis_m)
