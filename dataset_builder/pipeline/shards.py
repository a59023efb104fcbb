"""Encoding of rendered views as dataset rows, their staging, and their packing into shards.

A scene is built in a staging folder named by its key (``plan``). Each view is staged as a one-row Parquet file
that contains its manifest record in the metadata; files are created by a rename, so an existing file is complete.
A shard consists of the staged rows of a fixed range of views, so its bytes do not depend on the number of workers
or attempts.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.base.errors import InputError, Problem, escape_text
from rebar_depth_bench.base.reading import open_regular, parse_json
from rebar_depth_bench.base.validation import validate_table
from rebar_depth_bench.base.writing import atomic_replace
from rebar_depth_bench.data import codecs
from rebar_depth_bench.data.rows import RenderedEye, absent_cell, truth_from_row
from rebar_depth_bench.data.schema import CAMERA_SHAPES, COLUMNS, ROW_SCHEMA, ViewRecord, column_kind, features
from rebar_depth_bench.data.shards import open_parquet, rows_table
from rebar_depth_bench.reporting.colormap import depth_preview
from rebar_depth_bench.scoring.protocol import scored_pixels

ViewT = TypeVar("ViewT")
VIEWS_PER_SHARD = 8
_RECORD_KEY = b"rebar_view_record"
_PARQUET = {"compression": "none", "use_dictionary": False, "write_statistics": ["view_id", "scene"]}
"""Parquet writer options: no compression, since the cells contain compressed images.

