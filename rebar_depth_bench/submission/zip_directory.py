"""Bounded parser of the zip central directory; the limits on its size are checked before it is read.

``zipfile`` is not used for reading: it allocates the sizes that the directory declares, cuts names at NUL and
accepts archives whose entries overlap. All later checks use the records of this parser.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from rebar_depth_bench.errors import EntryError, Problem
from rebar_depth_bench.reading import ByteSource

_END_RECORD = struct.Struct("<4s4H2LH")
_ZIP64_END_LOCATOR = struct.Struct("<4sLQL")
_ZIP64_END_RECORD = struct.Struct("<4sQ2H2L4Q")
_DIRECTORY_RECORD = struct.Struct("<4s4B4H3L5H2L")
_MAX_COMMENT_BYTES = 0xFFFF
_FULL16 = 0xFFFF
_FULL32 = 0xFFFFFFFF
_UTF8_NAME = 0x800
_MAX_BYTES_PER_RECORD = 512


class DirectoryError(EntryError):
    """File that is not a zip or has an invalid directory; ``where`` of the problem is empty."""


@dataclass(frozen=True, slots=True)
class ZipEntry:
    """Record of the central directory; sizes and offsets are in bytes."""

    name: str
    raw_name: bytes
    flags: int
    method: int
    crc: int
    compressed_size: int
    size: int
    header_offset: int
    unix_mode: int
    disk: int


@dataclass(frozen=True, slots=True)
class Directory:
    """Records of the central directory in its order; ``offset`` is the byte where the directory starts."""

    entries: tuple[ZipEntry, ...]
    offset: int


@dataclass(frozen=True, slots=True)
class _EndRecord:
    """End record of a zip with zip64 values resolved; ``position`` is the byte where the directory must end."""

    position: int
    count: int
    size: int
    offset: int


def read_directory(source: ByteSource, max_entries: int) -> Directory:
    """Parse the central directory, which may have at most ``max_entries`` records.

    Raises ``DirectoryError`` if the source is not one complete single-disk zip without leading or trailing bytes.
    """
    end = _find_end_record(source)
    if end.count > max_entries or end.size > max_entries * _MAX_BYTES_PER_RECORD:
        found = f"the zip directory declares {end.count} entries in {end.size} bytes"
        expected = f"at most {max_entries} entries in {max_entries * _MAX_BYTES_PER_RECORD} bytes"
        raise DirectoryError(Problem("size", "", found, expected))
    if end.offset + end.size != end.position:
        found = f"the zip directory is declared at bytes {end.offset} to {end.offset + end.size}"
        reason = "the file is truncated, damaged or has bytes before the archive"
        raise DirectoryError(Problem("damaged", "", found, f"it to end at byte {end.position}: {reason}"))
    data = bytes(source.read_at(end.offset, end.size))
    return Directory(_parse_records(data, end.count), end.offset)


def _find_end_record(source: ByteSource) -> _EndRecord:
    length = min(source.size, _END_RECORD.size + _MAX_COMMENT_BYTES)
    tail = bytes(source.read_at(source.size - length, length))
    offset = tail.rfind(b"PK\x05\x06")
    while offset >= 0:
        fits = offset + _END_RECORD.size <= len(tail)
        if fits and offset + _END_RECORD.size + int.from_bytes(tail[offset + 20 : offset + 22], "little") == len(
            tail
        ):
            return _parse_end_record(
                source, source.size - length + offset, tail[offset : offset + _END_RECORD.size]
            )
        offset = tail.rfind(b"PK\x05\x06", 0, offset + 3)
    if bytes(source.read_at(0, min(4, source.size))) == b"PK\x03\x04":
        found = "the zip has no end record"
        raise DirectoryError(Problem("damaged", "", found, "one at the end: the file is truncated"))
    found = "the file is not a zip: no zip end record was found"
    raise DirectoryError(Problem("syntax", "", found, "a zip archive"))


def _parse_end_record(source: ByteSource, position: int, record: bytes) -> _EndRecord:
    fields: tuple[int, ...] = _END_RECORD.unpack(record)[1:7]
    full = (_FULL16, _FULL16, _FULL16, _FULL16, _FULL32, _FULL32)
    zip64 = _find_zip64_end_record(source, position)
    if zip64 is not None:
        position, expected = zip64
        if any(a not in (b, limit) for a, b, limit in zip(fields, expected, full, strict=True)):
            found = f"the zip end record declares {fields}"
            raise DirectoryError(Problem("damaged", "", found, f"the zip64 end record's {expected}"))
        fields = expected
    disk, start_disk, here, count, size, offset = fields
    if disk or start_disk or here != count:
        found = f"the zip is part of a multi-disk set (disk {disk}, {here} of {count} entries)"
        raise DirectoryError(Problem("kind", "", found, "a single complete file"))
    return _EndRecord(position, count, size, offset)


def _find_zip64_end_record(source: ByteSource, position: int) -> tuple[int, tuple[int, ...]] | None:
    locator_offset = position - _ZIP64_END_LOCATOR.size
    if locator_offset < 0:
        return None
    magic, disk, record_offset, disks = _ZIP64_END_LOCATOR.unpack(
        source.read_at(locator_offset, _ZIP64_END_LOCATOR.size)
    )
    if magic != b"PK\x06\x07":
        return None
    if disk or disks > 1:
        found = f"the zip is part of a multi-disk set of {disks}"
        raise DirectoryError(Problem("kind", "", found, "a single complete file"))
    if record_offset + _ZIP64_END_RECORD.size > locator_offset:
        found = f"the zip64 end record is declared at byte {record_offset}"
        raise DirectoryError(Problem("damaged", "", found, f"it before byte {locator_offset}"))
    magic, length, _, _, *fields = _ZIP64_END_RECORD.unpack(source.read_at(record_offset, _ZIP64_END_RECORD.size))
    if magic != b"PK\x06\x06" or record_offset + 12 + length != locator_offset:
        found = f"no complete zip64 end record was found at byte {record_offset}"
        raise DirectoryError(Problem("damaged", "", found, "one"))
    return record_offset, tuple(fields)


def _parse_records(data: bytes, count: int) -> tuple[ZipEntry, ...]:
    entries: list[ZipEntry] = []
    offset = 0
    while offset < len(data) and len(entries) < count:
        entry, offset = _parse_record(data, offset, len(entries))
        entries.append(entry)
    if len(entries) != count or offset != len(data):
        found = f"the zip directory holds {len(entries)} entries in {offset} bytes"
        raise DirectoryError(Problem("damaged", "", found, f"the declared {count} in {len(data)} bytes"))
    return tuple(entries)


def _parse_record(data: bytes, start: int, index: int) -> tuple[ZipEntry, int]:
    if start + _DIRECTORY_RECORD.size > len(data) or data[start : start + 4] != b"PK\x01\x02":
        found = f"no zip directory record was found for entry {index}"
        raise DirectoryError(Problem("damaged", "", found, f"one at +{start}"))
    fields = _DIRECTORY_RECORD.unpack_from(data, start)
    flags, method = fields[5], fields[6]
    crc, compressed, size, name_length, extra_length, comment_length, disk = fields[9:16]
    attributes, offset = fields[17], fields[18]
    name_end = start + _DIRECTORY_RECORD.size + name_length
    extra_end = name_end + extra_length
    if extra_end + comment_length > len(data):
        found = f"the zip directory record of entry {index} extends past the directory's end"
        raise DirectoryError(Problem("damaged", "", found))
    raw_name = data[start + _DIRECTORY_RECORD.size : name_end]
    name = raw_name.decode("utf-8" if flags & _UTF8_NAME else "cp437", errors="backslashreplace")
    size, compressed, offset = _apply_zip64_sizes((size, compressed, offset), data[name_end:extra_end], index)
    entry = ZipEntry(name, raw_name, flags, method, crc, compressed, size, offset, attributes >> 16, disk)
    return entry, extra_end + comment_length


def _apply_zip64_sizes(values: tuple[int, int, int], extra: bytes, index: int) -> tuple[int, int, int]:
    """Replace each saturated 32-bit value by its 64-bit value from the zip64 extra field."""
    if _FULL32 not in values:
        return values
    zip64_values = _zip64_field(extra)
    needed = sum(value == _FULL32 for value in values)
    if len(zip64_values) < 8 * needed:
        found = f"the zip directory record of entry {index} lacks its zip64 sizes"
        raise DirectoryError(Problem("damaged", "", found, f"{needed}"))
    replacements = iter(struct.unpack_from(f"<{needed}Q", zip64_values))
    size, compressed, offset = (next(replacements) if value == _FULL32 else value for value in values)
    return size, compressed, offset


def _zip64_field(extra: bytes) -> bytes:
    offset = 0
    while offset + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, offset)
        if kind == 1:
            return extra[offset + 4 : offset + 4 + length]
        offset += 4 + length
    return b""
