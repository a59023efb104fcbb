"""Parquet files from outside: the footer is checked before any page is read.

A few bytes can declare gigabytes: a page that a general compressor expands a thousandfold, or a list of a billion
elements. The footer therefore has to declare the expected schema, no more rows and values than expected, and a
compression that expands its input at most about twentyfold.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.data.parquet_footer import Footer, ParquetError, read_footer

_COMPRESSIONS = {0: "none", 1: "snappy"}
_MAX_STRING_BYTES = 1 << 22


@dataclass(frozen=True)
class Table:
    """Expected content of a Parquet file; further columns are not read, and those of ``optional`` may be absent.

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
        """Largest accepted footer; one with a row group per row has about 4 kB for each."""
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
def open_parquet(stream: BinaryIO, table: Table) -> Iterator[tuple[pq.ParquetFile, int]]:
    """Yield the Parquet file in ``stream`` and its number of rows, after checking that it declares ``table``.

    Raises ``ParquetError``, or another ``ValueError``, ``OSError`` or ``pa.ArrowException`` for a damaged file.
    """
    footer = read_footer(stream, table.max_footer_bytes)
    table.check(footer)
    max_elements = max(len(footer.chunks), 1 << 12)
    limits = {"thrift_string_size_limit": _MAX_STRING_BYTES, "thrift_container_size_limit": max_elements}
    with pq.ParquetFile(stream, **limits) as file:
        _check_schema(file.schema_arrow, table)
        yield file, footer.rows


def read_rows(
    file: pq.ParquetFile, schema: pa.Schema, *, batch_rows: int = 1, row_groups: Sequence[int] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the rows of an open file, of which ``batch_rows`` are converted to Python objects at a time.

    Columns of ``schema`` that the file lacks are left out. ``row_groups`` are the indices of the row groups that
    are read (default: all).
    """
    present = pa.schema([column for column in schema if column.name in file.schema_arrow.names])
    for batch in file.iter_batches(batch_size=batch_rows, row_groups=row_groups, columns=present.names):
        yield from batch.select(present.names).cast(present).to_pylist()


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
