"""The audit rebuilds cameras from the manifest, for every grid, and names those that differ."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit.cameras import (
    ExpectedView,
    aim_point_of,
    board_spec,
    camera_problems,
    expected_views,
    mesh_aim_point_m,
    protocol_problems,
    protocol_spec,
    rig_spec,
)
from dataset_builder.config.rigs import Camera, rig_cameras
from dataset_builder.config.specs import DomeSpec, RingSpec
from dataset_builder.config.trajectories import poses
from dataset_builder.scene.mesh_ply import write_mesh_ply
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import right_of_rig
from tests.builder.audit.audit_scene import RIGS

Row = dict[str, Any]
AIM_M = np.array([0.0, 0.0, 0.05])
RING = RingSpec(0.4, 40.0, 6)


def entry_of(**values: Any) -> dict[str, Any]:
    """A manifest entry as it comes back from JSON."""
    found: dict[str, Any] = json.loads(json.dumps(values))
    return found


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_comes_back_from_the_manifest(name: str) -> None:
    assert rig_spec("c", entry_of(rig=asdict(RIGS[name]))) == RIGS[name]


@pytest.mark.parametrize("protocol", [RING, DomeSpec((0.2, 0.3), (10.0, 20.0), 5)])
def test_a_protocol_comes_back_from_the_manifest(protocol: RingSpec | DomeSpec) -> None:
    assert protocol_spec("c", entry_of(protocol=asdict(protocol))) == protocol


def test_a_board_and_none_come_back_from_the_manifest() -> None:
    assert board_spec("c", entry_of(scene={"board": asdict(BoardSpec(markers=12))})) == BoardSpec(markers=12)
    assert board_spec("c", entry_of(scene={"board": None})) is None


@pytest.mark.parametrize(
    "entry", [{}, {"rig": None}, {"rig": {"wide": 3}}, {"rig": {"calibration": {"width": 3}}}, {"rig": 7}]
)
def test_a_damaged_rig_is_told_in_words(entry: dict[str, Any]) -> None:
    with pytest.raises((DatasetError), match="the rig of config c is"):
        rig_spec("c", entry)


def test_a_rig_that_gives_no_cameras_is_told_in_words() -> None:
    rig = asdict(replace(RIGS["raw"], grid="fish"))
    entry = entry_of(rig=rig, protocol=asdict(RING), views=[{"view_id": "c/0000"}])
    with pytest.raises(DatasetError, match=r"the rig of config c gives no cameras: .*fish"):
        expected_views("c", entry, AIM_M)


def row_of(cameras: dict[str, Camera], baseline_m: float) -> Row:
    row: Row = {"baseline_m": baseline_m}
    for eye, camera in cameras.items():
        row |= {f"{eye}_{kind}": getattr(camera, kind) for kind in ("K", "distortion", "cam_from_world")}
        row[f"{eye}_depth"] = np.zeros((camera.height, camera.width), np.float32)
    return row


@pytest.fixture(params=list(RIGS))
def seen(request: pytest.FixtureRequest) -> tuple[Row, ExpectedView]:
    rig = RIGS[request.param]
    views = [{"view_id": f"c/{index:04d}"} for index in (1, 3, 5)]
    entry = entry_of(rig=asdict(rig), protocol=asdict(RING), views=views)
    expected = expected_views("c", entry, AIM_M)
    assert list(protocol_problems(entry, expected)) == []
    pose = poses(RING, AIM_M, rig)[3]
    return row_of(rig_cameras(rig, pose), rig.baseline_m), expected[1]


def test_good_cameras_pass_on_every_grid(seen: tuple[Row, ExpectedView]) -> None:
    assert list(camera_problems(*seen)) == []


def nudged(pose: np.ndarray, by: float) -> np.ndarray:
    pose = pose.copy()
    pose[0, 3] += by
    return pose


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda row: {"left_K": row["left_K"] + 1e-9}, "left_K is 1.0e-09 off"),
        (lambda row: {"right_distortion": row["right_distortion"] + 1e-9}, "right_distortion is 1.0e-09 off"),
        (lambda row: {"left_cam_from_world": nudged(row["left_cam_from_world"], 1e-9)}, "left_cam_from_world is"),
        (lambda row: {"right_cam_from_world": nudged(row["right_cam_from_world"], 1e-6)}, "the eyes stand 0.1"),
        (lambda row: {"left_cam_from_world": 1.001 * row["left_cam_from_world"]}, "no rigid pose"),
        (lambda row: {"left_cam_from_world": row["left_cam_from_world"] * [[-1], [1], [1], [1]]}, "no rigid pose"),
        (lambda _: {"baseline_m": 0.12001}, "baseline_m is 0.12001, expected 0.12"),
        (lambda row: {"left_depth": row["left_depth"][1:]}, "left grid is"),
    ],
)
def test_every_other_camera_is_named(
    seen: tuple[Row, ExpectedView], damage: Callable[[Row], Row], words: str
) -> None:
    row, expected = seen
    problems = list(camera_problems({**row, **damage(row)}, expected))
    assert any(words in problem for problem in problems), problems


def test_a_right_camera_beside_its_place_is_named_on_the_ideal_grid() -> None:
    pose = poses(RING, AIM_M, RIGS["ideal"])[0]
    cameras = rig_cameras(RIGS["ideal"], pose)
    row = row_of(cameras, 0.12)
    row["right_cam_from_world"] = right_of_rig(pose, 0.122)
    problems = list(camera_problems(row, ExpectedView("c/0000", cameras, 0.12)))
    assert [problem.partition(" is ")[0] for problem in problems[:1]] == ["right_cam_from_world"]
    assert any("the eyes stand 0.122" in problem for problem in problems)


def test_rows_of_a_real_build_have_the_manifests_cameras(tiny_root: Path) -> None:
    entry = open_folder(tiny_root).config("lattice")
    aim_m, problems = aim_point_of(entry, tiny_root / entry["mesh"])
    assert problems == ()
    assert aim_m == pytest.approx([0, 0, 0.05], abs=1e-3)
    expected = expected_views("lattice", entry, aim_m)
    for row, view in zip(rdb.load(tiny_root, "lattice"), expected, strict=True):
        assert row["view_id"] == view.view_id
        assert list(camera_problems(row, view)) == []
    higher = expected_views("lattice", entry, aim_m + np.array([0, 0, 0.001]))
    assert list(camera_problems(rdb.load(tiny_root, "lattice")[0], higher[0]))


def test_views_of_another_index_are_named() -> None:
    views = [{"view_id": "c/0001"}, {"view_id": "c/0002"}]
    entry = entry_of(rig=asdict(RIGS["ideal"]), protocol=asdict(RING), views=views)
    found = list(protocol_problems(entry, expected_views("c", entry, AIM_M)))
    assert len(found) == 1
    assert found[0].endswith("the first that differs is c/0002, expected c/0004")
    more = entry_of(rig=asdict(RIGS["ideal"]), protocol=asdict(RING), views=[*views * 4])
    assert len(list(protocol_problems(more, expected_views("c", more, AIM_M)))) == 1


def test_the_aim_point_is_the_steels_middle_and_not_the_rooms(tmp_path: Path) -> None:
    vertices_m = np.array([[0.1, 0, 0], [0.3, 0, 0.2], [0.1, 0.4, 0], [9, 9, 9], [-9, 9, 0], [0, 1, 1]])
    mesh = tmp_path / "m.ply"
    write_mesh_ply(mesh, vertices_m, np.array([[0, 1, 2], [3, 4, 5]]), np.array([4, 0]))
    assert mesh_aim_point_m(mesh).tolist() == [0.2, 0.2, 0.1]
    assert aim_point_of({}, mesh)[0].tolist() == [0.2, 0.2, 0.1]
    aim_m, problems = aim_point_of({"aim_point_m": [0.2, 0.2, 0.101]}, mesh)
    assert (aim_m.tolist(), problems) == ([0.2, 0.2, 0.101], ())
    for wrong in ([0.2, 0.2, 0.11], [0.2, 0.2], [0.2, 0.2, float("nan")]):
        aim_m, problems = aim_point_of({"aim_point_m": wrong}, mesh)
        assert aim_m.tolist() == [0.2, 0.2, 0.1]
        assert "the steel's middle is [0.2, 0.2, 0.1]" in problems[0]


def test_a_mesh_without_steel_is_told_in_words(tmp_path: Path) -> None:
    mesh = tmp_path / "m.ply"
    write_mesh_ply(mesh, np.eye(3), np.array([[0, 1, 2]]), np.array([0]))
    with pytest.raises(DatasetError, match="holds no steel"):
        mesh_aim_point_m(mesh)
