"""Pile: bent stirrups at rest that intersect neither each other nor the board, and the simulated fall."""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.scene.assemblies.pile import (
    RIBS,
    STATES_DIR,
    Pose,
    load_settled_poses,
    pile_assembly,
    points_in_world_m,
    spec_centreline_m,
)
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.bending import resample_polyline_m
from dataset_builder.scene.shapes.links import SELF_GAP_M, hook_extension_m, stirrup_centreline_m
from dataset_builder.specs.config_specs import PileSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from scripts import simulate_pile
from scripts.simulate_pile import (
    PHYSICS,
    DropSpec,
    SettledPile,
    drop_pile,
    drop_poses,
    find_problems,
    free_markers,
    simulate_drop,
)
from tests.builder.scene.cages import (
    Line,
    least_gap_m,
    line_length_m,
    point_distances_m,
    segment_distances_m,
    segments_m,
)

SPEC = PileSpec()
RADIUS_M = outer_radius_m(SPEC.diameter_m, RIBS)
STATE = STATES_DIR / "pile-0.json"
STORED = json.loads(STATE.read_text())


@pytest.fixture(scope="module")
def pile() -> Assembly:
    return pile_assembly(SPEC)


@pytest.fixture(scope="module")
def lines_m(pile: Assembly) -> list[Line]:
    return [np.array(bar.axis_m) for bar in pile.bars]


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


def test_bars_touch_without_intersection(lines_m: list[Line], pile: Assembly) -> None:
    assert -1e-4 < least_gap_m(pile, lambda _: RADIUS_M) < 1e-4, "a heap whose bars do not lie on each other"
    lowest_m = min(line[:, 2].min() for line in lines_m) - RADIUS_M
    assert -1e-4 < lowest_m < 1e-4
    for part, line_m in zip(pile.parts, lines_m, strict=True):
        assert part.mesh.vertices_m[:, 2].min() >= lowest_m
        assert point_distances_m(part.mesh.vertices_m[::97], segments_m(line_m)).max() < RADIUS_M + 1e-9


def developed_length_m(size_m: tuple[float, float], diameter_m: float) -> float:
    """Return the bar length as in a bending schedule: sides minus corners, three 90-degree bends, two hooks."""
    radius_m = 2.5 * diameter_m  # half the mandrel of 4 d plus half the bar
    sides_m = 2 * (size_m[0] - diameter_m) + 2 * (size_m[1] - diameter_m) - 8 * radius_m
    total_bend_deg = 3 * 90 + 2 * 135
    planar_length_m = sides_m + np.deg2rad(total_bend_deg) * radius_m + 2 * max(6 * diameter_m, 0.075)
    loop_length_m = sides_m + 2 * np.pi * radius_m
    outer_m = 2 * outer_radius_m(diameter_m, RIBS) + SELF_GAP_M
    return float(planar_length_m * np.hypot(1.0, outer_m / loop_length_m))


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
    assert line_length_m(line) == pytest.approx(developed_length_m(size_m, diameter_m), rel=4e-4)
    np.testing.assert_allclose(np.average((line[:-1] + line[1:]) / 2, axis=0, weights=legs_m), 0.0, atol=1e-12)

    flat = np.diff(line[:, :2], axis=0)
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
    fine = resample_polyline_m(line, 0.005)
    index = np.arange(len(fine) - 1)
    not_adjacent = np.abs(index[:, None] - index) > 16  # 80 mm along the bar, which is longer than a bend
    own_gap_m = segment_distances_m(segments_m(fine), segments_m(fine))[not_adjacent].min() - 2 * outer_m
    assert 0.5 * SELF_GAP_M < own_gap_m < 1.5 * SELF_GAP_M


@pytest.mark.parametrize(
    ("size_m", "diameter_m"),
    [((0.12, 0.10), 0.010), ((0.03, 0.20), 0.010), ((0.28, 0.20), 0.0), ((float("nan"), 0.2), 0.010)],
)
def test_invalid_stirrups_are_rejected(size_m: tuple[float, float], diameter_m: float) -> None:
    with pytest.raises(ValueError, match=r"no room for hooks|outer radius"):
        stirrup_centreline_m(size_m, diameter_m, outer_radius_m(diameter_m, RIBS))


def test_stored_state_is_the_known_one_and_belongs_to_the_stirrups() -> None:
    digest = hashlib.sha256(STATE.read_bytes()).hexdigest()
    assert digest == "e55162bfe0a5931671a22bbdb5d9640775eb7caeec72cc007b0984c9dcd86932"
    stirrups = {"stirrups": SPEC.stirrups, "diameter_m": SPEC.diameter_m, "size_m": list(SPEC.size_m)}
    assert stirrups.items() <= STORED["pile"].items()
    poses = load_settled_poses(SPEC)
    assert len(poses) == SPEC.stirrups
    norms = [np.linalg.norm(pose.quaternion_wxyz) for pose in poses]
    np.testing.assert_allclose(norms, 1, atol=1e-9)


