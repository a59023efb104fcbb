"""``bars.parquet``: one row per bar of every scene."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from dataset_builder.model import Bar
from rebar_depth_bench.files import replacing

BARS = "bars.parquet"
SCHEMA = pa.schema(
    [
        ("scene", pa.string()),
        ("bar_id", pa.uint16()),
        ("role", pa.string()),
        ("diameter_m", pa.float64()),
        ("axis", pa.list_(pa.list_(pa.float64(), 3))),
    ]
)
"""``axis`` is the centreline as a polyline, world frame, metres."""


def write_bars(path: Path, scenes: Mapping[str, tuple[Bar, ...]]) -> None:
    """Write the bars of all scenes, in order of scene name and bar id."""
    rows = [
        {
            "scene": scene,
            "bar_id": bar.bar_id,
            "role": bar.role,
            "diameter_m": bar.diameter_m,
            "axis": [list(point) for point in bar.axis_m],
        }
        for scene, bars in sorted(scenes.items())
        for bar in bars
    ]
    with replacing(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=SCHEMA), temporary)


def read_bars(path: Path) -> dict[str, tuple[Bar, ...]]:
    """Return the bars of every scene in the file; nothing if there is no file yet."""
    if not path.is_file():
        return {}
    scenes: dict[str, list[Bar]] = {}
    for row in pq.read_table(path).to_pylist():
        axis_m = tuple((x, y, z) for x, y, z in row["axis"])
        bar = Bar(row["bar_id"], row["role"], row["diameter_m"], axis_m)
        scenes.setdefault(row["scene"], []).append(bar)
    return {name: tuple(bars) for name, bars in scenes.items()}
