"""Table ``bars.parquet``: axes and diameters of the reinforcing bars of every scene of a dataset folder."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from rebar_depth_bench.base.errors import DatasetError, escape_text
from rebar_depth_bench.base.limits import TABLE_BYTES
from rebar_depth_bench.base.names import NAME_LETTERS, NAME_PATTERN
from rebar_depth_bench.base.reading import open_regular
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.shards import Table, read_footer, read_table, write_table

if TYPE_CHECKING:
    from pandas import DataFrame

BARS_FILE = "bars.parquet"
NOMINAL_AXIS = "nominal_axis"
_Line = tuple[tuple[float, float, float], ...]
BARS_SCHEMA = pa.schema(
    [
        ("scene", pa.string()),
        ("bar_id", pa.uint16()),
        ("role", pa.string()),
        ("diameter_m", pa.float64()),
        ("axis", pa.list_(pa.list_(pa.float64(), 3))),
        (NOMINAL_AXIS, pa.list_(pa.list_(pa.float64(), 3))),
    ]
)
"""Schema of ``bars.parquet``; ``axis`` is the centreline as a polyline in the world frame, metres.

Axis and diameter are null for steel that does not have the surface of one round bar. ``nominal_axis`` is the
centreline in the design, null for bars that are not in a design; the column may be absent.
"""


@dataclass(frozen=True)
class Bar:
    """Reinforcing bar: id (1 or more), role, nominal diameter in metres and centreline.

    ``axis_m`` is the centreline as a polyline in the world frame, metres. Where none could be fitted to the bar's
    surface, it is empty and the diameter is NaN (both null in the table). ``nominal_axis_m`` is the centreline in
    the design, from which the bar as built deviates; it is empty for a bar that is not in a design.
    """

    bar_id: int
    role: str
    diameter_m: float
    axis_m: _Line
    nominal_axis_m: _Line = ()

    @classmethod
    def without_axis(cls, bar_id: int, role: str) -> Bar:
        """Return a bar of unknown diameter and centreline."""
        return cls(bar_id, role, math.nan, ())

    @property
    def has_axis(self) -> bool:
        """Whether diameter and centreline are known."""
        return bool(self.axis_m)

    @property
    def decoded_bytes(self) -> int:
        """Size of the bar in the decoded table, bytes; the points of both lines are most of it."""
        return 24 * (len(self.axis_m) + len(self.nominal_axis_m)) + 40

    @property
    def length_m(self) -> float:
        """Length of the centreline, metres; NaN without one."""
        if not self.has_axis:
            return math.nan
        return sum(math.dist(start, end) for start, end in pairwise(self.axis_m))


def with_axis(bars: Iterable[Bar]) -> tuple[Bar, ...]:
    """Return the bars whose diameter and centreline are known, in order."""
    return tuple(bar for bar in bars if bar.has_axis)


def read_bars(path: Path) -> dict[str, tuple[Bar, ...]]:
    """Read a ``bars.parquet`` and return the bars of each scene, keyed by scene name, in the order of the file.

    Raises ``DatasetError`` if the file is missing, is not such a table, is larger than ``TABLE_BYTES``, or holds
    an invalid bar or a repeated id.
    """
    scenes: dict[str, dict[int, Bar]] = {}
    for row in read_table(path, _table(), "bars"):
        bar = _bar_from_row(path, row)
        if scenes.setdefault(row["scene"], {}).setdefault(bar.bar_id, bar) is not bar:
            where = f"scene {short_repr(row['scene'])}"
            raise DatasetError(f"{path}: {where} has bar {bar.bar_id} twice, expected each id once")
    return {scene: tuple(bars.values()) for scene, bars in scenes.items()}


def _table() -> Table:
    max_bytes = TABLE_BYTES.value()
    max_values = {"axis": max_bytes, NOMINAL_AXIS: max_bytes}
    return Table(BARS_SCHEMA, max_bytes // 64, max_bytes, max_values, frozenset({NOMINAL_AXIS}))


def decoded_bytes(path: Path) -> int:
    """Return the decoded size of a ``bars.parquet``, which ``TABLE_BYTES`` limits; 0 if it cannot be read."""
    try:
        with open_regular(path) as stream:
            return _table().decoded_bytes(read_footer(stream, _table().max_footer_bytes))
    except (OSError, ValueError):
        return 0


def bars(root: str | Path) -> DataFrame:
    """Return the bars of every scene of a dataset folder or Hub repository as a frame, one row per bar.

    The columns are those of ``bars.parquet`` and ``length_m``, the length of the centreline. ``axis`` and
    ``nominal_axis`` are float64 arrays of shape (n, 3), world frame, metres, or None where the table has null: a
    bar without an axis has the axis None, and its diameter and length are NaN. Raises ``DatasetError`` if the
    folder is invalid, or if its table of bars is damaged or differs from the manifest.
    """
    import pandas as pd  # Half a second to import, which reading bars for scoring does not need.

    rows = [
        (
            *(scene, bar.bar_id, bar.role, bar.diameter_m),
            *(np.array(line) if line else None for line in (bar.axis_m, bar.nominal_axis_m)),
            bar.length_m,
        )
        for scene, scene_bars in read_bars(open_folder(root).verified_file(BARS_FILE)).items()
        for bar in scene_bars
    ]
    return pd.DataFrame(rows, columns=[*BARS_SCHEMA.names, "length_m"])


def write_bars(path: Path, scenes: Mapping[str, tuple[Bar, ...]]) -> None:
    """Write the bars of all scenes, sorted by scene name; the bars of a scene keep their order."""
    rows = [
        {
            "scene": scene,
            "bar_id": bar.bar_id,
            "role": bar.role,
            "diameter_m": bar.diameter_m if bar.has_axis else None,
            "axis": [list(point) for point in bar.axis_m] if bar.has_axis else None,
            NOMINAL_AXIS: [list(point) for point in bar.nominal_axis_m] or None,
        }
        for scene, bars in sorted(scenes.items())
        for bar in bars
    ]
    write_table(path, rows, BARS_SCHEMA)


def _bar_from_row(path: Path, row: Mapping[str, Any]) -> Bar:
    """Convert a row to a ``Bar``; raise ``DatasetError`` if a value is missing or invalid."""
    where = f"{path}: bar {row['bar_id']} of scene {short_repr(row['scene'])}"
    diameter_m, axis = row["diameter_m"], row["axis"]
    has_axis = diameter_m is not None or axis is not None  # Both are null, or neither.
    required = ("scene", "bar_id", "role", *(("diameter_m", "axis") if has_axis else ()))
    empty = [name for name in required if row[name] is None]
    if empty:
        raise DatasetError(f"{where} has no {', '.join(empty)}")
    if not re.fullmatch(NAME_PATTERN, row["scene"]):
        raise DatasetError(f"{where}: the name of the scene is invalid, expected {NAME_LETTERS}")
    if re.search(r"[\x00-\x1f\x7f-\x9f]", row["role"]):
        raise DatasetError(f"{where}: role is {escape_text(row['role'])}, expected no control characters")
    if row["bar_id"] < 1:
        raise DatasetError(f"{where}: bar_id is {row['bar_id']}, expected 1 or more (0 means no steel)")
    if not has_axis:
        return Bar.without_axis(row["bar_id"], row["role"])
    if not 0 < diameter_m < math.inf:
        raise DatasetError(f"{where}: diameter_m is {diameter_m}, expected a positive length")
    nominal = row.get(NOMINAL_AXIS)
    nominal_m = () if nominal is None else _line(nominal, where, NOMINAL_AXIS)
    return Bar(row["bar_id"], row["role"], diameter_m, _line(axis, where, "axis"), nominal_m)


def _line(points: Sequence[Any], where: str, name: str) -> _Line:
    """Return a polyline of a row; raise ``DatasetError`` unless it has two or more finite points."""
    values = [value for point in points for value in point or (None,)]
    if len(points) < 2 or not all(value is not None and math.isfinite(value) for value in values):
        raise DatasetError(f"{where}: {name} is {short_repr(points)}, expected two or more finite points")
    return tuple((x, y, z) for x, y, z in points)
