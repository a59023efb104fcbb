"""Tests of the dataset folder read with plain ``datasets`` and with ``rebar_depth_bench.load``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pydantic import ValidationError

import rebar_depth_bench as rdb
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import References, Survey, Trajectory, features
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import ideal_K, right_camera_pose
from rebar_depth_bench.scoring.truth import published_match

HEIGHT, WIDTH, VIEWS = 90, 160, 9


def test_plain_datasets_loads_folder(tiny_root: Path) -> None:
    loaded = datasets.load_dataset(str(tiny_root), "lattice", split="test")
    assert loaded.features == features()
    assert len(loaded) == VIEWS
    row = loaded[0]
    assert row["left_rgb"].size == (WIDTH, HEIGHT)
    assert row["left_mask"].mode == "1"
    assert row["left_bars"].mode.startswith("I;16")
    assert row["left_preview"].mode == "P"


def test_view_ids_are_indices_of_the_full_protocol(tiny_root: Path) -> None:
    view_ids = rdb.load(tiny_root, "lattice", columns=["view_id"])["view_id"]
    assert list(view_ids) == [f"lattice/{(2 * i + 1) * 504 // 18:04d}" for i in range(VIEWS)]


def test_rows_decode_to_contract_dtypes_and_shapes(tiny_root: Path) -> None:
    row = rdb.load(tiny_root, "lattice")[4]
    assert list(row) == list(features())
    for eye in ("left", "right"):
        for kind, dtype, shape in (
            ("rgb", np.uint8, (HEIGHT, WIDTH, 3)),
            ("depth", np.float32, (HEIGHT, WIDTH)),
            ("mask", np.bool_, (HEIGHT, WIDTH)),
            ("bars", np.uint16, (HEIGHT, WIDTH)),
            ("K", np.float64, (3, 3)),
            ("distortion", np.float64, (5,)),
            ("cam_from_world", np.float64, (4, 4)),
        ):
            array = row[f"{eye}_{kind}"]
            assert (array.dtype, array.shape) == (dtype, shape), f"{eye}_{kind}"
        assert np.array_equal(row[f"{eye}_K"], ideal_K(WIDTH, HEIGHT))
        assert np.array_equal(row[f"{eye}_mask"], row[f"{eye}_bars"] > 0)
        assert 0.03 < row[f"{eye}_mask"].mean() < 0.3
    assert row["baseline_m"] == 0.12
    assert np.array_equal(row["right_cam_from_world"], right_camera_pose(row["left_cam_from_world"], 0.12))


def test_streaming_gives_the_same_rows(tiny_root: Path) -> None:
    loaded = rdb.load(tiny_root, "lattice")
    streamed = list(rdb.load(tiny_root, "lattice", streaming=True))
    assert len(streamed) == VIEWS
    for a, b in zip(loaded, streamed, strict=True):
        assert list(a) == list(b)
        for name in a:
            assert np.array_equal(a[name], b[name]), name


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("num_workers", [0, 2])
def test_torch_batch_shapes_and_dtypes(tiny_root: Path, streaming: bool, num_workers: int) -> None:
    torch = pytest.importorskip("torch")
    ds = rdb.load(tiny_root, "lattice", streaming=streaming)
    loaded_ids: list[str] = []
    for batch in rdb.torch_loader(ds, batch_size=4, num_workers=num_workers):
        count = len(batch["view_id"])
        assert batch["rgb"].shape == (count, 3, HEIGHT, WIDTH)
        assert batch["depth"].shape == (count, 1, HEIGHT, WIDTH)
        assert batch["mask"].shape == (count, 1, HEIGHT, WIDTH)
        assert batch["K"].shape == (count, 3, 3)
        assert batch["poses"].shape == (count, 4, 4)
        types = [batch[key].dtype for key in ("rgb", "depth", "mask", "K", "poses")]
        assert types == [torch.uint8, torch.float32, torch.bool, torch.float64, torch.float64]
        loaded_ids += batch["view_id"]
    assert sorted(loaded_ids) == sorted(rdb.load(tiny_root, "lattice", columns=["view_id"])["view_id"])


def test_torch_batch_equals_row_values(tiny_root: Path) -> None:
    pytest.importorskip("torch")
    row = rdb.load(tiny_root, "lattice")[0]
    batch = next(iter(rdb.torch_loader(rdb.load(tiny_root, "lattice"), stereo=True)))
    assert np.array_equal(batch["rgb"][0].permute(1, 2, 0).numpy(), row["left_rgb"])
    assert np.array_equal(batch["right_depth"][0, 0].numpy(), row["right_depth"])
    assert np.array_equal(batch["right_poses"][0].numpy(), row["right_cam_from_world"])
    assert batch["baseline_m"].tolist() == [0.12]


def test_load_errors_name_expected_values(tiny_root: Path, tmp_path: Path) -> None:
    with pytest.raises(rdb.DatasetError, match=r"no config 'lattise', expected one of lattice, lattice-orbit"):
        rdb.load(tiny_root, "lattise")
    with pytest.raises(rdb.DatasetError, match=r"no column 'depth', expected some of view_id, scene, left_rgb"):
        rdb.load(tiny_root, "lattice", columns=["depth"])
    with pytest.raises(
        rdb.DatasetError, match=r"has no manifest.json, expected a complete dataset folder written by rebar-build"
    ):
        rdb.load(tmp_path, "lattice")
    with pytest.raises(rdb.DatasetError, match="no such folder"):
        rdb.load(tmp_path / "missing", "lattice")


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize(("part", "positions"), [("[:2]", range(2)), ("[50%:]", range(4, 9)), ("[-1:]", [8])])
def test_part_of_a_split(tiny_root: Path, part: str, positions: Sequence[int], streaming: bool) -> None:
    view_ids = open_folder(tiny_root).config("lattice").view_ids
    loaded = rdb.load(tiny_root, "lattice", split=f"test{part}", streaming=streaming, columns=["view_id"])
    assert [row["view_id"] for row in loaded] == [view_ids[position] for position in positions]


@pytest.mark.parametrize("split", ["test[", "test[a]", "test[:2]+test[3:]", "tests[:2]", "test+test", "[:2]"])
def test_text_that_is_no_part_of_a_split_is_refused(tiny_root: Path, split: str) -> None:
    with pytest.raises(rdb.DatasetError, match=r"has no split .*, expected test|expected one as test\[:10\]"):
        rdb.load(tiny_root, "lattice", split=split)


def test_unavailable_hub_repository_raises_dataset_error() -> None:
    with pytest.raises(
        rdb.DatasetError, match=r"not a local folder, and its manifest\.json cannot be downloaded from the Hub"
    ):
        rdb.load("nobody/nothing-here", "lattice")


def test_manifest_lists_every_view(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    assert folder.configs == ("lattice", "lattice-orbit")
    assert len(folder.expected_views()) == VIEWS + 2
    assert set(folder.expected_views().values()) == {(HEIGHT, WIDTH)}
    assert folder.digest.startswith("sha256:")


def test_loading_columns_writes_no_further_cache_file(tiny_root: Path) -> None:
    ds = rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth", "left_rgb"])
    assert ds[0]["left_rgb"].dtype == np.uint8
    assert ds.cache_files
    assert not [file for file in ds.cache_files if "cache-" in Path(file["filename"]).name]


@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_damaged_shard_raises_dataset_error(tiny_root: Path, tmp_path: Path, damage: str) -> None:
    copy = tmp_path / "dataset"
    shutil.copytree(tiny_root, copy)
    for shard in copy.glob("lattice/*.parquet"):
        if damage == "missing":
            shard.unlink()
        else:
            shard.write_bytes(shard.read_bytes()[:-100])
    with pytest.raises(rdb.DatasetError, match=r"dataset: (config lattice cannot be read|has no lattice/)"):
        list(iterate_rows(open_folder(copy).config("lattice"), ["view_id"]))


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


def test_view_id_of_shard_that_manifest_lacks_is_rejected(tiny_root: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(tiny_root, tmp_path / "copy")
    shard = next(copy.glob("lattice-orbit/*.parquet"))
    table = pq.read_table(shard)
    rows = [row | {"view_id": "../../../x/evil"} for row in table.to_pylist()]
    pq.write_table(pa.Table.from_pylist(rows, table.schema), shard)
    with pytest.raises(rdb.DatasetError, match=r"view \.\./\.\./\.\./x/evil is not in the manifest"):
        list(iterate_rows(open_folder(copy).config("lattice-orbit"), ["view_id", "left_K"]))


@pytest.mark.parametrize("streaming", [True, False])
def test_load_with_missing_shard_raises_dataset_error(tiny_root: Path, tmp_path: Path, streaming: bool) -> None:
    copy = shutil.copytree(tiny_root, tmp_path / "copy")
    next(copy.glob("lattice/test-00000-*.parquet")).unlink()
    load: Any = rdb.load
    with pytest.raises(rdb.DatasetError, match="has no lattice/test-00000"):
        load(copy, "lattice", streaming=streaming)


def test_columns_given_as_text_are_rejected(tiny_root: Path) -> None:
    with pytest.raises(rdb.DatasetError, match="columns is 'left_rgb', expected a list"):
        rdb.load(tiny_root, "lattice", columns="left_rgb")


def test_reference_errors_may_be_zero_but_not_negative() -> None:
    zero = {"abs_rel": 0.0, "rmse_cm": 0.0}
    assert References.model_validate({"constant": zero, "one_pixel": zero}).constant.abs_rel == 0.0
    with pytest.raises(ValidationError):
        References.model_validate({"constant": {**zero, "rmse_cm": -1.0}, "one_pixel": zero})
