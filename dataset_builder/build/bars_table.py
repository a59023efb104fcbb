"""``bars.parquet``: one row per bar of every scene."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from dataset_builder.scene.model import Bar
from rebar_depth_bench.data import bars
from rebar_depth_bench.atomic_io import replacing

BARS = bars.BARS


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
        for scene, steel in sorted(scenes.items())
        for bar in steel
    ]
    with replacing(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=bars.BARS_SCHEMA), temporary)


def read_bars(path: Path) -> dict[str, tuple[Bar, ...]]:
    """Return the bars of every scene in the file; nothing if there is no file yet.

    Raises ``DatasetError`` in words for a file that is no table of bars.
    """
    return bars.read_bars(path) if path.is_file() else {}
