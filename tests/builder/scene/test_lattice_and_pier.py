"""Lattice and pier: known axes, no contact, the specified boxes, meshes around their axes, bends to standard."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from math import pi

import numpy as np
import pytest
import trimesh
from numpy import ndarray

from dataset_builder.cameras.trajectories import aim_point_m
from dataset_builder.scene.assemblies.lattice import CLEAR_GAP_M, lattice_assembly
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.cages.design import STANDING_M
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, plain_outer_radius_m
from dataset_builder.specs.config_specs import AssemblySpec, LatticeSpec, PierSpec
from dataset_builder.user_files.make_assembly import make_assembly
from tests.builder.scene.cages import (
    Line,
    Segments,
    least_gap_m,
    line_length_m,
    point_distances_m,
    segments_m,
)

SPECS: dict[str, AssemblySpec] = {"lattice": LatticeSpec(), "pier": PierSpec()}
RADIUS_M: dict[str, Callable[[float], float]] = {"lattice": outer_radius_m, "pier": plain_outer_radius_m}
ROLES = {
    "lattice": [("x-rod", 25), ("y-rod", 25), ("z-rod", 25)],
    "pier": [("vertical", 96), ("hoop", 90), ("tie", 45)],
}
AXES = {
    "lattice": "b6650705ea92b37205aba0fa6693d1b61503b3ae96749d1f6ca02e7a24ffe9f7",
    "pier": "bb5c32d74ee436706440291ed061799e3dadb2327bccc2fc8aacc3a89ee695bd",
}
BOXES_M = {
    "lattice": ([-0.05, -0.05, STANDING_M], [0.05, 0.05, 0.1 + STANDING_M]),
    "pier": ([-2.4, -2.4, STANDING_M], [2.4, 2.4, 6.67 + STANDING_M]),
}


@pytest.fixture(scope="module")
def scenes() -> dict[str, Assembly]:
    return {name: make_assembly(spec) for name, spec in SPECS.items()}


@pytest.fixture(scope="module")
def links(scenes: dict[str, Assembly]) -> list[Line]:
    """Return the axes of the bent bars of the pier: half hoops and ties."""
    return [np.array(bar.axis_m) for bar in scenes["pier"].bars[96:]]


def axes_digest(assembly: Assembly) -> str:
    """Return the digest of the bars, their axes rounded to a tenth of a micrometre."""
    rows = [
        [bar.bar_id, bar.role, bar.diameter_m, (np.round(bar.axis_m, 7) + 0.0).tolist()] for bar in assembly.bars
    ]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def distinct_parts(assembly: Assembly) -> list[Part]:
    """Return one part per shape: meshes that are equal up to a translation within 1e-9 m are one shape."""
    shapes: list[ndarray] = []
    distinct = []
    for part in assembly.parts:
        local_m = part.mesh.vertices_m - part.mesh.vertices_m.min(axis=0)
        same_size = [shape for shape in shapes if shape.shape == local_m.shape]
        if not any(np.abs(shape - local_m).max() < 1e-9 for shape in same_size):
            shapes.append(local_m)
            distinct.append(part)
    return distinct


def straight_segments_m(line_m: Line) -> Segments:
    """Return the straight segments of a bar (over 50 mm; the chords of its arcs are millimetres long)."""
    pieces_m = segments_m(line_m)
    return np.asarray(pieces_m[np.linalg.norm(pieces_m[:, 1] - pieces_m[:, 0], axis=1) > 0.05])


def turns_deg(line_m: Line) -> list[float]:
    """Return the angles between successive straight segments of a bar, degrees."""
    directions = np.diff(straight_segments_m(line_m), axis=1)[:, 0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.round(np.rad2deg(np.arccos((directions[1:] * directions[:-1]).sum(axis=1))), 6).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("name", SPECS)
def test_axes_are_the_known_ones(scenes: dict[str, Assembly], name: str) -> None:
    assert axes_digest(scenes[name]) == AXES[name]


@pytest.mark.parametrize("name", SPECS)
def test_bars_and_parts_are_numbered_by_role(scenes: dict[str, Assembly], name: str) -> None:
    bars, parts = scenes[name].bars, scenes[name].parts
    numbers = list(range(1, len(bars) + 1))
    assert [bar.bar_id for bar in bars] == [part.bar_id for part in parts] == numbers
    assert [bar.role for bar in bars] == [role for role, count in ROLES[name] for _ in range(count)]
    assert {part.material for part in parts} == {"steel"}


@pytest.mark.parametrize("name", SPECS)
def test_steel_has_the_specified_box(scenes: dict[str, Assembly], name: str) -> None:
    vertices_m = np.concatenate([part.mesh.vertices_m for part in scenes[name].parts])
    np.testing.assert_allclose([vertices_m.min(axis=0), vertices_m.max(axis=0)], BOXES_M[name], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "shapes"), [("lattice", 6), ("pier", 9)])
def test_meshes_are_few_closed_shapes_around_their_axes(
    scenes: dict[str, Assembly], name: str, shapes: int
) -> None:
    assert sum(len(part.mesh.faces) for part in scenes[name].parts) < 1_500_000
    parts = distinct_parts(scenes[name])
    assert len(parts) == shapes
    for part in parts:
        bar = scenes[name].bars[part.bar_id - 1]
        line_m = np.array(bar.axis_m)
        mesh = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(pi / 4 * bar.diameter_m**2 * line_length_m(line_m), rel=0.01)
        off_axis_m = point_distances_m(part.mesh.vertices_m, segments_m(line_m)).max()
        assert off_axis_m == pytest.approx(RADIUS_M[name](bar.diameter_m), abs=1e-8)


def test_rods_are_as_far_apart_as_specified(scenes: dict[str, Assembly]) -> None:
    other = lattice_assembly(LatticeSpec(extent_m=0.12, pitch_m=0.03, diameters_m=(0.008, 0.006)))
    assert len(other.bars) == 48
    for assembly in (scenes["lattice"], other):
        assert least_gap_m(assembly, outer_radius_m) == pytest.approx(CLEAR_GAP_M, abs=1e-9)
    assert CLEAR_GAP_M >= 1e-4


@pytest.mark.slow
def test_bars_of_a_pier_are_half_a_millimetre_apart(scenes: dict[str, Assembly]) -> None:
    """Check also a pier with eight spaces of about 0.2 m per side, of which a lap takes four."""
    small_spec = PierSpec(side_m=1.7, height_m=0.5, verticals=32, levels=4)
    small, again = pier_assembly(small_spec), pier_assembly(small_spec)
    assert len(small.bars) == 32 + 3 * 4
    for assembly in (scenes["pier"], small):
        # The chords of bends are up to 40 mm * (1 - cos 3 degrees) = 0.055 mm inside the arc.
        assert 0.44e-3 < least_gap_m(assembly, plain_outer_radius_m) <= 0.5e-3 + 1e-12
    assert small.vertices_m.tobytes() == again.vertices_m.tobytes()
    assert aim_point_m(scenes["pier"]).tolist() == [0.0, 0.0, 3.335]


def test_bends_and_hooks_are_those_of_the_standard(links: list[Line]) -> None:
    assert {tuple(turns_deg(line_m)) for line_m in links[:90]} == {(135.0, 90.0, 90.0, 135.0)}
    assert {tuple(sorted(turns_deg(line_m))) for line_m in links[90:]} == {(90.0, 135.0)}
    for line_m in links:
        assert np.ptp(line_m[:, 2]) == 0.0
        ends = straight_segments_m(line_m)[[0, -1]]
        assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) == pytest.approx(10 * 0.016)
        a, b, c = line_m[1:4]  # Three points of the first bend define its circle.
        twice_area = np.linalg.norm(np.cross(b - a, c - a))
        radius_m = np.prod([np.linalg.norm(side) for side in (b - a, c - b, a - c)]) / (2 * twice_area)
        assert radius_m == pytest.approx((4 * 0.016 + 0.016) / 2, rel=1e-6)
