"""Footer of a Parquet file, parsed in Python: pyarrow ends the process where a damaged footer is inspected.

The footer is a structure of Thrift's compact protocol. Structures become dicts by field number; the numbers used
here are those of ``parquet.thrift``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, BinaryIO

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

    Integers are read here without a call: footers have a hundred thousand. Raises ``LookupError`` at the end of
    the content.
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
