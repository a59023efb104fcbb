"""Lattice assembly: a cube of three orthogonal families of straight ribbed rods, standing on the board."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import STANDING_M
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, ribbed_bar_mesh
from dataset_builder.specs.config_specs import LatticeSpec
from rebar_depth_bench.data.bars import Bar

CLEAR_GAP_M = 2e-4
"""Clear distance between crossing rods, metres: as tied with wire, and large enough that no surfaces coincide."""

AXIS_NAMES = ("x", "y", "z")


def lattice_assembly(spec: LatticeSpec) -> Assembly:
    """Return the lattice of ``spec``, centred on x = y = 0, from z = 0 (plus ``STANDING_M``) upwards, metres.

    Bars are numbered from 1: first the rods along x, then along y, then along z. Within a family the higher of
    the two other axes varies fastest, both from the negative side. The pitch divides the extent.
    """
    line_m = np.array([[-spec.extent_m / 2, 0.0, 0.0], [spec.extent_m / 2, 0.0, 0.0]])
    along_x = {diameter_m: ribbed_bar_mesh(line_m, diameter_m) for diameter_m in spec.diameters_m}
    count = round(spec.extent_m / spec.pitch_m)
    grid_m = (np.arange(count) - (count - 1) / 2) * spec.pitch_m
    rods: list[tuple[Bar, Mesh]] = []
    for axis, slow, fast in np.ndindex(3, count, count):
        diameter_m = spec.diameters_m[(slow + fast) % 2]
        mesh, middle_m = along_x[diameter_m], _rod_middle_m(axis, grid_m[slow], grid_m[fast], spec)
        # The centreline and the mesh along x are rotated by a permutation of the axes.
        axis_m, vertices_m = (np.roll(points_m, axis, axis=1) + middle_m for points_m in (line_m, mesh.vertices_m))
        bar = Bar(len(rods) + 1, f"{AXIS_NAMES[axis]}-rod", diameter_m, axis_of(axis_m))
        rods.append((bar, Mesh(vertices_m, mesh.faces)))
    return Assembly.from_meshes(rods)


def _rod_middle_m(axis: int, slow_m: float, fast_m: float, spec: LatticeSpec) -> Float64[ndarray, " 3"]:
    """Return the midpoint (world) of the rod along ``axis`` at the grid position (``slow_m``, ``fast_m``).

    Each family is shifted by half a layer offset along its two grid axes, in opposite directions, so that two
    families are a full offset apart along the axis that neither runs along: two rods of the largest diameter are
    then ``CLEAR_GAP_M`` apart.
    """
    half_m = (2 * outer_radius_m(max(spec.diameters_m)) + CLEAR_GAP_M) / 2
    next_axis, last_axis = (axis + 1) % 3, (axis + 2) % 3
    middle = np.array([0.0, 0.0, spec.extent_m / 2 + STANDING_M])
    slow_axis, fast_axis = sorted((next_axis, last_axis))
    middle[slow_axis] += slow_m
    middle[fast_axis] += fast_m
    middle[next_axis] += half_m
    middle[last_axis] -= half_m
    return middle
