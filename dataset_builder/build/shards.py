"""Staged rows and the shards they are packed into.

A build works in a staging folder named after everything that decides its bytes. Each view is staged as a
one-row Parquet file that carries its own manifest record; a file that is there is whole, since it got its
name by a rename. A shard is the staged rows of a fixed run of views, so its bytes do not depend on how many
workers, or how many attempts, it took.

A rendered view, and the row of the dataset it becomes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
import pyarrow as pa
import pyarrow.parquet as pq
from rebar_depth_bench.atomic_io import replacing
from rebar_depth_bench.data.manifest import ViewRecord
from dataclasses import dataclass
from typing import Any
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray
from rebar_depth_bench.data import codecs
from rebar_depth_bench.reporting.colormap import depth_preview
from rebar_depth_bench.data.digests import eye_digest
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.data.dataset import features

VIEWS_PER_SHARD = 8
_RECORD_KEY = b"rebar_view_record"
_PARQUET = {"compression": "none", "use_dictionary": False, "write_statistics": False}
"""Cells are compressed images already."""


@dataclass(frozen=True)
class Staging:
    """Where a config's pieces stand while it is built."""

    root: Path

    @property
    def mesh(self) -> Path:
        """The scene's mesh."""
        return self.root / "mesh.ply"

    def log(self, shard: int) -> Path:
        """What Blender printed while it rendered a shard."""
        return self.root / "logs" / f"shard-{shard:05d}.log"

    def row(self, index: int) -> Path:
        """A view's staged row."""
        return self.root / "rows" / f"{index:04d}.parquet"

    def shard(self, shard: int) -> Path:
        """A packed shard, before it gets its name in the dataset folder."""
        return self.root / "shards" / f"{shard:05d}.parquet"


def runs_of_views(indices: Sequence[int]) -> list[tuple[int, ...]]:
    """Cut a config's view indices into the runs that become shards."""
    return [tuple(indices[i : i + VIEWS_PER_SHARD]) for i in range(0, len(indices), VIEWS_PER_SHARD)]


def stage_row(path: Path, row: pa.Table, record: ViewRecord) -> None:
    """Write one view's row with its record, whole or not at all."""
    metadata = {**(row.schema.metadata or {}), _RECORD_KEY: json.dumps(asdict(record)).encode()}
    with replacing(path) as temporary:
        pq.write_table(row.replace_schema_metadata(metadata), temporary, **_PARQUET)


def staged_record(path: Path) -> ViewRecord:
    """Return the manifest record that a staged row carries."""
    return ViewRecord(**json.loads(pq.read_schema(path).metadata[_RECORD_KEY]))


def pack_shard(rows: Sequence[Path], target: Path) -> None:
    """Write the staged ``rows`` as one Parquet shard, a row group a view so that streaming stays light."""
    first = pq.read_table(rows[0])
    metadata = {key: value for key, value in first.schema.metadata.items() if key != _RECORD_KEY}
    schema = first.schema.with_metadata(metadata)
    with replacing(target) as temporary, pq.ParquetWriter(temporary, schema, **_PARQUET) as writer:
        for path in rows:
            writer.write_table(pq.read_table(path).replace_schema_metadata(metadata))


@dataclass(frozen=True, eq=False)
class Eye:
    """What one camera of a stereo view sees, and the camera itself."""

    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    mask: Bool[ndarray, "h w"]
    bars: UInt16[ndarray, "h w"]
    K: Float64[ndarray, "3 3"]
    distortion: Float64[ndarray, 5]
    cam_from_world: Float64[ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class View:
    """One stereo view of a config."""

    view_id: str
    left: Eye
    right: Eye
    baseline_m: float


def encode_view(view: View) -> tuple[pa.Table, ViewRecord]:
    """Return a view as a table of one row in the dataset's schema, and its record for the manifest."""
    cells: dict[str, Any] = {"view_id": view.view_id, "baseline_m": view.baseline_m}
    for name, eye in (("left", view.left), ("right", view.right)):
        cells |= {f"{name}_{kind}": cell for kind, cell in _eye_cells(eye).items()}
    cells["left_preview"] = _image(codecs.encode_palette(*depth_preview(view.left.depth_m)))
    schema = features().arrow_schema
    return pa.Table.from_pylist([cells], schema=schema), _record(view)


def _eye_cells(eye: Eye) -> dict[str, Any]:
    return {
        "rgb": _image(codecs.encode_rgb(eye.rgb)),
        "depth": codecs.encode_depth(eye.depth_m),
        "mask": _image(codecs.encode_mask(eye.mask)),
        "bars": _image(codecs.encode_bars(eye.bars)),
        "K": eye.K.tolist(),
        "distortion": eye.distortion.tolist(),
        "cam_from_world": eye.cam_from_world.tolist(),
    }


def _image(content: bytes) -> dict[str, bytes | None]:
    return {"bytes": content, "path": None}


def _record(view: View) -> ViewRecord:
    left = view.left
    return ViewRecord(
        view_id=view.view_id,
        left=_digest(left),
        right=_digest(view.right),
        steel_px=int(np.count_nonzero(left.mask)),
        scored_px=len(scored_pixels(left.mask, left.depth_m)),
    )


def _digest(eye: Eye) -> str:
    return eye_digest(eye.depth_m, eye.mask, eye.bars, eye.K, eye.distortion, eye.cam_from_world)
