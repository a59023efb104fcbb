"""Pile assembly: six bent stirrups at rest that intersect neither each other nor the board."""

from __future__ import annotations

import hashlib
import json
from itertools import combinations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.pile import RIBS, STATES_DIR, load_settled_poses, pile_assembly
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.links import SELF_GAP_M, hook_extension_m, stirrup_centreline_m
from dataset_builder.specs.config_specs import PileSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m

SPEC = PileSpec()
RADIUS_M = outer_radius_m(SPEC.diameter_m, RIBS)
STORED = json.loads((STATES_DIR / "pile-0.json").read_text())

Polyline = Float64[ndarray, "n 3"]


@pytest.fixture(scope="module")
def pile() -> Assembly:
    return pile_assembly(SPEC)


@pytest.fixture(scope="module")
def lines_m(pile: Assembly) -> list[Polyline]:
    return [np.array(bar.axis_m) for bar in pile.bars]


def segment_distances_m(a: Polyline, b: Polyline) -> Float64[ndarray, "n k"]:
    """Return the exact distance between every segment of one polyline and every segment of another.

    The minimum is on the common perpendicular inside both segments, or at an end of one of them.
    """
    a0, a1, b0, b1 = a[:-1, None], a[1:, None], b[None, :-1], b[None, 1:]
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, uv, vv, uw, vw = ((x * y).sum(-1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    area = uu * vv - uv * uv
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (uv * vw - vv * uw) / area, (uu * vw - uv * uw) / area
        inside = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    crossing = (area > 1e-12 * uu * vv) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    ends = [point_distances_m(a0, b0, b1), point_distances_m(a1, b0, b1)]
    ends += [point_distances_m(b0, a0, a1), point_distances_m(b1, a0, a1)]
    return np.asarray(np.where(crossing, inside, np.min(ends, axis=0)))


def point_distances_m(point: ndarray, start: ndarray, end: ndarray) -> Float64[ndarray, "n k"]:
    segment = end - start
    fraction = np.clip(((point - start) * segment).sum(-1) / (segment * segment).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(point - start - fraction[..., None] * segment, axis=-1))


def directions(line: Polyline) -> Polyline:
    steps = np.diff(line, axis=0)
    return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))


def test_six_stirrups_are_numbered_in_order(pile: Assembly) -> None:
    assert [bar.bar_id for bar in pile.bars] == [part.bar_id for part in pile.parts] == [1, 2, 3, 4, 5, 6]
    assert {(bar.role, bar.diameter_m) for bar in pile.bars} == {("stirrup", 0.010)}
    assert {part.material for part in pile.parts} == {"steel"}
    repeated = make_assembly(SPEC)
    assert repeated.bars == pile.bars
    assert all(
        part.mesh.vertices_m.tobytes() == repeated_part.mesh.vertices_m.tobytes()
        for part, repeated_part in zip(pile.parts, repeated.parts, strict=True)
    )


def test_stirrup_meshes_are_closed_around_their_axes(pile: Assembly, lines_m: list[Polyline]) -> None:
    for part, line_m in zip(pile.parts, lines_m, strict=True):
        solid = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert solid.is_watertight
        assert solid.is_winding_consistent
        assert len(part.mesh.faces) < 60_000
        length_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum()
        assert solid.volume == pytest.approx(np.pi / 4 * SPEC.diameter_m**2 * length_m, rel=0.01)
        sampled_m = part.mesh.vertices_m[::97, None]
        off_axis_m = point_distances_m(sampled_m, line_m[None, :-1], line_m[None, 1:]).min(axis=1)
        assert off_axis_m.max() < RADIUS_M + 1e-9


def test_bars_touch_without_intersection(lines_m: list[Polyline], pile: Assembly) -> None:
    gaps_m = [segment_distances_m(a, b).min() - 2 * RADIUS_M for a, b in combinations(lines_m, 2)]
    assert min(gaps_m) > -1e-4
    assert min(gaps_m) < 1e-4, "a heap whose bars do not lie on each other"
    lowest_m = min(line[:, 2].min() for line in lines_m) - RADIUS_M
    assert -1e-4 < lowest_m < 1e-4
    assert min(part.mesh.vertices_m[:, 2].min() for part in pile.parts) >= lowest_m


def test_pile_is_tilted_and_leaves_four_markers_free(lines_m: list[Polyline], pile: Assembly) -> None:
    vertices_m = np.concatenate([part.mesh.vertices_m for part in pile.parts])
    assert np.abs(vertices_m[:, :2]).max() <= 0.17
    assert vertices_m[:, 2].max() > 0.03
    normals = [np.linalg.svd(line - line.mean(axis=0))[2][2] for line in lines_m]
    assert np.rad2deg(np.arccos(min(abs(normal[2]) for normal in normals))) > 8.0
    covered = [
        ((vertices_m[:, :2] > corners[:, :2].min(axis=0)) & (vertices_m[:, :2] < corners[:, :2].max(axis=0)))
        .all(axis=1)
        .any()
        for corners in marker_corners_m(BoardSpec()).values()
    ]
    assert len(covered) - sum(covered) >= 4


def developed_length_m(size_m: tuple[float, float], diameter_m: float) -> float:
    """Return the bar length as in a bending schedule: sides minus corners, three 90-degree bends, two hooks."""
    radius_m = 2.5 * diameter_m  # half the mandrel of 4 d plus half the bar
    sides_m = 2 * (size_m[0] - diameter_m) + 2 * (size_m[1] - diameter_m) - 8 * radius_m
    total_bend_deg = 3 * 90 + 2 * 135
    planar_length_m = sides_m + np.deg2rad(total_bend_deg) * radius_m + 2 * max(6 * diameter_m, 0.075)
    loop_length_m = sides_m + 2 * np.pi * radius_m
    outer_m = 2 * outer_radius_m(diameter_m, RIBS) + SELF_GAP_M
    return float(planar_length_m * np.hypot(1.0, outer_m / loop_length_m))


