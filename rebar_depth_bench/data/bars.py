"""``bars.parquet``: the reinforcing bars of every scene of a dataset folder, as their axes and diameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.errors import DatasetError

BARS = "bars.parquet"
BARS_SCHEMA = pa.schema(
    [
        ("scene", pa.string()),
        ("bar_id", pa.uint16()),
        ("role", pa.string()),
        ("diameter_m", pa.float64()),
        ("axis", pa.list_(pa.list_(pa.float64(), 3))),
    ]
)
"""``axis`` is the centreline as a polyline, world frame, metres."""


@dataclass(frozen=True)
class Bar:
    """One reinforcing bar: its id (1 and up), what it does, its nominal diameter and its centreline (world)."""

    bar_id: int
    role: str
    diameter_m: float
    axis_m: tuple[tuple[float, float, float], ...]


def read_bars(path: Path) -> dict[str, tuple[Bar, ...]]:
    """Return the bars of every scene in a ``bars.parquet``, in the file's order.

    Raises ``DatasetError`` in words where the file is missing, is no such table, or holds a bar that cannot be.
    """
    try:
        rows = pq.read_table(path, schema=BARS_SCHEMA).to_pylist()
    except (OSError, pa.ArrowException) as error:
        raise DatasetError(f"{path}: cannot be read as a table of bars: {error}") from error
    scenes: dict[str, dict[int, Bar]] = {}
    for row in rows:
        bar = _checked_bar(path, row)
        bars = scenes.setdefault(row["scene"], {})
        if bar.bar_id in bars:
            raise DatasetError(f"{path}: scene {row['scene']!r} has bar {bar.bar_id} twice, expected each id once")
        bars[bar.bar_id] = bar
    return {scene: tuple(bars.values()) for scene, bars in scenes.items()}


def _checked_bar(path: Path, row: Mapping[str, Any]) -> Bar:
    """Return a row as a bar, or raise ``DatasetError`` that says what is wrong with it."""
    where = f"{path}: bar {row['bar_id']} of scene {row['scene']!r}"
    empty = [name for name in BARS_SCHEMA.names if row[name] is None]
    if empty or any(point is None for point in row["axis"]):
        raise DatasetError(f"{where} has no {', '.join(empty) or 'whole axis'}")
    if row["bar_id"] < 1:
        raise DatasetError(f"{where}: bar_id is {row['bar_id']}, expected 1 or more (0 is no steel)")
    if not 0 < row["diameter_m"] < math.inf:
        raise DatasetError(f"{where}: diameter_m is {row['diameter_m']}, expected a positive length")
    axis_m = tuple((x, y, z) for x, y, z in row["axis"])
    if len(axis_m) < 2 or not all(
        value is not None and math.isfinite(value) for point in axis_m for value in point
    ):
        raise DatasetError(f"{where}: axis is {axis_m}, expected two or more finite points")
    return Bar(row["bar_id"], row["role"], row["diameter_m"], axis_m)