def max_displacement_m(poses: Sequence[Pose], other_poses: Sequence[Pose]) -> float:
    """Return the largest displacement of any centreline point between two sets of poses, metres."""
    line_m = spec_centreline_m(SPEC)
    pairs = zip(poses, other_poses, strict=True)
    return float(
        max(
            np.linalg.norm(points_in_world_m(line_m, a) - points_in_world_m(line_m, b), axis=1).max()
            for a, b in pairs
        )
    )


@pytest.fixture(scope="module")
def resettled() -> SettledPile:
    """Return the stored pile after another half second of simulation."""
    return simulate_drop(SPEC, load_settled_poses(SPEC), replace(PHYSICS, rest_for_s=0.5, limit_s=0.5))


@pytest.mark.slow
def test_stored_pile_is_at_rest(resettled: SettledPile) -> None:
    assert max_displacement_m(resettled.poses, load_settled_poses(SPEC)) < 1e-6
    assert max(*resettled.speeds, *resettled.spins) < PHYSICS.rest_speed
    assert find_problems(resettled, SPEC) == []


@pytest.mark.slow
def test_drop_depends_only_on_seed() -> None:
    line_m = spec_centreline_m(SPEC)
    spec = replace(SPEC, stirrups=3)
    physics = replace(PHYSICS, limit_s=0.25)

    def drop(seed: int) -> SettledPile:
        return simulate_drop(spec, drop_poses(DropSpec(), line_m, 3, np.random.default_rng(seed)), physics)

    assert drop(7) == drop(7)
    assert max_displacement_m(drop(7).poses, drop(8).poses) > 1e-3


@pytest.mark.slow
@pytest.mark.skipif(
    mujoco.__version__ != STORED["mujoco"] or platform.machine() != STORED["machine"],
    reason="another MuJoCo or processor gives other last digits, and a fall magnifies them",
)
def test_stored_pile_is_reproduced_from_seed() -> None:
    pile = drop_pile(SPEC, STORED["seed"])
    assert max_displacement_m(pile.poses, load_settled_poses(SPEC)) < 1e-9
    assert pile.gap_m == pytest.approx(STORED["least_gap_m"], abs=1e-9)


@pytest.mark.slow
def test_problems_are_reported(resettled: SettledPile) -> None:
    level = Pose((0.0, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0))
    far = replace(level, position_m=(0.04, 0.0, 0.02))
    calm = (0.0,) * 6

    def problems_with(**change: object) -> str:
        return "; ".join(find_problems(replace(resettled, **change), SPEC))  # type: ignore[arg-type]

    assert "still moves at 2.0e-01" in problems_with(speeds=(*calm[1:], 0.2))
    assert "still moves at 3.0e-01" in problems_with(spins=(*calm[1:], 0.3))
    assert "overlaps by 1.1e-04 m" in problems_with(gap_m=-1.1e-4)
    assert "overlapped by 6.0e-03 m on the way" in problems_with(deepest_m=6e-3)
    assert "tilts by 0.0 degrees" in problems_with(poses=(level,) * 6)
    assert "reaches 0.200 m" in problems_with(poses=(far,) * 6)
    assert "leaves only the markers (0, 2, 4) free" in problems_with(poses=(far,) * 6)


def test_marker_is_free_unless_steel_is_near() -> None:
    board = BoardSpec()
    all_markers = (0, 1, 2, 3, 4, 5)
    line_m = np.array([[0.05, -0.1, 0.3], [0.05, 0.1, 0.3]])
    assert free_markers([line_m], 0.005, board) == all_markers
    edge_m = 0.172 - 0.025 - 0.05 / 6 - 0.005
    assert free_markers([line_m * [0, 1, 1] + [edge_m - 1e-6, 0, 0]], 0.005, board) == all_markers
    assert free_markers([line_m * [0, 1, 1] + [edge_m + 1e-6, 0, 0]], 0.005, board) == (0, 2, 4)


def test_initial_stirrups_are_vertically_separated() -> None:
    line_m = spec_centreline_m(SPEC)
    for seed in range(50):
        starts = drop_poses(DropSpec(tilt_deg=10.0), line_m, 6, np.random.default_rng(seed))
        heights_m = [points_in_world_m(line_m, pose)[:, 2] for pose in starts]
        assert heights_m[0].min() > 0.006
        assert all(above.min() - below.max() > 0.011 for below, above in pairwise(heights_m))


def test_command_rejects_negative_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["simulate_pile", "--seed", "-1", "--out", str(tmp_path / "x.json")])
    with pytest.raises(SystemExit, match="2"):
        simulate_pile.main()
    assert "-1 is not a valid seed" in capsys.readouterr().err
    assert not (tmp_path / "x.json").exists()
