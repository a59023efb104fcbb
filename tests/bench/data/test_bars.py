"""Tests of the table of bars: round trip and validation."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import BARS_SCHEMA, Bar, read_bars, with_axis, write_bars

STRAIGHT = Bar(1, "tie", 0.016, ((0.0, 0.0, 0.0), (0.0, 0.0, 1.5)))
BENT = Bar(65535, "hoop", 0.01, ((0.1, 0.0, 0.0), (0.2, 0.0, 0.0), (0.2, 0.3, 0.0)))
WITHOUT_AXIS = Bar.without_axis(7, "imported")
ROW = {"scene": "pier", "axis": STRAIGHT.axis_m, **{k: v for k, v in asdict(STRAIGHT).items() if k != "axis_m"}}


def write_rows(path: Path, *rows: dict[str, Any]) -> Path:
    pq.write_table(pa.Table.from_pylist(list(rows), schema=BARS_SCHEMA), path)
    return path


def test_read_bars_returns_what_write_bars_wrote(tmp_path: Path) -> None:
    scenes = {"pier": (STRAIGHT, BENT, WITHOUT_AXIS), "pile": (STRAIGHT,)}
    write_bars(tmp_path / "bars.parquet", scenes)
    # Texts, because the diameter of a bar without an axis is NaN, which differs from itself.
    assert repr(read_bars(tmp_path / "bars.parquet")) == repr(scenes)


def test_bar_without_axis_is_null_in_the_table(tmp_path: Path) -> None:
    write_bars(tmp_path / "bars.parquet", {"pier": (WITHOUT_AXIS,)})
    (row,) = pq.read_table(tmp_path / "bars.parquet").to_pylist()
    assert (row["bar_id"], row["diameter_m"], row["axis"]) == (7, None, None)
    (bar,) = read_bars(tmp_path / "bars.parquet")["pier"]
    assert (bar.has_axis, math.isnan(bar.diameter_m), math.isnan(bar.length_m)) == (False, True, True)
    assert with_axis((STRAIGHT, bar, BENT)) == (STRAIGHT, BENT)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"bar_id": 0}, "bar_id is 0, expected 1 or more"),
        ({"diameter_m": 0.0}, "diameter_m is 0.0, expected a positive length"),
        ({"diameter_m": float("nan")}, "diameter_m is nan"),
        ({"axis": [[0.0, 0.0, 0.0]]}, "expected two or more finite points"),
        ({"axis": [[0.0, 0.0, 0.0], [0.0, float("inf"), 0.0]]}, "expected two or more finite points"),
        ({"axis": [[0.0, 0.0, 0.0], [0.0, None, 0.0]]}, "expected two or more finite points"),
        ({"axis": None, "role": None}, "has no role, axis"),
        ({"axis": None}, "has no axis"),
        ({"diameter_m": None}, "has no diameter_m"),
        ({"diameter_m": None, "axis": None, "role": None}, "has no role$"),
    ],
)
def test_invalid_bar_is_named_in_error(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = write_rows(tmp_path / "bars.parquet", {**ROW, **change})
    with pytest.raises(DatasetError, match=said) as raised:
        read_bars(path)
    assert f"{path}: bar {change.get('bar_id', 1)} of scene 'pier'" in str(raised.value)


def test_duplicate_bar_id_in_scene_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="scene 'pier' has bar 1 twice"):
        read_bars(write_rows(tmp_path / "bars.parquet", ROW, ROW))
    other_scene = {**ROW, "scene": "pile"}
    assert len(read_bars(write_rows(tmp_path / "bars.parquet", ROW, other_scene))) == 2


def test_missing_or_malformed_file_is_named_in_error(tmp_path: Path) -> None:
    garbage, other = tmp_path / "garbage.parquet", tmp_path / "other.parquet"
    garbage.write_bytes(b"PAR1 no more than that")
    pq.write_table(pa.table({"scene": ["pier"], "bar_id": ["one"]}), other)
    for path in (tmp_path / "missing.parquet", garbage, other):
        with pytest.raises(DatasetError, match=str(path)):
            read_bars(path)
