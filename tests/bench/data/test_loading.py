"""Dataset folders read with datasets, with load and row by row."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS, ROW_SCHEMA, features
from rebar_depth_bench.data.shards import encoded_rows
from rebar_depth_bench.geometry.cameras import ideal_K, right_camera_pose
from tests.damage import change_rows, copy_dataset, first_shard
from tests.small_disks import NewDisk

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


def test_view_ids_of_the_manifest_are_indices_of_the_full_trajectory(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    assert folder.configs == ("lattice", "lattice-orbit")
    assert len(folder.expected_views()) == VIEWS + 2
    assert set(folder.expected_views().values()) == {(HEIGHT, WIDTH)}
    assert folder.digest.startswith("sha256:")
    view_ids = rdb.load(tiny_root, "lattice", columns=["view_id"])["view_id"]
    assert list(view_ids) == [f"lattice/{(2 * i + 1) * 504 // 18:04d}" for i in range(VIEWS)]


STREAMING = (False, True)
LOADED = """
import sys
import rebar_depth_bench as rdb
try:
    rdb.load(sys.argv[1], "lattice", streaming=sys.argv[2] == "True")
except rdb.InputError:
    raise
except Exception as error:
    sys.exit(str(error))
"""


@pytest.mark.parametrize(
    ("fault", "fails"), [("file", STREAMING), ("read-only", STREAMING), ("full", (False,)), ("none", ())]
)
def test_cache_of_datasets_that_cannot_be_written_is_named(
    fault: str, fails: tuple[bool, ...], tiny_root: Path, tmp_path: Path, new_disk: NewDisk
) -> None:
    """The cache is named, and not the dataset, which has no damage."""
    folder = tmp_path / "cache"
    if fault == "file":
        folder.write_bytes(b"")
    elif fault != "none":
        disk = new_disk(1 << 16)
        folder = disk.root
        if fault == "read-only":
            disk.make_read_only()
    for streaming in STREAMING:
        command = [sys.executable, "-c", LOADED, str(tiny_root), str(streaming)]
        environment = {**os.environ, "HF_DATASETS_CACHE": str(folder)}
        finished = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=100, check=False
        )
        assert finished.returncode == (streaming in fails), finished.stderr
        if streaming in fails:
            [line] = [line for line in finished.stderr.splitlines() if "lattice" in line]
            assert line.startswith(f"{folder}: cannot be used as the cache of lattice: ")
            assert "HF_DATASETS_CACHE" in line
            assert "Traceback" not in finished.stderr


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


@pytest.mark.parametrize(
    ("config", "options", "words"),
    [
        ("lattise", {}, "no config 'lattise', expected one of lattice, lattice-orbit"),
        ("bars", {}, "no config 'bars', expected one of lattice, lattice-orbit; rdb.bars reads bars.parquet"),
        ("lattice", {"columns": ["depth"]}, "no column 'depth', expected some of view_id, scene, left_rgb"),
        ("lattice", {"columns": "left_rgb"}, "columns is 'left_rgb', expected a list"),
        ("lattice", {"columns": 3}, "columns is 3, expected a list of column names"),
        ("lattice", {"split": None}, "lattice has no split None, expected test"),
        ("lattice", {"split": 3}, "lattice has no split 3, expected test"),
    ],
)
def test_load_errors_name_expected_values(tiny_root: Path, config: str, options: Any, words: str) -> None:
    with pytest.raises(rdb.DatasetError, match=words):
        rdb.load(tiny_root, config, **options)


def test_folder_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(rdb.DatasetError, match=r"has no manifest.json, expected a complete dataset folder"):
        rdb.load(tmp_path, "lattice")
    with pytest.raises(rdb.DatasetError, match="no such folder"):
        rdb.load(tmp_path / "missing", "lattice")


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize(("part", "positions"), [("[:2]", range(2)), ("[50%:]", range(4, 9)), ("[-1:]", [8])])
def test_part_of_a_split_has_its_views_in_order(
    tiny_root: Path, part: str, positions: Sequence[int], streaming: bool
) -> None:
    view_ids = open_folder(tiny_root).config("lattice").view_ids
    loaded = rdb.load(tiny_root, "lattice", split=f"test{part}", streaming=streaming, columns=["view_id"])
    assert [row["view_id"] for row in loaded] == [view_ids[position] for position in positions]


@pytest.mark.parametrize("split", ["test[", "test[a]", "test[:2]+test[3:]", "tests[:2]", "test+test", "[:2]"])
def test_text_that_is_no_part_of_a_split_is_refused(tiny_root: Path, split: str) -> None:
    with pytest.raises(rdb.DatasetError, match=r"has no split .*, expected test|expected one as test\[:10\]"):
        rdb.load(tiny_root, "lattice", split=split)


def test_loading_columns_writes_no_further_cache_file(tiny_root: Path) -> None:
    ds = rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth", "left_rgb"])
    assert ds[0]["left_rgb"].dtype == np.uint8
    assert ds.cache_files
    assert not [file for file in ds.cache_files if "cache-" in Path(file["filename"]).name]


def test_row_schema_is_that_of_the_features() -> None:
    assert ROW_SCHEMA.equals(features().arrow_schema.remove_metadata())


def test_local_rows_equal_those_of_datasets(tiny_root: Path) -> None:
    config = open_folder(tiny_root).config("lattice")
    loaded = datasets.load_dataset(str(tiny_root), "lattice", split="test")
    assert list(encoded_rows(config, COLUMNS)) == loaded.data.to_pylist()


@pytest.mark.parametrize("row_group_size", [1, 3])
@pytest.mark.parametrize("turned", [False, True])
def test_rows_of_some_views_are_found_wherever_they_are(
    tiny_root: Path, tmp_path: Path, row_group_size: int, turned: bool
) -> None:
    columns, root = ("view_id", "left_depth"), copy_dataset(tiny_root, tmp_path / "copy")
    expected = {
        row["view_id"]: row["left_depth"] for row in iterate_rows(open_folder(root).config("lattice"), columns)
    }
    for shard in root.glob("lattice/*.parquet"):
        change_rows(shard, list.reverse if turned else list.copy, row_group_size=row_group_size)
    config = open_folder(root).config("lattice")
    for view_ids in (*([view_id] for view_id in expected), config.view_ids[1::3], config.view_ids):
        rows = list(iterate_rows(config, columns, view_ids))
        assert sorted(row["view_id"] for row in rows) == list(view_ids)
        assert all(np.array_equal(row["left_depth"], expected[row["view_id"]]) for row in rows)


def test_missing_row_of_some_views_is_named(tiny_root: Path, tmp_path: Path) -> None:
    root = copy_dataset(tiny_root, tmp_path / "copy")
    change_rows(first_shard(root, "lattice"), list.pop)
    config = open_folder(root).config("lattice")
    missing = config.view_ids[7]
    with pytest.raises(DatasetError, match=f"lattice lacks 1 views, among them {missing}"):
        list(iterate_rows(config, ("view_id",), [missing]))
