"""Pier assembly: 231 bars without contact, bent and lapped to standard, in the specified bounding box."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
import trimesh

from dataset_builder.cameras.trajectories import aim_point_m
from dataset_builder.scene.assemblies.pier import CLEAR_GAP_M, pier_assembly
from dataset_builder.scene.cages.design import STANDING_M
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import plain_outer_radius_m
from dataset_builder.specs.config_specs import PierSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.data.bars import Bar
from tests.builder.scene.polylines import (
    hooks_m,
    least_gap_m,
    length_m,
    line_m,
    segment_distances_m,
    straight_segments_m,
    turns_deg,
    winding_deg,
)

SPEC = PierSpec()
SMALL_SPEC = PierSpec(side_m=1.7, height_m=0.5, verticals=32, levels=4)
"""Pier with eight spaces of about 0.2 m per side; a lap takes four of them."""


@pytest.fixture(scope="module")
def pier() -> Assembly:
    return make_assembly(SPEC)


def bars_of_role(assembly: Assembly, role: str) -> list[Bar]:
    return [bar for bar in assembly.bars if bar.role == role]


def distinct_shapes(parts: tuple[Part, ...]) -> list[Part]:
    """Return one part per shape: meshes that are equal up to a translation within 1e-9 m are one shape."""
    distinct: list[Part] = []
    for part in parts:
        local_m = part.mesh.vertices_m - part.mesh.vertices_m.min(axis=0)
        for other in distinct:
            other_local_m = other.mesh.vertices_m - other.mesh.vertices_m.min(axis=0)
            if local_m.shape == other_local_m.shape and np.abs(local_m - other_local_m).max() < 1e-9:
                break
        else:
            distinct.append(part)
    return distinct


def test_numbering_and_roles(pier: Assembly) -> None:
    assert [bar.bar_id for bar in pier.bars] == list(range(1, 232))
    assert [part.bar_id for part in pier.parts] == list(range(1, 232))
    assert [bar.role for bar in pier.bars] == ["vertical"] * 96 + ["hoop"] * 90 + ["tie"] * 45
    assert {part.material for part in pier.parts} == {"steel"}
    assert {(bar.role, bar.diameter_m) for bar in pier.bars} == {
        ("vertical", 0.032),
        ("hoop", 0.016),
        ("tie", 0.016),
    }
    for role in ("hoop", "tie"):
        heights = [bar.axis_m[0][2] for bar in bars_of_role(pier, role)]
        assert heights == sorted(heights)


def test_steel_has_specified_bounding_box(pier: Assembly) -> None:
    vertices_m = np.concatenate([part.mesh.vertices_m for part in pier.parts])
    np.testing.assert_allclose(vertices_m.min(axis=0), [-2.4, -2.4, STANDING_M], atol=1e-6)
    np.testing.assert_allclose(vertices_m.max(axis=0), [2.4, 2.4, 6.67 + STANDING_M], atol=1e-6)
    assert aim_point_m(pier).tolist() == [0.0, 0.0, 3.335]


def test_segment_distances_match_sampled_distances() -> None:
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(6, 2, 3)), rng.normal(size=(7, 2, 3))
    fractions = np.linspace(0, 1, 201)[:, None]
    for i, j in np.ndindex(6, 7):
        points = [ends[0] + fractions * (ends[1] - ends[0]) for ends in (a[i], b[j])]
        sampled = np.linalg.norm(points[0][:, None] - points[1][None], axis=-1).min()
        assert segment_distances_m(a[i : i + 1], b[j : j + 1])[0, 0] == pytest.approx(sampled, abs=0.02)
        assert segment_distances_m(a[i : i + 1], b[j : j + 1])[0, 0] <= sampled + 1e-12


def test_smallest_gap_is_half_a_millimetre(pier: Assembly) -> None:
    # The chords of bends are up to 40 mm * (1 - cos 3 degrees) = 0.055 mm inside the arc.
    assert 0.44e-3 < least_gap_m(pier) <= 0.5e-3 + 1e-12


def test_no_bar_intersects_itself(pier: Assembly) -> None:
    for bar in (pier.bars[96], pier.bars[97], pier.bars[186]):
        straight = straight_segments_m(bar)
        distances = segment_distances_m(straight, straight)
        apart = distances[np.triu_indices(len(straight), k=1)]
        assert apart.min() > 2 * plain_outer_radius_m(bar.diameter_m)


def test_bars_are_at_most_12_m_long(pier: Assembly) -> None:
    assert max(length_m(bar) for bar in pier.bars) <= 12.0
    assert {round(length_m(bar), 9) for bar in bars_of_role(pier, "vertical")} == {6.67}
    assert {length_m(bar) > 10 for bar in bars_of_role(pier, "hoop")} == {True}


def test_verticals_are_evenly_spaced_on_square(pier: Assembly) -> None:
    positions_m = np.array([line_m(bar)[0, :2] for bar in bars_of_role(pier, "vertical")])
    spacings_m = np.linalg.norm(np.roll(positions_m, -1, axis=0) - positions_m, axis=1)
    assert spacings_m.max() - spacings_m.min() < 1e-4  # Corner bars are 4.5 mm further inside.
    outermost_m = np.abs(positions_m).max(axis=1)
    assert np.count_nonzero(np.isclose(outermost_m, outermost_m.max(), atol=1e-9)) == 92
    corners = np.isclose(np.abs(positions_m[:, 0]), np.abs(positions_m[:, 1]))
    assert np.flatnonzero(corners).tolist() == [0, 24, 48, 72]
    assert 0.004 < outermost_m.max() - outermost_m[corners].max() < 0.005
    assert np.linalg.norm(positions_m, axis=1)[corners] == pytest.approx(np.linalg.norm(positions_m[0]))


def test_levels_are_evenly_spaced_and_layers_clear(pier: Assembly) -> None:
    hoops = np.array([bar.axis_m[0][2] for bar in bars_of_role(pier, "hoop")]).reshape(45, 2)
    ties = np.array([bar.axis_m[0][2] for bar in bars_of_role(pier, "tie")])
    for heights in (hoops[:, 0], hoops[:, 1], ties):
        np.testing.assert_allclose(np.diff(heights), 6.67 / 45, atol=1e-12)
    layer_m = 2 * plain_outer_radius_m(0.016) + CLEAR_GAP_M
    np.testing.assert_allclose(hoops[:, 1] - hoops[:, 0], layer_m, atol=1e-12)
    np.testing.assert_allclose(ties - hoops[:, 1], layer_m, atol=1e-12)
    for bar in pier.bars[96:]:
        assert np.ptp(line_m(bar)[:, 2]) == 0.0


def test_half_hoop_laps_alternate_sides_by_level(pier: Assembly) -> None:
    hoops = bars_of_role(pier, "hoop")
    for level in range(45):
        lap_axis = level % 2  # axis that the laps are parallel to
        first, second = (straight_segments_m(bar)[[1, 3]] for bar in hoops[2 * level : 2 * level + 2])
        for segment in np.concatenate([first, second]):
            assert np.ptp(segment[:, 1 - lap_axis]) < 1e-12
            assert abs(segment[0, 1 - lap_axis]) == pytest.approx(2.4 - plain_outer_radius_m(0.016))
        lap_m = second[:, :, lap_axis].max() - first[:, :, lap_axis].min()
        assert 40 * 0.016 <= lap_m <= 50 * 0.016
        assert second[:, :, lap_axis].max() == pytest.approx(-first[:, :, lap_axis].min())


def test_bend_angles_radii_and_hook_lengths(pier: Assembly) -> None:
    assert {tuple(turns_deg(bar)) for bar in bars_of_role(pier, "hoop")} == {(135.0, 90.0, 90.0, 135.0)}
    for bar in pier.bars[96:]:
        ends = straight_segments_m(bar)[[0, -1]]
        assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) == pytest.approx(10 * bar.diameter_m)
        a, b, c = line_m(bar)[1:4]  # Three points of the first bend define its circle.
        twice_area = np.linalg.norm(np.cross(b - a, c - a))
        radius_m = np.prod([np.linalg.norm(x) for x in (b - a, c - b, a - c)]) / (2 * twice_area)
        assert radius_m == pytest.approx((4 * bar.diameter_m + bar.diameter_m) / 2, rel=1e-6)


def test_each_hook_encloses_one_vertical(pier: Assembly) -> None:
    positions_m = np.array([line_m(bar)[0, :2] for bar in bars_of_role(pier, "vertical")])
    max_distance_m = 0.016 + plain_outer_radius_m(0.016) + 2e-3
    for bar in pier.bars[96:]:
        for hook in hooks_m(bar):
            near = [
                position
                for position in positions_m
                if np.linalg.norm(hook - position, axis=1).min() < max_distance_m
            ]
            assert len(near) == 1
            assert winding_deg(hook, near[0]) > 200  # A bar that only passes by subtends less than 180 degrees.


def test_ties_alternate_direction_hook_ends_and_rows(pier: Assembly) -> None:
    ties = bars_of_role(pier, "tie")
    for direction in (0, 1):
        turns = [turns_deg(bar) for bar in ties[direction::2]]
        # Axes are ordered from the negative end to the positive end.
        assert turns == [[90.0, 135.0], [135.0, 90.0]] * (len(turns) // 2) + [[90.0, 135.0]] * (len(turns) % 2)
        legs = [straight_segments_m(bar)[1] for bar in ties[direction::2]]
        assert all(np.ptp(leg[:, 1 - direction]) < 1e-12 and leg[1, direction] > leg[0, direction] for leg in legs)
        rows = [round(float(leg[0, 1 - direction]), 6) for leg in legs]
        assert len(set(rows)) == len(rows) >= 22


def test_nine_distinct_shapes_with_closed_meshes(pier: Assembly) -> None:
    assert sum(len(part.mesh.faces) for part in pier.parts) < 1_500_000
    shapes = distinct_shapes(pier.parts)
    assert len(shapes) == 9
    for part in shapes:
        bar = pier.bars[part.bar_id - 1]
        mesh = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(pi / 4 * bar.diameter_m**2 * length_m(bar), rel=0.01)


@pytest.mark.slow
def test_part_meshes_match_bar_axes(pier: Assembly) -> None:
    for part in distinct_shapes(pier.parts):
        bar = pier.bars[part.bar_id - 1]
        axis_polyline_m = line_m(bar)
        segments = np.stack([axis_polyline_m[:-1], axis_polyline_m[1:]], axis=1)
        points_as_segments = np.stack([part.mesh.vertices_m] * 2, axis=1)
        points_as_segments[:, 1, 0] += 1e-9  # A point is represented by a very short segment.
        distances_m = segment_distances_m(points_as_segments, segments).min(axis=1)
        assert distances_m.max() == pytest.approx(plain_outer_radius_m(bar.diameter_m), abs=1e-8)


def test_pier_is_deterministic(pier: Assembly) -> None:
    repeated = pier_assembly(SPEC)
    assert repeated.bars == pier.bars
    for part, repeated_part in zip(pier.parts, repeated.parts, strict=True):
        assert part.mesh.vertices_m.tobytes() == repeated_part.mesh.vertices_m.tobytes()


def test_small_pier() -> None:
    small = pier_assembly(SMALL_SPEC)
    assert len(small.bars) == 32 + 3 * 4
    assert 0.44e-3 < least_gap_m(small) <= 0.5e-3 + 1e-12
