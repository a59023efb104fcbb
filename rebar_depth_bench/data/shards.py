"""Shards of a config, and other Parquet files from outside, whose footer is checked before any page is read.

A few bytes can declare gigabytes: a page that a general compressor expands a thousandfold, or a list of a billion
elements. The footer therefore has to declare the expected schema, no more rows and values than expected, and a
compression that expands its input at most about twentyfold.

The footer is parsed in Python, because pyarrow ends the process where a damaged footer is inspected. It is a
structure of Thrift's compact protocol. Structures become dicts by field number, as ``parquet.thrift`` numbers the
fields.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.base.errors import DatasetError, InputError, escape_text, library_message
from rebar_depth_bench.base.limits import CELL_BYTES
from rebar_depth_bench.base.reading import open_regular
from rebar_depth_bench.base.writing import atomic_replace
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import CAMERA_SHAPES, ROW_SCHEMA, column_kind, validated_columns

_TAIL_BYTES = 8
"""Length of the end of a file: the number of bytes of the footer (32 bits, little-endian), and ``PAR1``."""
_READ_BYTES = 1 << 16
"""Bytes that are read first; pyarrow reads the same range, which a file of the Hub then has in memory."""
_MAX_NESTING = 16
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _LIST, _SET, _STRUCT = 1, 2, 3, 7, 8, 9, 10, 12
_INTEGERS = (4, 5, 6)


class ParquetError(ValueError):
    """Parquet file that is damaged or does not hold the expected table."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Values of one column in one row group, as the footer declares them."""

    column: str
    rows: int
    compression: int
    values: int
    decoded_bytes: int


@dataclass(frozen=True, slots=True)
class Footer:
    """Number of rows of a file, and its column chunks."""

    rows: int
    chunks: tuple[Chunk, ...]


