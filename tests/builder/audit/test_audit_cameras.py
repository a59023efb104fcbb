"""Audit of cameras: reconstruction from the manifest for every grid, and reported deviations."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit.camera_checks import (
    ExpectedView,
    camera_problems,
    checked_aim_point_m,
    expected_views,
    mesh_aim_point_m,
    view_list_problems,
)
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.steel_distance import Cylinders
from dataset_builder.cameras.trajectories import poses
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.specs.config_specs import DomeSpec, RandomViewsSpec, RingSpec
from dataset_builder.specs.manifest_specs import rig_spec, trajectory_spec
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.schema import Scene, ViewRecord, trajectory_of
from rebar_depth_bench.geometry.cameras import Camera, camera_centre, right_camera_pose
from tests.builder.audit.audit_scene import RIGS

Row = dict[str, Any]
AIM_M = np.array([0.0, 0.0, 0.05])
RING = RingSpec(0.4, 40.0, 6)
DOME = DomeSpec((0.2, 0.3), (10.0, 20.0), 5)


def manifest_config(view_ids: Sequence[str] = (), **entry: Any) -> DatasetConfig:
    """Return a config with the given views and the entry of its scene, after a JSON round trip."""
    truth = {"left": "0" * 64, "right": "0" * 64, "steel_px": 0, "scored_px": 0}
    views = tuple(ViewRecord.model_validate({"view_id": view_id, **truth}) for view_id in view_ids)
    written = json.loads(json.dumps(entry))
    protocol = trajectory_of(written["protocol"]) if "protocol" in written else None
    scene = Scene.model_construct(
        name="s", split="test", protocol=protocol, aim_point_m=written.get("aim_point_m"), entry=written
    )
    return DatasetConfig.model_construct(root="x", name="c", has_splits=False, views=views, scenes=(scene,))


@pytest.mark.parametrize("name", RIGS)
def test_rig_is_read_from_manifest(name: str) -> None:
    assert rig_spec(manifest_config(rig=asdict(RIGS[name]))) == RIGS[name]


@pytest.mark.parametrize("protocol", [RING, DOME, replace(DOME, distance_to="nearest steel")])
def test_trajectory_is_read_from_manifest(protocol: RingSpec | DomeSpec) -> None:
    assert trajectory_spec(manifest_config(protocol=asdict(protocol))) == protocol


def test_dome_of_older_folder_is_measured_to_centre() -> None:
    older = {key: value for key, value in asdict(DOME).items() if key != "distance_to"}
    assert trajectory_spec(manifest_config(protocol=older)) == DOME


def test_dome_measured_to_steel_needs_bars_of_its_scene() -> None:
    protocol = asdict(replace(DOME, distance_to="nearest steel"))
    config = manifest_config(["c/0000"], rig=asdict(RIGS["ideal"]), protocol=protocol)
    with pytest.raises(DatasetError, match="the protocol or rig of config c is invalid: there are no bars"):
        expected_views(config, AIM_M)
    bar = Bar(1, "bar", 0.02, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)))
    [view] = expected_views(config, AIM_M, [bar])
    centre_m = camera_centre(view.cameras["left"].cam_from_world)
    assert Cylinders.from_bars([bar]).distance_m(centre_m[None])[0] == pytest.approx(0.3, abs=0.00051)


@pytest.mark.parametrize(
    ("entry", "place"),
    [
        ({}, "rig"),
        ({"rig": None}, "rig"),
        ({"rig": {"wide": 3}}, "rig.wide"),
        ({"rig": {"baseline_m": "1"}}, "rig.baseline_m"),
        ({"rig": {"calibration": {"width": 3}}}, "rig.calibration.height"),
        ({"rig": 7}, "rig"),
    ],
)
def test_damaged_rig_is_rejected(entry: dict[str, Any], place: str) -> None:
    with pytest.raises(DatasetError) as caught:
        rig_spec(manifest_config(**entry))
    assert caught.value.problems[0].where == f"configs.c.scenes.s.{place}"


def test_damaged_trajectory_is_rejected() -> None:
    protocol = {**asdict(RandomViewsSpec(2)), "stations": [[[0, 0, "1"], [0, 0, 0], 0]]}
    with pytest.raises(DatasetError, match=r"protocol\.stations 1: 1: 3: got '1', expected a valid number"):
        trajectory_spec(manifest_config(protocol=protocol))


def test_rig_with_unknown_grid_is_rejected() -> None:
    rig = asdict(replace(RIGS["raw"], grid="fish"))
    config = manifest_config(["c/0000"], rig=rig, protocol=asdict(RING))
    with pytest.raises(DatasetError, match=r"the protocol or rig of config c is invalid: .*fish"):
        expected_views(config, AIM_M)


def make_row(cameras: dict[str, Camera], baseline_m: float) -> Row:
    row: Row = {"baseline_m": baseline_m}
    for eye, camera in cameras.items():
        row |= {f"{eye}_{kind}": getattr(camera, kind) for kind in ("K", "distortion", "cam_from_world")}
    return row


@pytest.fixture(params=list(RIGS))
def row_and_expected(request: pytest.FixtureRequest) -> tuple[Row, ExpectedView]:
    rig = RIGS[request.param]
    view_ids = [f"c/{index:04d}" for index in (1, 3, 5)]
    config = manifest_config(view_ids, rig=asdict(rig), protocol=asdict(RING))
    expected = expected_views(config, AIM_M)
    assert list(view_list_problems(config, expected)) == []
    pose = poses(RING, AIM_M, rig)[3]
    return make_row(rig_cameras(rig, pose), rig.baseline_m), expected[1]


def test_correct_cameras_pass_on_every_grid(row_and_expected: tuple[Row, ExpectedView]) -> None:
    assert list(camera_problems(*row_and_expected)) == []


def shifted_pose(pose: np.ndarray, shift_m: float) -> np.ndarray:
    pose = pose.copy()
    pose[0, 3] += shift_m
    return pose


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda row: {"left_K": row["left_K"] + 1e-9}, "left_K differs by 1.0e-09"),
        (lambda row: {"right_distortion": row["right_distortion"] + 1e-9}, "right_distortion differs by 1.0e-09"),
        (
            lambda row: {"left_cam_from_world": shifted_pose(row["left_cam_from_world"], 1e-9)},
            "left_cam_from_world differs",
        ),
        (
            lambda row: {"right_cam_from_world": shifted_pose(row["right_cam_from_world"], 1e-6)},
            "the camera centres are 0.1",
        ),
        (lambda row: {"left_cam_from_world": 1.001 * row["left_cam_from_world"]}, "not a rigid pose"),
        (
            lambda row: {"left_cam_from_world": row["left_cam_from_world"] * [[-1], [1], [1], [1]]},
            "not a rigid pose",
        ),
        (lambda _: {"baseline_m": 0.12001}, "baseline_m is 0.12001, expected 0.12"),
    ],
)
def test_deviating_cameras_are_reported(
    row_and_expected: tuple[Row, ExpectedView], damage: Callable[[Row], Row], words: str
) -> None:
    row, expected = row_and_expected
    problems = list(camera_problems({**row, **damage(row)}, expected))
    assert any(words in problem for problem in problems), problems


def test_displaced_right_camera_is_reported() -> None:
    pose = poses(RING, AIM_M, RIGS["ideal"])[0]
    cameras = rig_cameras(RIGS["ideal"], pose)
    row = make_row(cameras, 0.12)
    row["right_cam_from_world"] = right_camera_pose(pose, 0.122)
    problems = list(camera_problems(row, ExpectedView("c/0000", cameras, 0.12)))
    assert [problem.partition(" ")[0] for problem in problems[:1]] == ["right_cam_from_world"]
    assert any("the camera centres are 0.122" in problem for problem in problems)


@pytest.mark.slow
def test_cameras_of_rendered_dataset_match_manifest(tiny_root: Path) -> None:
    config = open_folder(tiny_root).config("lattice")
    aim_m, problems = checked_aim_point_m(config, tiny_root / config.mesh)
    assert problems == ()
    assert aim_m == pytest.approx([0, 0, 0.05], abs=1e-3)
    expected = expected_views(config, aim_m)
    for row, view in zip(rdb.load(tiny_root, "lattice"), expected, strict=True):
        assert row["view_id"] == view.view_id
        assert list(camera_problems(row, view)) == []
    higher = expected_views(config, aim_m + np.array([0, 0, 0.001]))
    assert list(camera_problems(rdb.load(tiny_root, "lattice")[0], higher[0]))


def test_wrong_view_indices_are_reported() -> None:
    view_ids = ["c/0001", "c/0002"]
    entry = {"rig": asdict(RIGS["ideal"]), "protocol": asdict(RING)}
    config = manifest_config(view_ids, **entry)
    problems = list(view_list_problems(config, expected_views(config, AIM_M)))
    assert len(problems) == 1
    assert problems[0].endswith("the first difference is c/0002, expected c/0004")
    repeated = manifest_config(view_ids * 4, **entry)
    assert len(list(view_list_problems(repeated, expected_views(repeated, AIM_M)))) == 1


def test_aim_point_is_centre_of_steel_only(tmp_path: Path) -> None:
    vertices_m = np.array([[0.1, 0, 0], [0.3, 0, 0.2], [0.1, 0.4, 0], [9, 9, 9], [-9, 9, 0], [0, 1, 1]])
    mesh = tmp_path / "m.ply"
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    write_mesh_ply(mesh, WorldMesh(vertices_m, faces, np.array([4, 0], np.uint16)))
    assert mesh_aim_point_m(mesh).tolist() == [0.2, 0.2, 0.1]
    assert checked_aim_point_m(manifest_config(), mesh)[0].tolist() == [0.2, 0.2, 0.1]
    aim_m, problems = checked_aim_point_m(manifest_config(aim_point_m=[0.2, 0.2, 0.101]), mesh)
    assert (aim_m.tolist(), problems) == ([0.2, 0.2, 0.101], ())
    aim_m, problems = checked_aim_point_m(manifest_config(aim_point_m=[0.2, 0.2, 0.11]), mesh)
    assert aim_m.tolist() == [0.2, 0.2, 0.1]
    assert "expected [0.2, 0.2, 0.1], the centre of the steel" in problems[0]


def test_mesh_without_steel_is_rejected(tmp_path: Path) -> None:
    mesh = tmp_path / "m.ply"
    write_mesh_ply(mesh, WorldMesh(np.eye(3), np.array([[0, 1, 2]], np.int32), np.zeros(1, np.uint16)))
    with pytest.raises(DatasetError, match="contains no steel"):
        mesh_aim_point_m(mesh)
