"""The data of one checked entry: bounded inflation, exact length, verified checksum."""

from __future__ import annotations

import zlib

from zlib_ng import zlib_ng

from rebar_depth_bench.submission.problems import EntryError, show
from rebar_depth_bench.submission.sources import ByteSource
from rebar_depth_bench.submission.zip_checks import DEFLATED, CheckedEntry


def read_data(source: ByteSource, checked: CheckedEntry) -> memoryview:
    """Return the entry's uncompressed bytes; a stored entry is a view on the source, not a copy.

    Call it only for entries without problems: their declared size is what bounds the memory. Raises
    ``EntryError`` for corrupt data.
    """
    entry = checked.entry
    name = show(entry.name)
    try:
        data = source.read_at(checked.data_offset, entry.compressed_size)
    except EOFError as error:
        raise EntryError(f"{name}: the archive was shortened while it was read: {error}") from error
    if entry.method == DEFLATED:
        data = _inflate(name, data, entry.size)
    crc = zlib_ng.crc32(data)  # six times as fast as zlib's: the rest of a view's read takes less
    if crc != entry.crc:
        raise EntryError(f"{name}: the data is corrupt: its checksum is {crc:08x}, expected {entry.crc:08x}")
    return data


def _inflate(name: str, data: memoryview, size: int) -> memoryview:
    inflater = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        # One byte more than declared is enough to tell a longer stream from a right one.
        inflated = inflater.decompress(data, size + 1)
    except zlib.error as error:
        raise EntryError(f"{name}: the deflated data is corrupt ({error}), expected {size} bytes") from error
    if len(inflated) > size:
        raise EntryError(f"{name}: the data inflates to more than {size} bytes, expected the declared {size}")
    if not inflater.eof or len(inflated) != size:
        raise EntryError(f"{name}: the data inflates to {len(inflated)} bytes and stops, expected {size}")
    if inflater.unused_data:
        raise EntryError(f"{name}: {len(inflater.unused_data)} bytes follow the deflated data, expected none")
    return memoryview(inflated)
