"""The simulation behind the pile: it repeats, its heap rests, and what speaks against a heap is said."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.config.specs import PileSpec
from dataset_builder.scene.assemblies.pile import STATES, Pose, placed_m, settled_poses, stirrup_line_m
from dataset_builder.scene.assemblies.pile_checks import DropSpec, drop_poses, free_markers
from rebar_depth_bench.geometry.aruco_board import BoardSpec

mujoco = pytest.importorskip("mujoco", reason="pip install 'rebar-depth-bench[physics]'")

from dataset_builder.scene.assemblies.pile_simulation import PHYSICS, Settled, dropped, faults, settled  # noqa: E402

SPEC = PileSpec()
STORED = json.loads((STATES / "pile-0.json").read_text())


def moved_m(one: Sequence[Pose], other: Sequence[Pose]) -> float:
    """Return how far any point of a stirrup's line is in another place, metres."""
    line_m = stirrup_line_m(SPEC)
    pairs = zip(one, other, strict=True)
    return float(max(np.linalg.norm(placed_m(line_m, a) - placed_m(line_m, b), axis=1).max() for a, b in pairs))


@pytest.fixture(scope="module")
def resettled() -> Settled:
    """The stored heap, let go once more for half a second."""
    return settled(SPEC, settled_poses(SPEC), replace(PHYSICS, rest_for_s=0.5, limit_s=0.5))


def test_the_stored_heap_stays_where_it_is(resettled: Settled) -> None:
    assert moved_m(resettled.poses, settled_poses(SPEC)) < 1e-6
    assert max(*resettled.speeds, *resettled.spins) < PHYSICS.rest_speed
    assert faults(resettled, SPEC) == []


def test_a_heap_without_board_under_it_would_not_stay() -> None:
    lifted = [
        replace(pose, position_m=(*pose.position_m[:2], pose.position_m[2] + 0.02)) for pose in settled_poses(SPEC)
    ]
    fallen = settled(SPEC, lifted, replace(PHYSICS, rest_for_s=0.5, limit_s=0.2))
    assert moved_m(fallen.poses, lifted) > 0.01


def test_the_same_seed_falls_the_same_way() -> None:
    line_m = stirrup_line_m(SPEC)
    two = replace(SPEC, stirrups=3)
    short = replace(PHYSICS, limit_s=0.25)

    def fallen(seed: int) -> Settled:
        return settled(two, drop_poses(DropSpec(), line_m, 3, np.random.default_rng(seed)), short)

    assert fallen(7) == fallen(7)
    assert moved_m(fallen(7).poses, fallen(8).poses) > 1e-3


@pytest.mark.skipif(
    mujoco.__version__ != STORED["mujoco"] or platform.machine() != STORED["machine"],
    reason="another MuJoCo or processor gives other last digits, and a fall magnifies them",
)
def test_the_stored_heap_is_what_its_seed_makes() -> None:
    heap = dropped(SPEC, STORED["seed"])
    assert moved_m(heap.poses, settled_poses(SPEC)) < 1e-9
    assert heap.gap_m == pytest.approx(STORED["least_gap_m"], abs=1e-9)


def test_faults_are_named(resettled: Settled) -> None:
    level = Pose((0.0, 0.0, 0.02), (1.0, 0.0, 0.0, 0.0))
    far = replace(level, position_m=(0.04, 0.0, 0.02))
    calm = (0.0,) * 6

    def against(**change: object) -> str:
        return "; ".join(faults(replace(resettled, **change), SPEC))  # type: ignore[arg-type]

    assert "still moves at 2.0e-01" in against(speeds=(*calm[1:], 0.2))
    assert "still moves at 3.0e-01" in against(spins=(*calm[1:], 0.3))
    assert "overlaps by 1.1e-04 m" in against(gap_m=-1.1e-4)
    assert "overlapped by 6.0e-03 m on the way" in against(deepest_m=6e-3)
    assert "tilts by 0.0 degrees" in against(poses=(level,) * 6)
    assert "reaches 0.200 m" in against(poses=(far,) * 6)
    assert "leaves only the markers (0, 2, 4) free" in against(poses=(far,) * 6)


def test_markers_are_free_until_steel_comes_near() -> None:
    board = BoardSpec()
    every = (0, 1, 2, 3, 4, 5)
    beside = np.array([[0.05, -0.1, 0.3], [0.05, 0.1, 0.3]])
    assert free_markers([beside], 0.005, board) == every
    edge_m = 0.172 - 0.025 - 0.05 / 6 - 0.005
    assert free_markers([beside * [0, 1, 1] + [edge_m - 1e-6, 0, 0]], 0.005, board) == every
    assert free_markers([beside * [0, 1, 1] + [edge_m + 1e-6, 0, 0]], 0.005, board) == (0, 2, 4)


def test_stirrups_start_apart_whichever_way_they_tilt() -> None:
    line_m = stirrup_line_m(SPEC)
    for seed in range(50):
        starts = drop_poses(DropSpec(tilt_deg=10.0), line_m, 6, np.random.default_rng(seed))
        levels = [placed_m(line_m, pose)[:, 2] for pose in starts]
        assert levels[0].min() > 0.006
        assert all(above.min() - below.max() > 0.011 for below, above in pairwise(levels))


def test_the_command_refuses_in_words(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "dataset_builder.scene.assemblies.pile_simulation",
        "--seed",
        "-1",
        "--out",
        str(tmp_path / "x.json"),
    ]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert refused.returncode == 2
    assert "Traceback" not in refused.stderr
    assert not (tmp_path / "x.json").exists()
