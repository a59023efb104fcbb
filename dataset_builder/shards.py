"""Staged rows and the shards they are packed into.

A build works in a staging folder named after everything that decides its bytes. Each view is staged as a
one-row Parquet file that carries its own manifest record; a file that is there is whole, since it got its
name by a rename. A shard is the staged rows of a fixed run of views, so its bytes do not depend on how many
workers, or how many attempts, it took.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.files import replacing
from rebar_depth_bench.folder import ViewRecord

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