def resample_polyline_m(line: Polyline) -> Polyline:
    """Return points about every 5 mm along a polyline."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    sample_m = np.linspace(0.0, along_m[-1], int(along_m[-1] / 0.005))
    return np.stack([np.interp(sample_m, along_m, column) for column in line.T], axis=1)


@settings(max_examples=30)
@given(
    st.sampled_from([0.006, 0.008, 0.010, 0.012]),
    st.floats(0.2, 0.6),
    st.floats(0.2, 0.6),
)
def test_stirrup_has_specified_size_length_and_hooks(diameter_m: float, length_m: float, width_m: float) -> None:
    size_m = (length_m, width_m)
    outer_m = outer_radius_m(diameter_m, RIBS)
    line = stirrup_centreline_m(size_m, diameter_m, outer_m)
    np.testing.assert_allclose(np.ptp(line[:, :2], axis=0) + diameter_m, size_m, atol=1e-12)
    legs_m = np.linalg.norm(np.diff(line, axis=0), axis=1)
    assert legs_m.sum() == pytest.approx(developed_length_m(size_m, diameter_m), rel=4e-4)
    np.testing.assert_allclose(np.average((line[:-1] + line[1:]) / 2, axis=0, weights=legs_m), 0.0, atol=1e-12)

    flat = directions(line * [1.0, 1.0, 0.0])
    heading_deg = np.rad2deg(np.unwrap(np.arctan2(flat[:, 1], flat[:, 0])))
    straight_deg = heading_deg[legs_m > 0.9 * hook_extension_m(diameter_m)]
    # Tip, hook, three corners, hook, tip: all bends are to the left.
    np.testing.assert_allclose(np.diff(straight_deg), [135, 90, 90, 90, 135], atol=1e-6)
    assert [legs_m[0], legs_m[-1]] == pytest.approx([max(6 * diameter_m, 0.075)] * 2, rel=1e-3)
    middle = (line.min(axis=0) + line.max(axis=0)) / 2
    for tip in (line[0], line[-1]):
        assert (np.abs(tip - middle)[:2] < np.array(size_m) / 2 - diameter_m).all(), "a hook ends outside the core"


@pytest.mark.parametrize(("size_m", "diameter_m"), [(SPEC.size_m, SPEC.diameter_m), ((0.5, 0.4), 0.006)])
def test_stirrup_does_not_intersect_itself(size_m: tuple[float, float], diameter_m: float) -> None:
    outer_m = outer_radius_m(diameter_m, RIBS)
    line = stirrup_centreline_m(size_m, diameter_m, outer_m)
    fine = resample_polyline_m(line)
    index = np.arange(len(fine) - 1)
    not_adjacent = np.abs(index[:, None] - index) > 16  # 80 mm along the bar, which is longer than a bend
    own_gap_m = segment_distances_m(fine, fine)[not_adjacent].min() - 2 * outer_m
    assert 0.5 * SELF_GAP_M < own_gap_m < 1.5 * SELF_GAP_M


def test_bend_chords_are_within_50_um_of_arc() -> None:
    line = stirrup_centreline_m(SPEC.size_m, SPEC.diameter_m, RADIUS_M)
    corner = (line.min(axis=0) + line.max(axis=0)) / 2 + [0.135 - 0.025, 0.095 - 0.025, 0.0]
    bend = line[(line[:, 0] >= corner[0] - 1e-9) & (line[:, 1] >= corner[1] - 1e-9)]
    assert len(bend) > 10
    from_centre_m = np.linalg.norm((bend - corner)[:, :2], axis=1)
    np.testing.assert_allclose(from_centre_m, 0.025, atol=1e-12)
    chord_middles = (bend[:-1] + bend[1:]) / 2
    assert (0.025 - np.linalg.norm((chord_middles - corner)[:, :2], axis=1)).max() < 5e-5


@pytest.mark.parametrize(
    ("size_m", "diameter_m"),
    [((0.12, 0.10), 0.010), ((0.03, 0.20), 0.010), ((0.28, 0.20), 0.0), ((float("nan"), 0.2), 0.010)],
)
def test_invalid_stirrups_are_rejected(size_m: tuple[float, float], diameter_m: float) -> None:
    with pytest.raises(ValueError, match=r"no room for hooks|outer radius"):
        stirrup_centreline_m(size_m, diameter_m, outer_radius_m(diameter_m, RIBS))


def test_stored_state_belongs_to_the_stirrups() -> None:
    stirrups = {"stirrups": SPEC.stirrups, "diameter_m": SPEC.diameter_m, "size_m": list(SPEC.size_m)}
    assert stirrups.items() <= STORED["pile"].items()
    poses = load_settled_poses(SPEC)
    assert len(poses) == SPEC.stirrups
    norms = [np.linalg.norm(pose.quaternion_wxyz) for pose in poses]
    np.testing.assert_allclose(norms, 1, atol=1e-9)


def test_stored_state_has_known_digest() -> None:
    digest = hashlib.sha256((STATES_DIR / "pile-0.json").read_bytes()).hexdigest()
    assert digest == "e55162bfe0a5931671a22bbdb5d9640775eb7caeec72cc007b0984c9dcd86932"
