"""Manifest of a dataset folder: what is read from it, and the problems of a damaged one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

import rebar_depth_bench as rdb
from rebar_depth_bench.data.files import views_digest
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import References, Survey, Trajectory, ViewRecord
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.scoring.truth import published_match
from tests.synthetic_dataset import write_split_dataset


@pytest.fixture
def manifest(tiny_root: Path) -> Any:
    return json.loads((tiny_root / "manifest.json").read_text())


SCENE = "configs.lattice.scenes 1:"
SCENES = "configs.lattice.scenes"
SURVEY = {"kind": "survey", "distances_m": [0.5, 1.0], "views_per_distance": 252, "seed": 0}


ZEROS = "sha256:" + "0" * 64


def scene_of(config: Any) -> Any:
    """Return the entry of the only scene of a config."""
    return config["scenes"][0]


def survey(scene: Any, **changes: object) -> None:
    """Replace the trajectory of a scene by a survey."""
    scene["protocol"] = SURVEY | changes


def manifest_problems(folder: Path, manifest: object) -> list[tuple[str, str]]:
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(rdb.DatasetError) as caught:
        open_folder(folder)
    return [(problem.code, problem.where) for problem in caught.value.problems]


def test_survey_is_a_trajectory(manifest: Any, tmp_path: Path) -> None:
    survey(scene_of(manifest["configs"]["lattice"]))
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    config = open_folder(tmp_path).config("lattice")
    assert isinstance(config.scene.trajectory, Survey)
    assert (config.scene.trajectory.views, config.scene.trajectory.distances_m) == (504, (0.5, 1.0))
    assert published_match(config) is None
    assert isinstance(open_folder(tmp_path).config("lattice-orbit").scene.trajectory, Trajectory)


def test_problems_of_head_and_all_configs_are_listed(manifest: Any, tmp_path: Path) -> None:
    del manifest["version"]
    for entry in manifest["configs"].values():
        scene_of(entry)["shards"] = "test.parquet"
    expected = [("missing", "version")] + [
        ("invalid", f"configs.{name}.scenes 1: shards") for name in ("lattice", "lattice-orbit")
    ]
    assert manifest_problems(tmp_path, manifest) == expected


@pytest.mark.parametrize(
    ("content", "code"),
    [(b"", "syntax"), (b'{"format": "a", "format": "b"}', "duplicate"), (b" " * (65 << 20), "size")],
)
def test_manifest_that_is_not_json_is_rejected(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(rdb.DatasetError) as caught:
        open_folder(tmp_path)
    assert [problem.code for problem in caught.value.problems] == [code]


def test_board_is_read_from_manifest(manifest: Any, tmp_path: Path) -> None:
    for entry, markers in zip(manifest["configs"].values(), (12, None), strict=True):
        scene_of(entry)["name"] += str(markers)
        scene_of(entry)["board"] = None if markers is None else scene_of(entry)["board"] | {"markers": markers}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    folder = open_folder(tmp_path)
    assert folder.config("lattice").scene.board == BoardSpec(markers=12)
    assert folder.config("lattice-orbit").scene.board is None


def test_reference_errors_may_be_zero_but_not_negative() -> None:
    zero = {"abs_rel": 0.0, "rmse_cm": 0.0}
    assert References.model_validate({"constant": zero, "one_pixel": zero}).constant.abs_rel == 0.0
    with pytest.raises(ValidationError):
        References.model_validate({"constant": {**zero, "rmse_cm": -1.0}, "one_pixel": zero})


Change = Callable[[Any], object]


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (lambda manifest: manifest.pop("configs"), "missing", "configs"),
        (lambda manifest: manifest.update(format="other"), "invalid", "format"),
        (lambda manifest: manifest.update(configs=[]), "invalid", "configs"),
        (lambda manifest: manifest.update(configs={}), "invalid", "configs"),
        (lambda manifest: manifest.update(version="1\x1b[2J"), "invalid", "version"),
        (lambda manifest: manifest.update(protocol="rebar-0"), "invalid", "protocol"),
        (lambda manifest: manifest["files"].update(x=None), "invalid", "files.x"),
        (lambda manifest: manifest["files"].update({"../x": "0" * 64}), "invalid", "files.../x"),
        (lambda manifest: manifest["ground_truth"].update(digest="sha256:"), "invalid", "ground_truth.digest"),
        (lambda manifest: manifest["ground_truth"].update(digest=ZEROS), "conflict", "ground_truth.digest"),
    ],
)
def test_damaged_head_of_the_manifest_is_named(
    manifest: Any, tmp_path: Path, change: Change, code: str, where: str
) -> None:
    change(manifest)
    assert manifest_problems(tmp_path, manifest) == [(code, where)]


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (lambda config: config.pop("views"), "missing", "views"),
        (lambda config: config.update(views=[]), "invalid", "views"),
        (lambda config: config["views"].append(config["views"][0]), "duplicate", "views"),
        (lambda config: config.update(name="pile"), "conflict", "name"),
        (lambda config: config.update(sheet="../x"), "invalid", "sheet"),
        (lambda config: config.update(sheet="/tmp/x"), "invalid", "sheet"),
        (lambda config: config.update(sheet="a\n"), "invalid", "sheet"),
        (lambda config: config.update(ground_truth_digest="../x"), "invalid", "ground_truth_digest"),
        (lambda config: config.update(ground_truth_digest=ZEROS), "conflict", "ground_truth_digest"),
        (lambda config: config["rig"].update(height="90"), "invalid", "rig.height"),
        (lambda config: config["rig"].update(width=-5), "invalid", "rig.width"),
        (lambda config: config["views"][0].pop("left"), "missing", "views 1: left"),
        (lambda config: config["views"][0].update(left="x"), "invalid", "views 1: left"),
        (lambda config: config["views"][1].update(x=3), "unknown", "views 2: x"),
        (lambda config: config["views"][0].update(scored_px=-1), "invalid", "views 1: scored_px"),
        (lambda config: config["views"][0].update(steel_px=1 << 20, scored_px=1 << 20), "invalid", "views"),
        (lambda config: config["views"][0].update(steel_px=1, scored_px=2), "invalid", "views"),
        (lambda config: config["views"][0].update(view_id="pile/0000"), "invalid", "views"),
    ],
)
def test_damaged_config_of_the_manifest_is_named(
    manifest: Any, tmp_path: Path, change: Change, code: str, where: str
) -> None:
    change(manifest["configs"]["lattice"])
    assert manifest_problems(tmp_path, manifest) == [(code, f"configs.lattice.{where}")]


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (lambda scene: scene["board"].update({"\ud800": 1}), "syntax", ""),
        (lambda scene: scene["board"].update(width_m=float("nan")), "syntax", ""),
        (lambda scene: scene["board"].update(x=1), "unknown", f"{SCENE} board.x"),
        (lambda scene: scene["board"].update(markers="six"), "invalid", f"{SCENE} board.markers"),
        (lambda scene: scene.update(board=7), "invalid", f"{SCENE} board"),
        (lambda scene: scene.pop("board"), "missing", f"{SCENE} board"),
        (lambda scene: scene.update(mesh="../x"), "invalid", f"{SCENE} mesh"),
        (lambda scene: scene.update(mesh=None), "conflict", SCENES),
        (lambda scene: scene.update(mesh="meshes/other.ply"), "conflict", "configs.lattice-orbit.scenes"),
        (lambda scene: scene.update(split="train"), "conflict", SCENES),
        (lambda scene: scene.update(shards=["../x.parquet"]), "invalid", f"{SCENE} shards 1"),
        (lambda scene: scene.update(shards=[]), "invalid", f"{SCENE} shards"),
        (lambda scene: scene["shards"].append(scene["shards"][0]), "duplicate", SCENES),
        (lambda scene: scene.update(protocol=3), "invalid", f"{SCENE} protocol"),
        (lambda scene: scene["protocol"].update(distance_to="steel"), "invalid", f"{SCENE} protocol.distance_to"),
        (lambda scene: survey(scene, distances_m=[1.0, -2.0]), "invalid", f"{SCENE} protocol.distances_m 2"),
        (lambda scene: survey(scene, views_per_distance=252.5), "invalid", f"{SCENE} protocol.views_per_distance"),
        (lambda scene: survey(scene, views_per_distance=1), "conflict", f"{SCENE} protocol_views"),
        (lambda scene: scene.update(protocol_views=8), "conflict", f"{SCENE} protocol_views"),
        (lambda scene: scene.update(protocol_views=476), "conflict", f"{SCENE} protocol_views"),
        (lambda scene: scene.update(protocol_views=505), "conflict", f"{SCENE} protocol_views"),
        (lambda scene: scene.update(protocol_views=-1), "invalid", f"{SCENE} protocol_views"),
        (lambda scene: scene.update(protocol_views="504"), "invalid", f"{SCENE} protocol_views"),
        (lambda scene: scene.update(protocol_views=504.5), "invalid", f"{SCENE} protocol_views"),
    ],
)
def test_damaged_scene_of_the_manifest_is_named(
    manifest: Any, tmp_path: Path, change: Change, code: str, where: str
) -> None:
    change(scene_of(manifest["configs"]["lattice"]))
    assert manifest_problems(tmp_path, manifest) == [(code, where)]


@pytest.mark.parametrize(
    "view_id", ["../../../x/evil", "/lattice/0000", "lattice", "lattice/..", "lattice/0000/1", "a/b\0"]
)
def test_text_that_is_no_view_id_is_refused(manifest: Any, tmp_path: Path, view_id: str) -> None:
    manifest["configs"]["lattice"]["views"][0]["view_id"] = view_id
    assert manifest_problems(tmp_path, manifest) == [("invalid", "configs.lattice.views 1: view_id")]


def remove_views_of_scene(config: Any) -> None:
    config["views"] = [view for view in config["views"] if "train-a-" not in view["view_id"]]
    config["ground_truth_digest"] = views_digest(ViewRecord(**view) for view in config["views"])


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (remove_views_of_scene, "missing", "views"),
        (lambda config: config["views"][0].update(view_id="cages/train-a-x"), "invalid", "views"),
        (lambda config: config["scenes"][1].update(split="test"), "invalid", "views"),
        (lambda config: config["scenes"][1].update(shards=config["scenes"][0]["shards"]), "duplicate", "scenes"),
        (lambda config: config["scenes"][1].update(name="a"), "duplicate", "scenes"),
        (lambda config: config["scenes"][0].update(split="hidden"), "invalid", "scenes 1: split"),
        (lambda config: config["scenes"][1].update(mesh="../x.ply"), "invalid", "scenes 2: mesh"),
        (lambda config: config["scenes"].clear(), "invalid", "scenes"),
        (lambda config: config.update(scenes={"a": 1}), "invalid", "scenes"),
    ],
)
def test_damaged_scenes_of_a_config_with_splits_are_named(
    tmp_path: Path, change: Change, code: str, where: str
) -> None:
    write_split_dataset(tmp_path, {"a": "train", "b": "validation"}, 2)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    change(manifest["configs"]["cages"])
    assert (code, f"configs.cages.{where}") in manifest_problems(tmp_path, manifest)


def test_given_poses_have_one_target_or_as_many_as_positions(manifest: Any, tmp_path: Path) -> None:
    poses = {"kind": "poses", "positions_m": [[0, 0, 1]] * 3, "targets_m": [[0, 0, 0]] * 2}
    scene_of(manifest["configs"]["lattice"])["protocol"] = poses
    assert manifest_problems(tmp_path, manifest) == [("invalid", "configs.lattice.scenes 1: protocol")]