def read_footer(stream: BinaryIO, max_bytes: int) -> Footer:
    """Return the footer of a file. Raises ``ParquetError`` if it is damaged or has more than ``max_bytes``."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _READ_BYTES))
    content = stream.read(_READ_BYTES)
    footer_bytes = int.from_bytes(content[-_TAIL_BYTES:-4], "little")
    if not content.endswith(b"PAR1") or footer_bytes > size - _TAIL_BYTES:
        raise ParquetError("the file does not end like a Parquet file")
    if footer_bytes > max_bytes:
        raise ParquetError(f"the footer has {footer_bytes} bytes, expected at most {max_bytes}")
    if footer_bytes > len(content) - _TAIL_BYTES:
        stream.seek(size - _TAIL_BYTES - footer_bytes)
        content = stream.read(footer_bytes + _TAIL_BYTES)
    stream.seek(0)
    try:
        return _footer(_read_structure(content[-_TAIL_BYTES - footer_bytes : -_TAIL_BYTES], 0)[0])
    except (AttributeError, LookupError, TypeError, UnicodeDecodeError) as error:
        raise ParquetError(f"the footer is damaged ({type(error).__name__})") from None


def _footer(metadata: dict[int, Any]) -> Footer:
    chunks = []
    for group in metadata[4]:
        for column in group[1]:
            if 1 in column:
                raise ParquetError("the values of a column are in another file")
            values = column[3]
            name = values[3][0].decode()
            chunks.append(Chunk(name, int(group[3]), int(values[4]), int(values[5]), int(values[6])))
    rows = sum(int(group[3]) for group in metadata[4])
    if rows != metadata[3] or any(min(chunk.rows, chunk.values, chunk.decoded_bytes) < 0 for chunk in chunks):
        raise ParquetError("the numbers of the footer contradict each other")
    return Footer(rows, tuple(chunks))


def _read_structure(content: bytes, position: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """Return a structure as a dict of its fields by number, and the position behind it.

    Integers are read here without a call, because a footer has a hundred thousand of them. Raises ``LookupError``
    at the end of the content.
    """
    if depth > _MAX_NESTING:
        raise ParquetError("the footer is nested too deep")
    fields: dict[int, Any] = {}
    number = 0
    while header := content[position]:
        position += 1
        kind = header & 15
        if header < 16:
            value, position = _read_varint(content, position)
            number = (value >> 1) ^ -(value & 1)
        else:
            number += header >> 4
        if kind in _INTEGERS:
            value = content[position]
            position += 1
            if value & 128:
                value, position = _read_varint(content, position - 1)
            fields[number] = (value >> 1) ^ -(value & 1)
        elif kind in (_TRUE, _FALSE):
            fields[number] = kind == _TRUE
        else:
            fields[number], position = _read_value(content, position, kind, depth)
    return fields, position + 1


def _read_value(content: bytes, position: int, kind: int, depth: int) -> tuple[Any, int]:
    """Return a value of any type but a boolean field, and the position behind it."""
    if kind == _STRUCT:
        return _read_structure(content, position, depth + 1)
    if kind in (_LIST, _SET):
        return _read_list(content, position, depth + 1)
    if kind == _BINARY:
        count, position = _read_varint(content, position)
        return content[position : position + count], position + count
    if kind in _INTEGERS:
        value, position = _read_varint(content, position)
        return (value >> 1) ^ -(value & 1), position
    if kind in (_TRUE, _FALSE, _BYTE):  # The elements of a list of booleans are bytes.
        return content[position], position + 1
    if kind == _DOUBLE:
        return content[position : position + 8], position + 8
    raise ParquetError(f"the footer has a value of type {kind}, which no Parquet file has")


def _read_list(content: bytes, position: int, depth: int) -> tuple[list[Any], int]:
    header = content[position]
    position += 1
    count = header >> 4
    if count == 15:
        count, position = _read_varint(content, position)
    if count > len(content) - position or depth > _MAX_NESTING:
        raise ParquetError("the footer ends within a list, or is nested too deep")
    values = []
    for _ in range(count):
        value, position = _read_value(content, position, header & 15, depth)
        values.append(value)
    return values, position


def _read_varint(content: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while (byte := content[position]) & 128:
        value |= (byte & 127) << shift
        shift += 7
        position += 1
        if shift > 63:
            raise ParquetError("the footer has an integer of more than 64 bits")
    return value | byte << shift, position + 1


# Tables and rows of Parquet files.

_COMPRESSIONS = {0: "none", 1: "snappy"}
_MAX_STRING_BYTES = 1 << 22


@dataclass(frozen=True)
class Table:
    """Expected content of a Parquet file; further columns are not read, and columns of ``optional`` may be absent.

    ``max_values`` limits the values of a column on average over the rows (default: 1 per row), and ``max_bytes``
    the decoded size of all columns of ``schema`` together.
    """

    schema: pa.Schema
    max_rows: int
    max_bytes: int
    max_values: Mapping[str, int] = field(default_factory=dict)
    optional: frozenset[str] = frozenset()

    @property
    def max_footer_bytes(self) -> int:
        """Largest accepted footer, bytes; a footer with a row group for each row has about 4 kB for a group."""
        return (1 << 18) + (min(self.max_rows, 1 << 11) << 13)

    def check(self, footer: Footer) -> None:
        """Raise ``ParquetError`` if a footer declares more rows, values or bytes, or another compression."""
        if footer.rows > self.max_rows:
            raise ParquetError(f"the file has {footer.rows} rows, expected at most {self.max_rows}")
        names = frozenset(self.schema.names)
        for chunk in footer.chunks:
            if chunk.column in names:
                if chunk.compression not in _COMPRESSIONS:
                    expected = " or ".join(_COMPRESSIONS.values())
                    raise ParquetError(f"column {chunk.column} is compressed otherwise than expected: {expected}")
                max_values = chunk.rows * self.max_values.get(chunk.column, 1)
                if chunk.values > max_values:
                    found = f"column {chunk.column} has {chunk.values} values"
                    raise ParquetError(f"{found}, expected at most {max_values}")
        if (size := self.decoded_bytes(footer)) > self.max_bytes:
            raise ParquetError(f"the file has {size} decoded bytes, expected at most {self.max_bytes}")

    def decoded_bytes(self, footer: Footer) -> int:
        """Return the decoded size of the columns of ``schema`` that a footer declares."""
        chunks = (chunk for chunk in footer.chunks if chunk.column in self.schema.names)
        return sum(max(8 * chunk.values, chunk.decoded_bytes) for chunk in chunks)


@contextmanager
def open_parquet(stream: BinaryIO, table: Table) -> Iterator[pq.ParquetFile]:
    """Yield the Parquet file in ``stream``, after checking that it declares ``table``.

    Raises ``ParquetError``, or another ``ValueError``, ``OSError`` or ``pa.ArrowException`` for a damaged file.
    """
    footer = read_footer(stream, table.max_footer_bytes)
    table.check(footer)
    max_elements = max(len(footer.chunks), 1 << 12)
    limits = {"thrift_string_size_limit": _MAX_STRING_BYTES, "thrift_container_size_limit": max_elements}
    with pq.ParquetFile(stream, **limits) as file:
        _check_schema(file.schema_arrow, table)
        yield file


def read_rows(
    file: pq.ParquetFile, schema: pa.Schema, *, batch_rows: int = 1, row_groups: Sequence[int] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of an open file; ``batch_rows`` of them are converted to Python objects at a time.

    Columns of ``schema`` that the file lacks are left out. ``row_groups`` are the indices of the row groups that
    are read (default: all).
    """
    present = pa.schema([column for column in schema if column.name in file.schema_arrow.names])
    # A thread of pyarrow that releases the Python file while the interpreter exits ends the process with SIGABRT.
    batches = file.iter_batches(
        batch_size=batch_rows, row_groups=row_groups, columns=present.names, use_threads=False
    )
    for batch in batches:
        yield from batch.select(present.names).cast(present).to_pylist()


