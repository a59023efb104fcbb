"""Lattice assembly: 75 rods on a grid without contact, in a cube that stands on the board."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from numpy import ndarray

from dataset_builder.scene.assemblies.lattice import CLEAR_GAP_M, lattice_assembly
from dataset_builder.scene.cages.design import STANDING_M
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.specs.config_specs import LatticeSpec
from rebar_depth_bench.data.bars import Bar

SPEC = LatticeSpec()


@pytest.fixture(scope="module")
def lattice() -> Assembly:
    return lattice_assembly(SPEC)


def axis_index(bar: Bar) -> int:
    """Return the index of the world axis that the bar is parallel to: 0 x, 1 y, 2 z."""
    start, end = np.array(bar.axis_m)
    return int(np.argmax(np.abs(end - start)))


def gap_m(a: Bar, b: Bar) -> float:
    """Return the gap between two straight axis-parallel bars, in metres, ribs included."""
    other_axes = [k for k in range(3) if k not in (axis_index(a), axis_index(b))]
    axis_distance_m = np.linalg.norm([a.axis_m[0][k] - b.axis_m[0][k] for k in other_axes])
    return float(axis_distance_m) - outer_radius_m(a.diameter_m) - outer_radius_m(b.diameter_m)


def test_numbering_and_roles(lattice: Assembly) -> None:
    assert [bar.bar_id for bar in lattice.bars] == list(range(1, 76))
    assert [part.bar_id for part in lattice.parts] == list(range(1, 76))
    assert [bar.role for bar in lattice.bars] == ["x-rod"] * 25 + ["y-rod"] * 25 + ["z-rod"] * 25
    assert [axis_index(bar) for bar in lattice.bars] == [0] * 25 + [1] * 25 + [2] * 25
    first, second, sixth = (np.array(lattice.bars[k].axis_m[0]) for k in (0, 1, 5))
    np.testing.assert_allclose(second - first, [0.0, 0.0, 0.02], atol=1e-12)
    np.testing.assert_allclose(sixth - first, [0.0, 0.02, 0.0], atol=1e-12)


def test_steel_has_specified_bounding_box(lattice: Assembly) -> None:
    vertices_m = np.concatenate([part.mesh.vertices_m for part in lattice.parts])
    np.testing.assert_allclose(vertices_m.min(axis=0), [-0.05, -0.05, STANDING_M], atol=1e-12)
    np.testing.assert_allclose(vertices_m.max(axis=0), [0.05, 0.05, 0.1 + STANDING_M], atol=1e-12)


@pytest.mark.slow
def test_smallest_gap_equals_clearance(lattice: Assembly) -> None:
    gaps = [gap_m(a, b) for a, b in combinations(lattice.bars, 2)]
    assert min(gaps) == pytest.approx(CLEAR_GAP_M, abs=1e-9)
    assert CLEAR_GAP_M >= 1e-4


def test_part_meshes_match_bar_axes(lattice: Assembly) -> None:
    for bar, part in zip(lattice.bars, lattice.parts, strict=True):
        axis_m = np.array(bar.axis_m)
        direction = axis_index(bar)
        off_axis = np.delete(part.mesh.vertices_m - axis_m[0], direction, axis=1)
        max_radius_m = np.linalg.norm(off_axis, axis=1).max()
        assert max_radius_m == pytest.approx(outer_radius_m(bar.diameter_m), rel=1e-6)
        along_m = part.mesh.vertices_m[:, direction]
        np.testing.assert_allclose([along_m.min(), along_m.max()], axis_m[:, direction], atol=1e-12)
        assert axis_m[1, direction] - axis_m[0, direction] == pytest.approx(SPEC.extent_m, abs=1e-12)


def test_grid_neighbours_differ_in_diameter(lattice: Assembly) -> None:
    for family in range(3):
        diameters = np.array([bar.diameter_m for bar in lattice.bars[family * 25 : family * 25 + 25]])
        grid = diameters.reshape(5, 5)
        assert (grid[1:] != grid[:-1]).all()
        assert (grid[:, 1:] != grid[:, :-1]).all()
        assert set(diameters) == set(SPEC.diameters_m)


def test_rods_of_same_diameter_have_same_shape(lattice: Assembly) -> None:
    shapes: dict[float, ndarray] = {}
    for bar, part in zip(lattice.bars, lattice.parts, strict=True):
        direction = axis_index(bar)
        middle = np.array(bar.axis_m).mean(axis=0)
        local = np.roll(part.mesh.vertices_m - middle, -direction, axis=1)
        reference = shapes.setdefault(bar.diameter_m, local)
        np.testing.assert_allclose(local, reference, atol=1e-15)


def test_rotated_rods_are_outward_oriented(lattice: Assembly) -> None:
    for part in lattice.parts[::25]:
        a, b, c = np.moveaxis(part.mesh.vertices_m[part.mesh.faces], 1, 0)
        middle = part.mesh.vertices_m.mean(axis=0)
        volume = np.einsum("ij,ij->i", a - middle, np.cross(b - middle, c - middle)).sum() / 6
        assert volume > 0


@pytest.mark.slow
def test_other_extent_and_pitch() -> None:
    bigger = lattice_assembly(LatticeSpec(extent_m=0.12, pitch_m=0.03, diameters_m=(0.008, 0.006)))
    assert len(bigger.bars) == 48
    assert min(gap_m(a, b) for a, b in combinations(bigger.bars, 2)) == pytest.approx(CLEAR_GAP_M, abs=1e-9)
