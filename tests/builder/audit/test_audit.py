"""Audit of a dataset folder: a correct one passes, and defects of files, rows and cameras are reported."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.audit.auditing import VIEW_CHECKS, check_crossings, row_problems
from dataset_builder.audit.camera_checks import (
    ExpectedView,
    camera_problems,
    checked_aim_point_m,
    expected_views,
    mesh_aim_point_m,
    view_list_problems,
)
from dataset_builder.audit.checks import RayCache, view_from_row
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import Cylinders, poses
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.specs.config_specs import DistanceSweepSpec, DomeSpec, RandomViewsSpec, RingSpec
from dataset_builder.specs.manifest_specs import rig_spec, trajectory_spec
from rebar_depth_bench.bar_crossings.crossings_file import write_crossings
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar, read_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.schema import Scene, ViewRecord, trajectory_of
from rebar_depth_bench.geometry.cameras import Camera, camera_centre
from tests.builder.audit.audit_scene import RIGS

Row = dict[str, Any]


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(tiny_root, tmp_path / "dataset"))


@pytest.fixture(scope="module")
def row(tiny_root: Path) -> Row:
    loaded: Row = rdb.load(tiny_root, "lattice")[4]
    return loaded


@pytest.mark.usefixtures("blender")
def test_correct_dataset_passes_with_measured_values(tiny_root: Path) -> None:
    command = [sys.executable, "-m", "dataset_builder", "audit", str(tiny_root), "--depth-views", "2"]
    process = subprocess.run(command, capture_output=True, text=True, check=False, env={"COLUMNS": "160"})
    assert process.returncode == 0, process.stdout + process.stderr
    assert "FAILED" not in process.stdout
    assert (process.stdout.count(" ok "), process.stdout.count("skipped")) == (
        2 + 2 * (3 + len(VIEW_CHECKS)),
        2,
    )  # No planes.
    assert "2 views: median 0.0" in process.stdout  # micrometre agreement with Cycles


def failed_checks(root: Path) -> dict[str, tuple[str, ...]]:
    return {check.name: check.problems for check in audit(root, depth_views=0).failures}


def test_changed_missing_and_extra_files_are_reported(copy: Path) -> None:
    mesh = copy / "meshes" / "lattice.ply"
    mesh.write_bytes(mesh.read_bytes()[:-1] + b"\x7f")
    (copy / "bars.parquet").unlink()
    (copy / "lattice" / "extra.txt").write_text("")
    problems = failed_checks(copy)["files against the manifest"]
    assert len(problems) == 3
    assert any(problem.startswith("meshes/lattice.ply: SHA-256 is") for problem in problems)
    assert "bars.parquet: is missing" in problems
    assert "lattice/extra.txt: is not in the manifest" in problems


def test_crossings_that_are_not_those_of_the_bars_are_reported(copy: Path) -> None:
    bars = read_bars(copy / "bars.parquet")
    write_crossings(copy / "crossings.parquet", {scene: of_scene[:-1] for scene, of_scene in bars.items()})
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["files"]["crossings.parquet"] = file_sha256(copy / "crossings.parquet")
    (copy / "manifest.json").write_text(json.dumps(manifest))
    folder = open_folder(copy)
    check = check_crossings(folder, bars)
    assert check.problems == ("crossings.parquet: scene lattice differs from the crossings of its bars",)
    write_crossings(copy / "crossings.parquet", bars)
    folder.files["crossings.parquet"] = file_sha256(copy / "crossings.parquet")
    assert check_crossings(folder, bars).measured == "375 crossings"
    assert check_crossings(folder, bars).passed


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda row: {"left_mask": ~row["left_mask"]}, "left: the mask differs from"),
        (lambda row: {"left_depth": 0 * row["left_depth"]}, "left: steel pixels without depth"),
        (lambda row: {"right_bars": np.where(row["right_mask"], 999, 0).astype(np.uint16)}, "bar ids [999]"),
        (lambda row: {"left_depth": row["left_depth"] * np.float32(1.000001)}, "left ground-truth digest"),
        (lambda row: {"right_K": row["right_K"] + 1e-9}, "right ground-truth digest differs"),
        (lambda _: {"view_id": "lattice/0001"}, "the row's view_id is lattice/0001"),
    ],
)
def test_broken_row_invariants_are_reported(
    tiny_root: Path, row: Row, damage: Callable[[Row], Row], words: str
) -> None:
    record = open_folder(tiny_root).config("lattice").views[4]
    bar_ids = {bar.bar_id for bar in read_bars(tiny_root / "bars.parquet")["lattice"]}
    assert list(row_problems(view_from_row(row, RayCache()), record, bar_ids)) == []
    damaged = view_from_row({**row, **damage(row)}, RayCache())
    problems = list(row_problems(damaged, record, bar_ids))
    assert any(words in problem for problem in problems), problems
    other_count = record.model_copy(update={"scored_px": 1})
    assert list(row_problems(view_from_row(row, RayCache()), other_count, bar_ids)) == [
        "steel and scored pixel counts differ from the manifest's"
    ]


@pytest.mark.slow
def test_swapped_rows_and_other_cameras_of_the_manifest_are_reported(copy: Path) -> None:
    """Swap two views in a shard, and change the baseline and a radius in the manifest."""
    shard = next(copy.glob("lattice/*00000-of*.parquet"))
    table = pq.read_table(shard)
    pq.write_table(table.take([1, 0, *range(2, table.num_rows)]), shard)
    manifest = json.loads((copy / "manifest.json").read_text())
    manifest["files"][shard.relative_to(copy).as_posix()] = file_sha256(shard)
    manifest["configs"]["lattice"]["scenes"][0]["rig"]["baseline_m"] = 0.121
    manifest["configs"]["lattice-orbit"]["scenes"][0]["protocol"]["radius_m"] = 0.326
    (copy / "manifest.json").write_text(json.dumps(manifest))
    failures = failed_checks(copy)
    assert set(failures) == {"lattice: rows", "lattice: cameras", "lattice-orbit: cameras"}
    assert any("the row's view_id is" in problem for problem in failures["lattice: rows"])
    assert any("baseline_m is 0.12, expected 0.121" in problem for problem in failures["lattice: cameras"])
    assert all("cam_from_world differs by" in problem for problem in failures["lattice-orbit: cameras"])


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


def test_trajectory_is_read_from_manifest() -> None:
    sweep = DistanceSweepSpec((0.2, 0.4), 40.0, 8)
    for protocol in (RING, DOME, replace(DOME, distance_to="nearest steel"), sweep):
        assert trajectory_spec(manifest_config(protocol=asdict(protocol))) == protocol
    older = {key: value for key, value in asdict(DOME).items() if key != "distance_to"}
    assert trajectory_spec(manifest_config(protocol=older)) == DOME, "folders of earlier versions"


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
            "left_cam_from_world",
        ),
        (
            lambda row: {"right_cam_from_world": shifted_pose(row["right_cam_from_world"], 1e-6)},
            "the camera centres are 0.1",
        ),
        (lambda row: {"left_cam_from_world": 1.001 * row["left_cam_from_world"]}, "not a rigid pose"),
        (lambda row: {"left_cam_from_world": np.diag([-1, 1, 1, 1]) @ row["left_cam_from_world"]}, "not a rigid"),
        (lambda _: {"baseline_m": 0.12001}, "baseline_m is 0.12001, expected 0.12"),
    ],
)
def test_deviating_cameras_are_reported(
    row_and_expected: tuple[Row, ExpectedView], damage: Callable[[Row], Row], words: str
) -> None:
    row, expected = row_and_expected
    assert list(camera_problems(row, expected)) == []
    problems = list(camera_problems({**row, **damage(row)}, expected))
    assert any(words in problem for problem in problems), problems


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