def read_table(path: Path, table: Table, what: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of a Parquet file from outside; ``what`` is its content, for messages.

    Raises ``DatasetError`` if the file is missing, damaged, or does not hold ``table``.
    """
    try:
        with open_regular(path) as stream, open_parquet(stream, table) as file:
            yield from read_rows(file, table.schema, batch_rows=1000)
    except Exception as error:  # pyarrow raises many types, which depend on the damage.
        reason = library_message(error)
        raise DatasetError(f"{path}: cannot be read as a table of {what}: {reason}") from error


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> None:
    """Write rows as a Parquet file, atomically."""
    with atomic_replace(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), temporary)


def _check_schema(found: pa.Schema, table: Table) -> None:
    for column in table.schema:
        occurrences = found.names.count(column.name)
        if not occurrences and column.name in table.optional:
            continue
        if occurrences != 1:
            raise ParquetError(f"the file has {occurrences or 'no'} columns named {column.name}, expected one")
        found_type = found.field(column.name).type
        try:
            pa.array([], found_type).cast(column.type)
        except pa.ArrowException:
            raise ParquetError(f"column {column.name} is {str(found_type)[:60]}, expected {column.type}") from None


def check_shards(config: DatasetConfig) -> None:
    """Check the footers of a local config's shards; shards of the Hub are checked when they are read.

    Raises ``DatasetError`` for a missing or damaged shard, and if the manifest has another number of views.
    """
    if config.local is not None:
        table, rows = rows_table(ROW_SCHEMA.names, len(config.views)), 0
        for shard in config.shards:
            with _open_shard(config, shard, table) as file:
                rows += file.metadata.num_rows
        if rows != (views := len(config.views)):
            found = f"config {config.name} has {rows} rows"
            raise DatasetError(f"{config.root}: {found}, expected the manifest's {views} views")


def encoded_rows(
    config: DatasetConfig, columns: Sequence[str], view_ids: Collection[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a config, or of some of its views, one at a time, with images and depth encoded.

    Raises ``DatasetError`` for a damaged shard, and if a view is missing; if all views are read, also if a view
    occurs twice or is not in the manifest.
    """
    columns = validated_columns(columns)
    if view_ids is None and config.whole is not config:
        view_ids = config.view_ids
    known = frozenset(config.view_ids if view_ids is None else view_ids)
    remaining = set(known)
    shards = config.shards if view_ids is None else _shards_with(config, view_ids)
    for row in shard_rows(config, ("view_id", *columns), shards, None if view_ids is None else remaining):
        view_id = row["view_id"]
        if view_id not in remaining:
            found = f"view {escape_text(str(view_id))}"
            problem = (
                f"{found} occurs twice, expected once" if view_id in known else f"{found} is not in the manifest"
            )
            raise DatasetError(f"{config.root}: {problem}")
        remaining.remove(view_id)
        yield {name: row[name] for name in columns}
        if view_ids is not None and not remaining:
            return
    if remaining:
        raise DatasetError(
            f"{config.root}: {config.name} lacks {len(remaining)} views, among them {min(remaining)}"
        )


def _shards_with(config: DatasetConfig, view_ids: Collection[str]) -> list[str]:
    """Return the shards of the scenes of some views; for a single view, the most probable shard comes first."""
    scenes = {config.scene_by_view[view_id] for view_id in view_ids}
    shards = [shard for scene in config.scenes if scene.name in scenes for shard in scene.shards]
    if len(view_ids) == 1:
        [view_id] = view_ids
        in_scene = [other for other in config.view_ids if config.scene_by_view[other] in scenes]
        expected = in_scene.index(view_id) * len(shards) // len(in_scene)
        shards = sorted(shards, key=lambda shard: abs(shards.index(shard) - expected))
    return shards


def shard_rows(
    config: DatasetConfig, columns: Sequence[str], shards: Sequence[str], view_ids: Collection[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield all rows of ``shards``, or the rows of some views, with the cells of ``columns`` encoded.

    If a shard has one row group for each view, as the builder writes it, only the rows of these views are read.
    Raises ``DatasetError`` for a damaged shard.
    """
    table = rows_table(("view_id", *columns), len(config.whole.views))
    for shard in shards:
        with _open_shard(config, shard, table) as file:
            groups = None
            if view_ids is not None:
                stored = file.read(columns=["view_id"], use_threads=False)["view_id"].to_pylist()
                wanted = [index for index, view_id in enumerate(stored) if view_id in view_ids]
                groups = wanted if not wanted or file.num_row_groups == len(stored) else None
            for row in read_rows(file, table.schema, row_groups=groups):
                if view_ids is None or row["view_id"] in view_ids:
                    yield {name: row[name] for name in columns}


def rows_table(columns: Sequence[str], max_rows: int) -> Table:
    """Return the table that a Parquet file with ``columns`` of dataset rows must hold."""
    return Table(
        pa.schema([ROW_SCHEMA.field(name) for name in dict.fromkeys(columns)]),
        max_rows=max_rows,
        max_bytes=max_rows * len(columns) * CELL_BYTES.value(),
        max_values={name: math.prod(CAMERA_SHAPES.get(column_kind(name), ())) for name in columns},
    )


@contextmanager
def _open_shard(config: DatasetConfig, shard: str, table: Table) -> Iterator[pq.ParquetFile]:
    try:
        with config.open(shard) as stream, open_parquet(stream, table) as file:
            yield file
    except InputError:
        raise
    except Exception as error:  # pyarrow and the Hub's client raise many types, which depend on the damage.
        raise DatasetError(
            f"{config.root}: config {config.name} cannot be read: {shard}: {library_message(error)}; "
            f"rebar-bench verify {config.root} lists damaged files"
        ) from error