The statistics let a filter on scene or view skip the row groups of others; those of images would be bytes.
"""


@dataclass(frozen=True)
class Staging:
    """Staging folder of a config during a build, and the paths of the files in it."""

    root: Path

    @property
    def mesh(self) -> Path:
        """Path of the mesh of the scene."""
        return self.root / "mesh.ply"

    @property
    def mesh_digest(self) -> Path:
        """Path of the SHA-256 of the mesh that the staged rows were cast against."""
        return self.root / "mesh.sha256"

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


def split_into_shards(views: Sequence[ViewT], count: int = VIEWS_PER_SHARD) -> list[Sequence[ViewT]]:
    """Split the views of a config into runs of ``count`` views, such as the views of each shard."""
    return [views[i : i + count] for i in range(0, len(views), count)]


def stage_row(path: Path, row: pa.Table, record: ViewRecord) -> None:
    """Write the row of one view, with its record in the metadata, atomically."""
    metadata = {_RECORD_KEY: json.dumps(record.model_dump()).encode()}
    with atomic_replace(path) as temporary:
        pq.write_table(row.replace_schema_metadata(metadata), temporary, **_PARQUET)


def _damaged_row(path: Path, problem: Problem) -> InputError:
    expected = "a row of an interrupted build; delete the file to render the view again"
    return InputError.from_problems(path, [problem, Problem("invalid", "", "not usable", expected)])


def pack_shard(rows: Mapping[str, Path], target: Path) -> list[ViewRecord]:
    """Write staged ``rows``, paths by view id, as one Parquet shard; return the records of the views.

    There is one row group per view, to keep streaming cheap. Raises ``InputError`` if a row is damaged or that of
    another view.
    """
    staged = [_read_staged_row(path, view_id) for view_id, path in rows.items()]
    schema = staged[0][0].schema.with_metadata(features().arrow_schema.metadata)
    with atomic_replace(target) as temporary, pq.ParquetWriter(temporary, schema, **_PARQUET) as writer:
        for row, _ in staged:
            writer.write_table(row.replace_schema_metadata(schema.metadata))
    return [record for _, record in staged]


def stage_published_rows(shard: Path, targets: Mapping[str, Path], records: Mapping[str, ViewRecord]) -> None:
    """Stage the rows of a published shard whose views have ``records``, at the ``targets`` of their ids.

    A shard that cannot be read, and row groups of other columns or of several rows, are left out, so that their
    views are rendered again.
    """
    rows: list[pa.Table] = []
    table = rows_table(ROW_SCHEMA.names, VIEWS_PER_SHARD)
    with suppress(OSError, ValueError), open_regular(shard) as stream, open_parquet(stream, table) as file:
        rows += [file.read_row_group(group) for group in range(file.num_row_groups)]
    for row in rows:
        if row.schema.equals(ROW_SCHEMA) and row.num_rows == 1:
            view_id = row["view_id"][0].as_py()
            if view_id in records:
                stage_row(targets[view_id], row, records[view_id])


def _read_staged_row(path: Path, view_id: str) -> tuple[pa.Table, ViewRecord]:
    """Return the staged row of a view and its record. Raises ``InputError`` if the file has no such row."""
    try:
        with open_regular(path) as stream, open_parquet(stream, rows_table(ROW_SCHEMA.names, 1)) as file:
            row = file.read()
    except (OSError, ValueError) as error:
        raise _damaged_row(path, Problem("damaged", "", f"no Parquet file: {escape_text(str(error))}")) from None
    if not row.schema.equals(ROW_SCHEMA) or row.num_rows != 1:
        raise _damaged_row(path, Problem("invalid", "", f"{row.num_rows} rows of other columns", "one row"))
    values, problems = parse_json((row.schema.metadata or {}).get(_RECORD_KEY, b""), "record")
    record = None if problems else validate_table(ViewRecord, values, problems, "record")
    if record is None:
        raise _damaged_row(path, problems[0])
    if record.view_id != view_id:
        raise _damaged_row(path, Problem("conflict", "record", "another view", view_id))
    return row, record


@dataclass(frozen=True, eq=False)
class View:
    """Rendered stereo view of a scene; both eyes have colour, or neither."""

    view_id: str
    scene: str
    left: RenderedEye
    right: RenderedEye
    baseline_m: float


def encode_view(view: View) -> tuple[pa.Table, ViewRecord]:
    """Return a view as a one-row table of ``ROW_SCHEMA``, and its record for the manifest."""
    columns: dict[str, Any] = {"view_id": view.view_id, "scene": view.scene, "baseline_m": view.baseline_m}
    for name, eye in (("left", view.left), ("right", view.right)):
        columns |= {f"{name}_{kind}": getattr(eye, kind) for kind in ("rgb", "mask", "bars")}
        columns |= {f"{name}_{kind}": getattr(eye.camera, kind) for kind in CAMERA_SHAPES}
        columns[f"{name}_depth"] = eye.depth_m
    return encode_row(columns)


def encode_row(columns: Mapping[str, Any]) -> tuple[pa.Table, ViewRecord]:
    """Return a one-row table of ``ROW_SCHEMA``, and the record of its view; columns that are None are absent.

    ``columns`` holds what ``rebar_depth_bench.load`` returns, without the preview, which is made from the depth.
    """
    preview = codecs.encode_palette(*depth_preview(columns["left_depth"]))
    cells: dict[str, Any] = {"left_preview": _image_cell(preview)}
    for name in COLUMNS:
        value, kind = columns.get(name), column_kind(name)
        if value is not None:
            encode = _ENCODERS.get(kind)
            cells[name] = value if encode is None else encode(value)
        elif name not in cells:
            cells[name] = absent_cell(kind)
    left = truth_from_row(columns, "left")
    record = ViewRecord(
        view_id=columns["view_id"],
        left=left.digest(),
        right=truth_from_row(columns, "right").digest() if columns["right_depth"] is not None else None,
        steel_px=None if left.mask is None else int(np.count_nonzero(left.mask)),
        scored_px=len(scored_pixels(left.mask, left.depth_m)),
    )
    return pa.Table.from_pylist([cells], schema=ROW_SCHEMA), record


_ENCODERS: Mapping[str, Callable[[Any], Any]] = {
    "rgb": lambda rgb: _image_cell(codecs.encode_rgb(rgb)),
    "depth": codecs.encode_depth,
    "mask": lambda mask: _image_cell(codecs.encode_png(mask)),
    "bars": lambda bars: _image_cell(codecs.encode_png(bars)),
    **dict.fromkeys(CAMERA_SHAPES, lambda array: array.tolist()),
}
"""Encoders of cells by column kind; values of other kinds are stored as they are."""


def _image_cell(content: bytes) -> dict[str, bytes | None]:
    return {"bytes": content, "path": None}
