"""Lattice assembly: a cube of three orthogonal families of straight ribbed rods, standing on the board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import LatticeSpec
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, ribbed_bar_mesh
from rebar_depth_bench.data.bars import Bar

CLEAR_GAP_M = 2e-4
"""Clear distance between crossing rods, metres: as tied with wire, and large enough that no surfaces coincide."""

LIFT_M = 5e-5
"""Height of the upright bars' lower ends above z = 0, metres, so that they do not coincide with the paper."""

AXIS_NAMES = ("x", "y", "z")


@dataclass(frozen=True)
class _Rod:
    """Position of a rod: index of the world axis it runs along, midpoint of its centreline, and diameter."""

    axis: int
    middle_m: tuple[float, float, float]
    diameter_m: float


def lattice_assembly(spec: LatticeSpec) -> Assembly:
    """Return the lattice of ``spec``, centred on x = y = 0, from z = 0 (plus ``LIFT_M``) upwards, metres.

    Bars are numbered from 1: first the rods along x, then along y, then along z. Within a family the higher of
    the two other axes varies fastest, both from the negative side. The pitch divides the extent.
    """
    line_m = np.array([[-spec.extent_m / 2, 0.0, 0.0], [spec.extent_m / 2, 0.0, 0.0]])
    along_x = {diameter_m: ribbed_bar_mesh(line_m, diameter_m) for diameter_m in spec.diameters_m}
    return Assembly.from_meshes(
        _placed_rod(bar_id, rod, line_m, along_x[rod.diameter_m])
        for bar_id, rod in enumerate(_rods(spec), start=1)
    )


def _layer_offset_m(spec: LatticeSpec) -> float:
    """Return the centreline distance of two crossing rods of the largest diameter, ``CLEAR_GAP_M`` apart."""
    return 2 * outer_radius_m(max(spec.diameters_m)) + CLEAR_GAP_M


def _rods_per_axis(spec: LatticeSpec) -> int:
    return round(spec.extent_m / spec.pitch_m)


def _rods(spec: LatticeSpec) -> list[_Rod]:
    """Return all rods in the order of their bar ids."""
    count = _rods_per_axis(spec)
    grid_m = (np.arange(count) - (count - 1) / 2) * spec.pitch_m
    return [
        _Rod(axis, _rod_middle_m(axis, grid_m[i], grid_m[j], spec), spec.diameters_m[(i + j) % 2])
        for axis in range(3)
        for i in range(count)
        for j in range(count)
    ]


def _rod_middle_m(axis: int, slow_m: float, fast_m: float, spec: LatticeSpec) -> tuple[float, float, float]:
    """Return the midpoint (world) of the rod along ``axis`` at the grid position (``slow_m``, ``fast_m``).

    Each family is shifted by half a layer offset along its two grid axes, in opposite directions, so that two
    families are a full offset apart along the axis that neither runs along.
    """
    half_m = _layer_offset_m(spec) / 2
    next_axis, last_axis = (axis + 1) % 3, (axis + 2) % 3
    middle = np.array([0.0, 0.0, spec.extent_m / 2 + LIFT_M])
    slow_axis, fast_axis = sorted((next_axis, last_axis))
    middle[slow_axis] += slow_m
    middle[fast_axis] += fast_m
    middle[next_axis] += half_m
    middle[last_axis] -= half_m
    return (float(middle[0]), float(middle[1]), float(middle[2]))


def _placed_rod(bar_id: int, rod: _Rod, line_m: Float64[ndarray, "2 3"], along_x: Mesh) -> tuple[Bar, Mesh]:
    """Return bar and mesh of a rod, whose centreline and mesh along x are rotated by a permutation of the axes."""
    axis_m, vertices_m = (
        np.roll(points_m, rod.axis, axis=1) + np.array(rod.middle_m) for points_m in (line_m, along_x.vertices_m)
    )
    bar = Bar(bar_id, f"{AXIS_NAMES[rod.axis]}-rod", rod.diameter_m, axis_of(axis_m))
    return bar, Mesh(vertices_m, along_x.faces)
