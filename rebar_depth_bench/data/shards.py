"""Rows of a config's shards, read with pyarrow and compared with the manifest; images stay encoded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.data.columns import ROW_SCHEMA, column_kind
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.parquet import Table, open_parquet, read_rows
from rebar_depth_bench.errors import DatasetError, InputError, escape_text
from rebar_depth_bench.limits import CELL_BYTES

_VALUES = {"K": 9, "distortion": 5, "cam_from_world": 16}
"""Numbers in a cell, by column kind; the other columns have one value per cell."""


def check_shards(config: DatasetConfig) -> None:
    """Check the footers of a local config's shards; those of the Hub are checked when they are read.

    Raises ``DatasetError`` for a missing or damaged shard, and if the manifest has another number of views.
    """
    if config.local is not None:
        table, rows = _shard_table(config, ROW_SCHEMA.names), 0
        for shard in config.shards:
            with _open_shard(config, shard, table) as (_, shard_rows):
                rows += shard_rows
        if rows != (views := len(config.views)):
            found = f"config {config.name} has {rows} rows"
            raise DatasetError(f"{config.root}: {found}, expected the manifest's {views} views")


def all_rows(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of all shards, with the cells of ``columns`` encoded.

    Raises ``DatasetError`` for a damaged shard, and unless each view of the manifest occurs exactly once.
    """
    remaining = set(config.view_ids)
    known = frozenset(remaining)
    for row in iterate_shards(config, ("view_id", *columns), config.shards):
        view_id = row["view_id"]
        if view_id not in remaining:
            found = f"view {escape_text(str(view_id))}"
            problem = (
                f"{found} occurs twice, expected once" if view_id in known else f"{found} is not in the manifest"
            )
            raise DatasetError(f"{config.root}: {problem}")
        remaining.remove(view_id)
        yield {name: row[name] for name in columns}
    if remaining:
        raise DatasetError(
            f"{config.root}: {config.name} lacks {len(remaining)} views, among them {min(remaining)}"
        )


def iterate_shards(
    config: DatasetConfig, columns: Sequence[str], shards: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of ``shards``, with the cells of ``columns`` encoded; only one is in memory at a time.

    Raises ``DatasetError`` for a damaged shard.
    """
    table = _shard_table(config, ("view_id", *columns))
    for shard in shards:
        with _open_shard(config, shard, table) as (file, _):
            for row in read_rows(file, table.schema):
                yield {name: row[name] for name in columns}


def rows_at(config: DatasetConfig, columns: Sequence[str], positions: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Yield the rows at ``positions`` of a local config, whose shards have one row group per view.

    Positions are counted over all shards; the cells of ``columns`` stay encoded. Raises ``DatasetError`` as
    ``check_shards``.
    """
    check_shards(config)
    table, first = _shard_table(config, ("view_id", *columns)), 0
    for shard in config.shards:
        with _open_shard(config, shard, table) as (file, rows):
            row_groups = [position - first for position in positions if first <= position < first + rows]
            for row in read_rows(file, table.schema, row_groups=row_groups):
                yield {name: row[name] for name in columns}
        first += rows


def damaged_error(config: DatasetConfig, error: Exception, shard: str = "") -> DatasetError:
    """Return the error of a config that cannot be read; ``shard`` is the file, if it is known."""
    place = f"{config.root}: config {config.name} cannot be read: {f'{shard}: ' if shard else ''}"
    reason = escape_text(str(error) or type(error).__name__)
    return DatasetError(f"{place}{reason}; rebar-bench verify {config.root} lists damaged files")


def rows_table(columns: Sequence[str], max_rows: int) -> Table:
    """Return the table that a Parquet file with ``columns`` of dataset rows must hold."""
    return Table(
        pa.schema([ROW_SCHEMA.field(name) for name in dict.fromkeys(columns)]),
        max_rows=max_rows,
        max_bytes=max_rows * len(columns) * CELL_BYTES.value(),
        max_values={name: _VALUES.get(column_kind(name), 1) for name in columns},
    )


def _shard_table(config: DatasetConfig, columns: Sequence[str]) -> Table:
    return rows_table(columns, len(config.views))


@contextmanager
def _open_shard(config: DatasetConfig, shard: str, table: Table) -> Iterator[tuple[pq.ParquetFile, int]]:
    try:
        with config.open(shard) as stream, open_parquet(stream, table) as file_and_rows:
            yield file_and_rows
    except InputError:
        raise
    except Exception as error:  # pyarrow and the Hub's client raise many types, which depend on the damage.
        raise damaged_error(config, error, shard) from error
