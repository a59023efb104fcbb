"""Encoding of rendered views as dataset rows, their staging, and their packing into shards.

A build works in a staging folder named by the digest of everything that determines its bytes. Each view is staged
as a one-row Parquet file that contains its manifest record in the metadata; files are created by a rename, so an
existing file is complete. A shard consists of the staged rows of a fixed range of views, so its bytes do not
depend on the number of workers or attempts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.atomic_io import atomic_replace
from rebar_depth_bench.data import codecs
from rebar_depth_bench.data.rows import CAMERA_KINDS, EyeTruth, EyeView, absent_cell
from rebar_depth_bench.data.schema import COLUMNS, ROW_SCHEMA, ViewRecord, column_kind, features
from rebar_depth_bench.data.shards import open_parquet, rows_table
from rebar_depth_bench.errors import InputError, Problem, escape_text
from rebar_depth_bench.reading import open_regular, parse_json
from rebar_depth_bench.reporting.colormap import depth_preview
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.validation import validate_table

VIEWS_PER_SHARD = 8
_RECORD_KEY = b"rebar_view_record"
_PARQUET = {"compression": "none", "use_dictionary": False, "write_statistics": False}
"""Parquet writer options: no compression, since the cells contain compressed images."""


@dataclass(frozen=True)
class Staging:
    """Staging folder of a config during a build, and the paths of the files in it."""

    root: Path

    @property
    def mesh(self) -> Path:
        """Path of the mesh of the scene."""
        return self.root / "mesh.ply"

    @property
    def cage(self) -> Path:
        """Path of the bars that were read from a user's file; a generated assembly has no such file."""
        return self.root / "cage.npz"

    def log(self, shard: int) -> Path:
        """Return the path of the Blender log of a shard."""
        return self.root / "logs" / f"shard-{shard:05d}.log"

    def row(self, index: int) -> Path:
        """Return the path of the staged row of a view."""
        return self.root / "rows" / f"{index:04d}.parquet"

    def shard(self, shard: int) -> Path:
        """Return the path of a packed shard before it is moved to the dataset folder."""
        return self.root / "shards" / f"{shard:05d}.parquet"


def split_into_shards(indices: Sequence[int], views: int = VIEWS_PER_SHARD) -> list[tuple[int, ...]]:
    """Split the view indices of a config into shards, or other runs of ``views`` views."""
    return [tuple(indices[i : i + views]) for i in range(0, len(indices), views)]


def stage_row(path: Path, row: pa.Table, record: ViewRecord) -> None:
    """Write the row of one view, with its record in the metadata, atomically."""
    metadata = {_RECORD_KEY: json.dumps(record.model_dump()).encode()}
    with atomic_replace(path) as temporary:
        pq.write_table(row.replace_schema_metadata(metadata), temporary, **_PARQUET)


def read_staged_record(path: Path, view_id: str) -> ViewRecord:
    """Return the manifest record stored in the staged row of a view.

    Raises ``InputError`` if the file is damaged or holds another view.
    """
    with _open_staged_row(path) as file:
        metadata = file.schema_arrow.metadata or {}
    values, problems = parse_json(metadata.get(_RECORD_KEY, b""), "record")
    record = None if problems else validate_table(ViewRecord, values, problems, "record")
    if record is not None and record.view_id == view_id:
        return record
    raise _damaged_row(path, problems[0] if problems else Problem("conflict", "record", "another view", view_id))


def _damaged_row(path: Path, problem: Problem) -> InputError:
    expected = "a row of an interrupted build; delete the file to render the view again"
    return InputError.from_problems(path, [problem, Problem("invalid", "", "not usable", expected)])


def pack_shard(rows: Sequence[Path], target: Path) -> None:
    """Write the staged ``rows`` as one Parquet shard with one row group per view, to keep streaming cheap.

    Raises ``InputError`` if a row is damaged.
    """
    tables = (_read_staged_row(path) for path in rows)
    first = next(tables)
    schema = first.schema.with_metadata(features().arrow_schema.metadata)
    with atomic_replace(target) as temporary, pq.ParquetWriter(temporary, schema, **_PARQUET) as writer:
        for table in (first, *tables):
            writer.write_table(table.replace_schema_metadata(schema.metadata))


