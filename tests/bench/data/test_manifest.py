"""Manifest of a dataset folder: what is read from it, and the problems of a damaged one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.files import MANIFEST_FILE, views_digest
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import References, Survey, Trajectory, ViewRecord
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.scoring.truth import published_match


@pytest.fixture
def manifest(tiny_root: Path) -> Any:
    return json.loads((tiny_root / "manifest.json").read_text())


SCENE = "configs.lattice.scenes 1:"
BOARD = f"{SCENE} board"
PROTOCOL_VIEWS = f"{SCENE} protocol_views"
SURVEY = {
    "kind": "survey",
    "distances_m": [0.5, 1.0],
    "views_per_distance": 252,
    "seed": 0,
}
SURVEY_PLACE = f"{SCENE} protocol"
ORBIT_SCENES = "configs.lattice-orbit.scenes"
FIRST_SHARD = "lattice/test-00000-of-00002-e9a69d9d4973.parquet"
ZEROS = "sha256:" + "0" * 64


def scene_of(config: Any) -> Any:
    """Return the entry of the only scene of a config."""
    return config["scenes"][0]


def manifest_problems(folder: Path, manifest: object) -> list[tuple[str, str]]:
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(rdb.DatasetError) as caught:
        open_folder(folder)
    return [(problem.code, problem.where) for problem in caught.value.problems]


def test_survey_is_a_trajectory(manifest: Any, tmp_path: Path) -> None:
    scene_of(manifest["configs"]["lattice"])["protocol"] = SURVEY
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    config = open_folder(tmp_path).config("lattice")
    assert isinstance(config.scene.protocol, Survey)
    assert (config.scene.protocol.views, config.scene.protocol.distances_m) == (504, (0.5, 1.0))
    assert published_match(config) is None
    assert isinstance(open_folder(tmp_path).config("lattice-orbit").scene.protocol, Trajectory)


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (lambda manifest, _: manifest.pop("configs"), "missing", "configs"),
        (lambda manifest, _: manifest.update(format="other"), "invalid", "format"),
        (lambda manifest, _: manifest.update(configs=[]), "invalid", "configs"),
        (lambda manifest, _: manifest["files"].update(x=None), "invalid", "files.x"),
        (lambda manifest, _: manifest["files"].update({"../x": "0" * 64}), "invalid", "files.../x"),
        (lambda manifest, _: manifest["ground_truth"].update(digest="sha256:"), "invalid", "ground_truth.digest"),
        (lambda _, config: config.pop("views"), "missing", "configs.lattice.views"),
        (lambda _, config: config["views"][0].pop("left"), "missing", "configs.lattice.views 1: left"),
        (lambda _, config: config["views"][1].update(x=3), "unknown", "configs.lattice.views 2: x"),
        (lambda _, config: config["rig"].update(height="90"), "invalid", "configs.lattice.rig.height"),
        (lambda _, config: scene_of(config)["board"].update({"\ud800": 1}), "syntax", ""),
        (lambda _, config: scene_of(config).update(board=7), "invalid", BOARD),
        (lambda _, config: scene_of(config).pop("board"), "missing", BOARD),
        *(
            (lambda _, config, key=key, name=name: config.update({key: name}), "invalid", f"configs.lattice.{key}")
            for key in ("ground_truth_digest", "sheet")
            for name in ("/../../../Documents", "../x", "/tmp/x", "a/../b", "a//b", "a\n", ".hidden", "a\\b")
        ),
        (lambda _, config: scene_of(config).update(mesh="../x"), "invalid", f"{SCENE} mesh"),
        (lambda _, config: scene_of(config).update(mesh=None), "conflict", "configs.lattice.scenes"),
        (lambda _, config: scene_of(config).update(split="train"), "conflict", "configs.lattice.scenes"),
        (lambda _, config: scene_of(config).update(shards=["../x.parquet"]), "invalid", f"{SCENE} shards 1"),
        (lambda _, config: scene_of(config)["board"].update(x=1), "unknown", BOARD + ".x"),
        (lambda _, config: scene_of(config)["board"].update(markers="six"), "invalid", BOARD + ".markers"),
        (lambda _, config: scene_of(config)["board"].update(width_m=float("nan")), "syntax", ""),
        (lambda manifest, _: manifest.update(configs={}), "invalid", "configs"),
        (lambda manifest, _: manifest.update(version="1\x1b[2J"), "invalid", "version"),
        (lambda manifest, _: manifest.update(protocol="rebar-0"), "invalid", "protocol"),
        (lambda manifest, _: manifest["ground_truth"].update(digest=ZEROS), "conflict", "ground_truth.digest"),
        (
            lambda _, config: config.update(ground_truth_digest=ZEROS),
            "conflict",
            "configs.lattice.ground_truth_digest",
        ),
        (lambda _, config: config.update(name="pile"), "conflict", "configs.lattice.name"),
        (lambda _, config: scene_of(config).update(shards=[]), "invalid", f"{SCENE} shards"),
        (lambda _, config: scene_of(config)["shards"].append(FIRST_SHARD), "duplicate", "configs.lattice.scenes"),
        (lambda _, config: config.update(views=[]), "invalid", "configs.lattice.views"),
        (lambda _, config: scene_of(config).update(mesh="meshes/other.ply"), "conflict", ORBIT_SCENES),
        *(
            (lambda _, config, views=views: scene_of(config).update(protocol_views=views), code, PROTOCOL_VIEWS)
            for views, code in (
                (8, "conflict"),
                (476, "conflict"),
                (505, "conflict"),
                (-1, "invalid"),
                ("504", "invalid"),
                (504.5, "invalid"),
            )
        ),
        (
            lambda _, config: scene_of(config)["protocol"].update(distance_to="steel"),
            "invalid",
            f"{SCENE} protocol.distance_to",
        ),
        (lambda _, config: scene_of(config).update(protocol=3), "invalid", f"{SCENE} protocol"),
        *(
            (
                lambda _, config, keys=keys: scene_of(config).update(protocol={**SURVEY, **keys}),
                code,
                f"{SURVEY_PLACE}.{place}",
            )
            for keys, code, place in (
                ({"distances_m": [1.0, -2.0]}, "invalid", "distances_m 2"),
                ({"views_per_distance": 252.5}, "invalid", "views_per_distance"),
            )
        ),
        (
            lambda _, config: scene_of(config).update(protocol={**SURVEY, "views_per_distance": 1}),
            "conflict",
            PROTOCOL_VIEWS,
        ),
        (
            lambda _, config: config["views"][0].update(steel_px=1 << 20, scored_px=1 << 20),
            "invalid",
            "configs.lattice.views",
        ),
        (lambda _, config: config["views"][0].update(steel_px=1, scored_px=2), "invalid", "configs.lattice.views"),
        (lambda _, config: config["rig"].update(width=-5), "invalid", "configs.lattice.rig.width"),
        (lambda _, config: config["views"].append(config["views"][0]), "duplicate", "configs.lattice.views"),
        (lambda _, config: config["views"][0].update(view_id="pile/0000"), "invalid", "configs.lattice.views"),
        (
            lambda _, config: config["views"][0].update(scored_px=-1),
            "invalid",
            "configs.lattice.views 1: scored_px",
        ),
        (lambda _, config: config["views"][1].update(left="x"), "invalid", "configs.lattice.views 2: left"),
        *(
            (
                lambda _, config, view_id=view_id: config["views"][0].update(view_id=view_id),
                "invalid",
                "configs.lattice.views 1: view_id",
            )
            for view_id in ("../../../x/evil", "/lattice/0000", "lattice", "lattice/..", "lattice/0000/1", "a/b\0")
        ),
    ],
)
def test_damaged_manifest_raises_dataset_error(
    manifest: Any, tmp_path: Path, change: Callable[[Any, Any], object], code: str, where: str
) -> None:
    change(manifest, manifest["configs"]["lattice"])
    assert manifest_problems(tmp_path, manifest) == [(code, where)]


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
    [
        (b"", "syntax"),
        (b"\xff\xfe\x00", "syntax"),
        (b"1" * 5000, "syntax"),
        (b"[" * 100_000, "size"),
        (b'{"format": "a", "format": "b"}', "duplicate"),
        (b" " * (65 << 20), "size"),
    ],
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


Entry = dict[str, Any]


def swap_split(entry: Entry) -> None:
    entry["scenes"][3]["split"] = "train"


def share_shard(entry: Entry) -> None:
    entry["scenes"][1]["shards"] = entry["scenes"][0]["shards"]


def repeat_scene(entry: Entry) -> None:
    entry["scenes"][1]["name"] = "a"


def unknown_split(entry: Entry) -> None:
    entry["scenes"][0]["split"] = "hidden"


def escaping_mesh(entry: Entry) -> None:
    entry["scenes"][2]["mesh"] = "../x.ply"


def no_scenes(entry: Entry) -> None:
    entry["scenes"] = []


def scenes_that_are_none(entry: Entry) -> None:
    entry["scenes"] = {"a": 1}


def index_without_digits(entry: Entry) -> None:
    entry["views"][0]["view_id"] = "cages/train-a-x"


def scene_without_views(entry: Entry) -> None:
    entry["views"] = [view for view in entry["views"] if "train-a-" not in view["view_id"]]
    entry["ground_truth_digest"] = views_digest(ViewRecord(**view) for view in entry["views"])


@pytest.mark.parametrize(
    ("change", "code", "where"),
    [
        (scene_without_views, "missing", "configs.cages.views"),
        (swap_split, "invalid", "configs.cages.views"),
        (share_shard, "duplicate", "configs.cages.scenes"),
        (repeat_scene, "duplicate", "configs.cages.scenes"),
        (unknown_split, "invalid", "configs.cages.scenes 1: split"),
        (escaping_mesh, "invalid", "configs.cages.scenes 3: mesh"),
        (no_scenes, "invalid", "configs.cages.scenes"),
        (scenes_that_are_none, "invalid", "configs.cages.scenes"),
        (index_without_digits, "invalid", "configs.cages.views"),
    ],
)
def test_invalid_scenes_of_a_manifest(
    root: Path, tmp_path: Path, change: Callable[[Entry], None], code: str, where: str
) -> None:
    manifest = json.loads((root / MANIFEST_FILE).read_text())
    change(manifest["configs"]["cages"])
    (tmp_path / MANIFEST_FILE).write_text(json.dumps(manifest))
    with pytest.raises(DatasetError) as caught:
        open_folder(tmp_path)
    assert (code, where) in [(problem.code, problem.where) for problem in caught.value.problems]
