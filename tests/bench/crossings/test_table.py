"""Tests of the table of crossings: round trip, folders without it, and validation."""

from __future__ import annotations

import json
import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.bar_crossings.definition import Crossings, crossing_parameters, scene_crossings
from rebar_depth_bench.bar_crossings.table import (
    CROSSINGS_SCHEMA,
    CrossingsSource,
    folder_crossings,
    read_crossings,
    write_crossings,
)
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar, read_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import open_folder

X = Bar(3, "x", 0.02, ((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)))
Y = Bar(9, "y", 0.01, ((0.0, -0.1, 0.018), (0.0, 0.1, 0.018)))
ROW = {
    "scene": "mat", "crossing_id": 1, "node_id": 1, "bar_a": 3, "bar_b": 9, "point_a": [0.0, 0.0, 0.0],
    "point_b": [0.0, 0.0, 0.018], "tie_point": [0.0, 0.0, 0.0115], "gap_m": 0.003, "angle_deg": 90.0,
    "normal": [0.0, 0.0, 1.0],
}  # fmt: skip


def assert_equal(found: Crossings, expected: Crossings) -> None:
    for field in fields(Crossings):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


@pytest.fixture
def older(tiny_root: Path, tmp_path: Path) -> Path:
    """Return a folder as versions without crossings wrote it."""
    root = tmp_path / "older"
    shutil.copytree(tiny_root, root)
    manifest = json.loads((root / "manifest.json").read_text())
    del manifest["crossings"], manifest["files"]["crossings.parquet"]
    (root / "manifest.json").write_text(json.dumps(manifest))
    (root / "crossings.parquet").unlink()
    return root


def test_table_holds_what_was_computed(tmp_path: Path) -> None:
    write_crossings(tmp_path / "crossings.parquet", {"mat": (X, Y), "empty": (X,)})
    (row,) = pq.read_table(tmp_path / "crossings.parquet").to_pylist()
    assert row == {**ROW, "gap_m": pytest.approx(0.003), "tie_point": pytest.approx([0.0, 0.0, 0.0115])}
    found = read_crossings(tmp_path / "crossings.parquet")
    assert set(found) == {"mat"}
    assert_equal(found["mat"], scene_crossings((X, Y)))
    write_crossings(tmp_path / "none.parquet", {"empty": (X,)})
    assert read_crossings(tmp_path / "none.parquet") == {}


def test_built_folder_has_table_parameters_and_digest(tiny_root: Path) -> None:
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    sha256 = file_sha256(tiny_root / "crossings.parquet")
    assert manifest["files"]["crossings.parquet"] == sha256
    file = {"file": "crossings.parquet", "digest": f"sha256:{sha256}"}
    assert manifest["crossings"] == {**crossing_parameters(), **file}
    by_scene, source = folder_crossings(open_folder(tiny_root))
    assert source == CrossingsSource("crossings.parquet", sha256)
    assert_equal(by_scene["lattice"], scene_crossings(read_bars(tiny_root / "bars.parquet")["lattice"]))


def test_older_folder_has_crossings_of_its_bars(tiny_root: Path, older: Path) -> None:
    by_scene, source = folder_crossings(open_folder(older))
    assert source == CrossingsSource("bars.parquet", file_sha256(older / "bars.parquet"))
    assert_equal(by_scene["lattice"], read_crossings(tiny_root / "crossings.parquet")["lattice"])


def test_crossings_are_a_frame(tiny_root: Path, older: Path) -> None:
    for root in (tiny_root, older):
        frame = rdb.crossings(root)
        assert list(frame.columns) == CROSSINGS_SCHEMA.names
        assert (len(frame), frame["tie_point"][0].shape) == (375, (3,))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"crossing_id": 2}, "crossing_id to count from 1"),
        ({"node_id": 0}, "node_id of 1 or more"),
        ({"bar_a": 0}, "1 <= bar_a <= bar_b"),
        ({"bar_b": 2}, "1 <= bar_a <= bar_b"),
        ({"gap_m": float("nan")}, "finite numbers"),
        ({"tie_point": [0.0, 0.0, float("inf")]}, "finite numbers"),
        ({"normal": [0.0, 0.0, 2.0]}, "normals of length 1"),
        ({"gap_m": None}, "has no value in a column"),
        ({"point_a": [0.0, None, 0.0]}, "has no value in a column"),
    ],
)
def test_invalid_crossing_is_named_in_error(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = tmp_path / "crossings.parquet"
    pq.write_table(pa.Table.from_pylist([{**ROW, **change}], schema=CROSSINGS_SCHEMA), path)
    with pytest.raises(DatasetError, match=said) as raised:
        read_crossings(path)
    assert str(path) in str(raised.value)


def test_damaged_file_is_named_in_error(tmp_path: Path) -> None:
    (tmp_path / "garbage.parquet").write_bytes(b"PAR1 no more than that")
    for name in ("missing.parquet", "garbage.parquet"):
        with pytest.raises(DatasetError, match=name):
            read_crossings(tmp_path / name)


def test_crossing_of_unknown_bar_and_changed_file_are_refused(tiny_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(tiny_root, root)
    path = root / "crossings.parquet"
    pq.write_table(
        pa.Table.from_pylist([{**ROW, "scene": "lattice", "bar_b": 900}], schema=CROSSINGS_SCHEMA), path
    )
    with pytest.raises(DatasetError, match="the SHA-256 is"):
        folder_crossings(open_folder(root))
    manifest = json.loads((root / "manifest.json").read_text())
    manifest["files"]["crossings.parquet"] = file_sha256(path)
    (root / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match="'lattice' has a crossing of bar 900, expected bars with an axis"):
        folder_crossings(open_folder(root))
