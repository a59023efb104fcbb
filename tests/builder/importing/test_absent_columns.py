"""Folders whose configs lack columns: loading, and manifests and shards that contradict each other."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from dataset_builder.importing.config_import import plan_import, run_import
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.manifest import open_folder
from tests.builder.importing import source_data as data

Entry = dict[str, Any]


@pytest.fixture(scope="module")
def one_camera(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset folder with depth and colour of one camera."""
    folder = tmp_path_factory.mktemp("one-camera")
    data.write_source(folder, data.sample_rows(tiny_root), tiny_root)
    run_import(
        plan_import(data.write_layout(folder, ("left_depth", "left_rgb"), tables=""), "mock-up"), folder / "out"
    )
    return folder / "out"


@pytest.fixture
def root(one_camera: Path, tmp_path: Path) -> Path:
    """Return a copy that a test may change."""
    return Path(shutil.copytree(one_camera, tmp_path / "copy"))


def test_streamed_rows_are_the_loaded_ones(one_camera: Path) -> None:
    loaded, streamed = rdb.load(one_camera, "mock-up"), rdb.load(one_camera, "mock-up", streaming=True)
    for row, other in zip(loaded, streamed, strict=True):
        assert row.keys() == other.keys()
        for name, value in row.items():
            assert np.array_equal(value, other[name]), name
            assert (value is None) == (name in open_folder(one_camera).config("mock-up").absent_columns)


@pytest.mark.slow
def test_torch_batches_leave_absent_parts_out(one_camera: Path) -> None:
    batch = next(iter(rdb.torch_loader(rdb.load(one_camera, "mock-up"), batch_size=2, stereo=True)))
    assert set(batch) == {"rgb", "depth", "K", "poses", "view_id"}
    assert tuple(batch["depth"].shape) == (2, 1, 90, 160)


def change_shards(root: Path, change: Callable[[Entry], None]) -> None:
    """Change the encoded rows of all shards."""
    for path in root.glob("mock-up/*.parquet"):
        table = pq.read_table(path)
        rows = table.to_pylist()
        for row in rows:
            change(row)
        pq.write_table(pa.Table.from_pylist(rows, table.schema), path)


def add_mask(row: Entry) -> None:
    row["left_mask"] = {"bytes": data.png(np.ones((90, 160), np.uint8)), "path": None}


def add_matrix(row: Entry) -> None:
    row["right_K"] = np.eye(3).tolist()


def add_baseline(row: Entry) -> None:
    row["baseline_m"] = 0.1


def drop_depth(row: Entry) -> None:
    row["left_depth"] = None


def drop_colour(row: Entry) -> None:
    row["left_rgb"] = None


def drop_matrix(row: Entry) -> None:
    row["left_K"] = np.full((3, 3), np.nan).tolist()


@pytest.mark.parametrize("change", [add_mask, add_matrix, add_baseline, drop_depth, drop_colour, drop_matrix])
def test_row_that_contradicts_the_manifest_is_refused(change: Callable[[Entry], None], root: Path) -> None:
    change_shards(root, change)
    with pytest.raises(DatasetError, match=r"mock-up/0000: \w+ is damaged"):
        list(rdb.load(root, "mock-up"))


def set_in(*keys: str, value: object) -> Callable[[Entry], None]:
    def change(entry: Entry) -> None:
        for key in keys[:-1]:
            entry = entry[key]
        entry[keys[-1]] = value

    return change


def set_view(key: str, value: object) -> Callable[[Entry], None]:
    def change(entry: Entry) -> None:
        entry["views"][0][key] = value

    return change


ALL_BUT_BARS = ["left_mask", "right_mask", "right_bars", "right_depth", "right_rgb", "right_K"]


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda entry: entry.pop("imported"), "scenes"),
        (set_in("imported", "truth_sigma_m", value=0), "imported.truth_sigma_m"),
        (set_in("imported", "truth_sigma_m", value=None), "imported.truth_sigma_m"),
        (set_in("imported", "absent_columns", value=["left_depth"]), "imported.absent_columns"),
        (set_in("imported", "absent_columns", value=["left_K"]), "imported.absent_columns"),
        (set_in("imported", "absent_columns", value=ALL_BUT_BARS), "imported.absent_columns"),
        (set_in("imported", "absent_columns", value=[]), "views"),
        (set_view("steel_px", 5), "views"),
        (set_view("right", "0" * 64), "views"),
        (set_view("left", None), "views 1: left"),
    ],
)
def test_manifest_that_contradicts_itself_is_refused(
    change: Callable[[Entry], Any], where: str, root: Path
) -> None:
    path = root / "manifest.json"
    manifest = json.loads(path.read_bytes())
    change(manifest["configs"]["mock-up"])
    path.write_text(json.dumps(manifest))
    with pytest.raises(DatasetError) as caught:
        open_folder(root)
    assert f"configs.mock-up.{where}" in [problem.where for problem in caught.value.problems]
