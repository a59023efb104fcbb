"""Table ``crossings.parquet``: the crossings of the bars of every scene of a dataset folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from rebar_depth_bench.bar_crossings.definition import Crossings, crossing_parameters, scene_crossings
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.limits import TABLE_BYTES
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.data.bars import BARS_FILE, Bar, read_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.data.shards import Table, read_table, write_table

if TYPE_CHECKING:
    from pandas import DataFrame

CROSSINGS_FILE = "crossings.parquet"

_POINT = pa.list_(pa.float64(), 3)
_POINTS = ("point_a", "point_b", "tie_point", "normal")
CROSSINGS_SCHEMA = pa.schema(
    [
        ("scene", pa.string()),
        ("crossing_id", pa.uint32()),
        ("node_id", pa.uint32()),
        ("bar_a", pa.uint16()),
        ("bar_b", pa.uint16()),
        ("point_a", _POINT),
        ("point_b", _POINT),
        ("tie_point", _POINT),
        ("gap_m", pa.float64()),
        ("angle_deg", pa.float64()),
        ("normal", _POINT),
    ]
)
"""Schema of ``crossings.parquet``; points and ``normal`` (from a to b) in the world frame, metres."""

_FIELD_BY_COLUMN = dict(zip(CROSSINGS_SCHEMA.names[2:], (field.name for field in fields(Crossings)), strict=True))
"""Fields of ``Crossings`` by the names of their columns, which have the same order."""
_MIN_ROW_BYTES = 100
_UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True)
class CrossingsSource:
    """File of the dataset folder that the crossings come from, and its hex SHA-256."""

    file: str
    sha256: str


def folder_crossings(
    folder: DatasetFolder, bars: Mapping[str, Sequence[Bar]] | None = None
) -> tuple[dict[str, Crossings], CrossingsSource]:
    """Return the crossings of all scenes, read from ``crossings.parquet`` or else computed from ``bars.parquet``.

    ``bars`` are those of ``bars.parquet``, if already read. Raises ``DatasetError`` if a file cannot be read or
    does not match the manifest, and if a crossing names a bar that has no axis.
    """
    bars = read_bars(folder.verified_file(BARS_FILE)) if bars is None else bars
    if CROSSINGS_FILE not in folder.files:
        computed = {scene: scene_crossings(of_scene) for scene, of_scene in bars.items()}
        return computed, CrossingsSource(BARS_FILE, folder.files[BARS_FILE])
    path = folder.verified_file(CROSSINGS_FILE)
    by_scene = read_crossings(path)
    for scene, crossings in by_scene.items():
        known = {bar.bar_id for bar in bars.get(scene, ()) if bar.has_axis}
        if unknown := sorted({*crossings.bar_a.tolist(), *crossings.bar_b.tolist()} - known):
            where = f"{path}: scene {short_repr(scene)}"
            raise DatasetError(f"{where} has a crossing of bar {unknown[0]}, expected bars with an axis")
    return by_scene, CrossingsSource(CROSSINGS_FILE, folder.files[CROSSINGS_FILE])


def write_crossings(
    path: Path, bars: Mapping[str, Sequence[Bar]], known: Mapping[str, Crossings] | None = None
) -> None:
    """Write the crossings of the bars of all scenes, sorted by scene name; ``known`` ones are not computed."""
    by_scene = {**dict.fromkeys(bars), **(known or {})}
    rows = [
        row
        for scene, crossings in sorted(by_scene.items(), key=lambda item: item[0])
        for row in _rows(scene, scene_crossings(bars[scene]) if crossings is None else crossings)
    ]
    write_table(path, rows, CROSSINGS_SCHEMA)


def crossings_entry(path: Path) -> dict[str, Any]:
    """Return the manifest's entry ``crossings``: the parameters of the definition, and the digest of the table."""
    return {**crossing_parameters(), "file": path.name, "digest": f"sha256:{file_sha256(path)}"}


def read_crossings(path: Path) -> dict[str, Crossings]:
    """Read a ``crossings.parquet`` and return the crossings of each scene that has any, keyed by scene name.

    Raises ``DatasetError`` if the file is missing, is not such a table, is larger than ``TABLE_BYTES``, or holds
    an invalid crossing.
    """
    max_bytes = TABLE_BYTES.value()
    table = Table(CROSSINGS_SCHEMA, max_bytes // _MIN_ROW_BYTES, max_bytes, dict.fromkeys(_POINTS, 3))
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in read_table(path, table, "crossings"):
        if None in row.values() or any(None in row[name] for name in _POINTS):
            raise DatasetError(f"{path}: a crossing has no value in a column, expected one in each")
        rows.setdefault(row["scene"], []).append(row)
    return {scene: _crossings(path, scene, of_scene) for scene, of_scene in rows.items()}


def crossings(root: str | Path) -> DataFrame:
    """Return the crossings of every scene of a dataset folder or Hub repository as a frame, one row per crossing.

    Columns as in ``crossings.parquet``; points and ``normal`` are float64 arrays of 3, world frame, metres. For
    folders without the file, crossings are computed from the bars. Raises ``DatasetError`` if the folder is
    invalid, or its table of crossings or bars is damaged or not that of the manifest.
    """
    import pandas as pd  # Half a second to import, which reading crossings for scoring does not need.

    by_scene, _ = folder_crossings(open_folder(root))
    rows = [row for scene, of_scene in sorted(by_scene.items()) for row in _rows(scene, of_scene)]
    frame = pd.DataFrame(rows, columns=CROSSINGS_SCHEMA.names)
    for name in _POINTS:
        frame[name] = [np.array(point) for point in frame[name]]
    return frame


def _rows(scene: str, crossings: Crossings) -> list[dict[str, Any]]:
    """Return the rows of a scene's crossings."""
    columns = [crossings.crossing_id, *(getattr(crossings, field) for field in _FIELD_BY_COLUMN.values())]
    values = zip(*(column.tolist() for column in columns), strict=True)
    return [dict(zip(CROSSINGS_SCHEMA.names, (scene, *row), strict=True)) for row in values]


def _crossings(path: Path, scene: str, rows: Sequence[Mapping[str, Any]]) -> Crossings:
    """Return the crossings of a scene's rows; raise ``DatasetError`` if a value is invalid."""
    columns = {name: np.array([row[name] for row in rows]) for name in CROSSINGS_SCHEMA.names[1:]}
    numbers = [columns[name].reshape(len(rows), -1) for name in (*_POINTS, "gap_m", "angle_deg")]
    lengths = np.linalg.norm(columns["normal"], axis=1)
    for valid, expected in (
        ((columns["crossing_id"] == np.arange(1, len(rows) + 1)).all(), "crossing_id to count from 1"),
        ((columns["node_id"] >= 1).all(), "node_id of 1 or more"),
        ((columns["bar_a"] >= 1).all() and (columns["bar_a"] <= columns["bar_b"]).all(), "1 <= bar_a <= bar_b"),
        (np.isfinite(np.concatenate(numbers, axis=1)).all(), "finite numbers"),
        ((np.abs(lengths - 1) <= _UNIT_TOLERANCE).all(), "normals of length 1"),
    ):
        if not valid:
            raise DatasetError(f"{path}: scene {short_repr(scene)}: invalid crossings, expected {expected}")
    return Crossings(**{field: columns[name] for name, field in _FIELD_BY_COLUMN.items()})