def stage_published_rows(shard: Path, targets: Mapping[str, Path], records: Mapping[str, ViewRecord]) -> None:
    """Stage the rows of a published shard whose views have ``records``, at the ``targets`` of their ids.

    A shard that cannot be read, and row groups of other columns or of several rows, are left out, so that their
    views are rendered again.
    """
    rows: list[pa.Table] = []
    table = rows_table(ROW_SCHEMA.names, VIEWS_PER_SHARD)
    with suppress(OSError, ValueError), open_regular(shard) as stream, open_parquet(stream, table) as (file, _):
        rows += [file.read_row_group(group) for group in range(file.num_row_groups)]
    for row in rows:
        if row.schema.equals(ROW_SCHEMA) and row.num_rows == 1:
            view_id = row["view_id"][0].as_py()
            if view_id in records:
                stage_row(targets[view_id], row, records[view_id])


def _read_staged_row(path: Path) -> pa.Table:
    with _open_staged_row(path) as file:
        table = file.read()
    if not table.schema.equals(ROW_SCHEMA) or table.num_rows != 1:
        raise _damaged_row(path, Problem("invalid", "", f"{table.num_rows} rows of other columns", "one row"))
    return table


@contextmanager
def _open_staged_row(path: Path) -> Iterator[pq.ParquetFile]:
    """Yield the staged row of a view. Raises ``InputError`` if the file is damaged or no such row."""
    try:
        with open_regular(path) as stream, open_parquet(stream, rows_table(ROW_SCHEMA.names, 1)) as (file, _):
            yield file
    except (OSError, ValueError) as error:
        raise _damaged_row(path, Problem("damaged", "", f"no Parquet file: {escape_text(str(error))}")) from None


@dataclass(frozen=True, eq=False)
class View:
    """Rendered stereo view of a scene; both eyes have colour, or neither."""

    view_id: str
    scene: str
    left: EyeView
    right: EyeView
    baseline_m: float


def encode_view(view: View) -> tuple[pa.Table, ViewRecord]:
    """Return a view as a one-row table of ``ROW_SCHEMA``, and its record for the manifest."""
    columns: dict[str, Any] = {"view_id": view.view_id, "scene": view.scene, "baseline_m": view.baseline_m}
    for name, eye in (("left", view.left), ("right", view.right)):
        columns |= {f"{name}_{kind}": getattr(eye, kind) for kind in ("rgb", "mask", "bars")}
        columns |= {f"{name}_{kind}": getattr(eye.camera, kind) for kind in CAMERA_KINDS}
        columns[f"{name}_depth"] = eye.depth_m
    return encode_row(columns), view_record(view.view_id, view.left, view.right)


def encode_row(columns: Mapping[str, Any]) -> pa.Table:
    """Return a one-row table of ``ROW_SCHEMA``; a column that is missing or None is absent.

    ``columns`` holds what ``rebar_depth_bench.load`` returns, without the preview, which is made from the depth.
    """
    preview: Any = _image_cell(codecs.encode_palette(*depth_preview(columns["left_depth"])))
    cells = {"left_preview": preview}
    for name in COLUMNS:
        value, kind = columns.get(name), column_kind(name)
        if value is not None:
            cells[name] = _ENCODERS.get(kind, _plain)(value)
        elif name not in cells:
            cells[name] = absent_cell(kind)
    return pa.Table.from_pylist([cells], schema=ROW_SCHEMA)


def _plain(value: Any) -> Any:
    return value


_ENCODERS: Mapping[str, Callable[[Any], Any]] = {
    "rgb": lambda rgb: _image_cell(codecs.encode_rgb(rgb)),
    "depth": codecs.encode_depth,
    "mask": lambda mask: _image_cell(codecs.encode_mask(mask)),
    "bars": lambda bars: _image_cell(codecs.encode_bars(bars)),
    **dict.fromkeys(CAMERA_KINDS, lambda array: array.tolist()),
}
"""Encoders of cells by column kind; values of other kinds are stored as they are."""


def _image_cell(content: bytes) -> dict[str, bytes | None]:
    return {"bytes": content, "path": None}


def view_record(view_id: str, left: EyeTruth, right: EyeTruth | None) -> ViewRecord:
    """Return the record of a view for the manifest; ``right`` is None without depth of the right camera."""
    return ViewRecord(
        view_id=view_id,
        left=left.digest(),
        right=right.digest() if right is not None else None,
        steel_px=None if left.mask is None else int(np.count_nonzero(left.mask)),
        scored_px=len(scored_pixels(left.mask, left.depth_m)),
    )
