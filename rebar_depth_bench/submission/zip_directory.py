"""Random access to the bytes of an archive: a file on disk, or bytes in memory (an ``.npz`` inside it).

The central directory of a zip, parsed within bounds that are set before anything is read.

``zipfile`` is not used for reading: it allocates whatever the directory claims, cuts names at NUL and
accepts archives whose parts overlap. One parser decides here what every later check sees.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import struct
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

# Below this a read call is cheaper than a mapping and its page faults.
_SMALLEST_MAPPING = 64 * 1024


class ByteSource(Protocol):
    """Bytes that can be read anywhere, by several threads at once."""

    @property
    def size(self) -> int:
        """Length in bytes."""

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the source holds fewer."""


_PIECE_BYTES = 1 << 20


class FileSource:
    """A regular file, read through ``pread`` and short-lived read-only mappings.

    Every large read maps its own range and the mapping dies with the last view on it, so the resident
    memory stays that of the views in use however many gigabytes are read. The file must not be shortened
    while a view is alive (the system would end the process).
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._close = weakref.finalize(self, os.close, self._fd)
        self.size = os.fstat(self._fd).st_size

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the source holds fewer."""
        if offset < 0 or length < 0 or offset + length > os.fstat(self._fd).st_size:
            raise EOFError(f"{length} bytes at {offset} lie past the end of the file")
        if length < _SMALLEST_MAPPING:
            return _exactly(memoryview(os.pread(self._fd, length, offset)), length)
        lead = offset % mmap.ALLOCATIONGRANULARITY
        # Populated at once: a fault for every page would take as long as reading what they hold.
        flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
        mapped = mmap.mmap(self._fd, lead + length, flags, mmap.PROT_READ, offset=offset - lead)
        return memoryview(mapped)[lead:]

    def sha256(self) -> str:
        """Return the hex SHA-256 of the whole file, read in pieces."""
        digest = hashlib.sha256()
        offset = 0
        while piece := os.pread(self._fd, _PIECE_BYTES, offset):
            digest.update(piece)
            offset += len(piece)
        return digest.hexdigest()

    def close(self) -> None:
        """Close the file; views already handed out stay valid. Closing twice is harmless."""
        self._close()
        self._fd = -1


class MemorySource:
    """Bytes in memory."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self.size = len(data)

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the source holds fewer."""
        if offset < 0 or length < 0:
            raise EOFError(f"{length} bytes at {offset} lie outside the data")
        return _exactly(self._data[offset : offset + length], length)


def _exactly(data: memoryview, length: int) -> memoryview:
    if len(data) != length:
        raise EOFError(f"{len(data)} bytes found, expected {length}")
    return data


_END = struct.Struct("<4s4H2LH")
_END64_LOCATOR = struct.Struct("<4sLQL")
_END64 = struct.Struct("<4sQ2H2L4Q")
_RECORD = struct.Struct("<4s4B4H3L5H2L")
_LONGEST_COMMENT = 0xFFFF
_FULL16 = 0xFFFF
_FULL32 = 0xFFFFFFFF
_UTF8_NAME = 0x800
_BYTES_PER_RECORD = 512


class DirectoryError(Exception):
    """The file is no zip, or its directory cannot be trusted; the message is one problem sentence."""


@dataclass(frozen=True, slots=True)
class ZipEntry:
    """One record of the central directory; sizes and offsets in bytes."""

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
    """All records in the order of the directory, and the byte where it starts."""

    entries: tuple[ZipEntry, ...]
    offset: int


@dataclass(frozen=True, slots=True)
class _End:
    """What the end record says, zip64 already resolved; ``position`` is where the directory must end."""

    position: int
    count: int
    size: int
    offset: int


def read_directory(source: ByteSource, max_entries: int) -> Directory:
    """Parse the central directory, at most ``max_entries`` records.

    Raises ``DirectoryError`` for anything that is not one plain, whole, single-disk zip.
    """
    end = _find_end(source)
    if end.count > max_entries or end.size > max_entries * _BYTES_PER_RECORD:
        raise DirectoryError(
            f"the zip directory declares {end.count} entries in {end.size} bytes, "
            f"expected at most {max_entries} entries in {max_entries * _BYTES_PER_RECORD} bytes"
        )
    if end.offset + end.size != end.position:
        raise DirectoryError(
            f"the zip directory is declared at bytes {end.offset} to {end.offset + end.size}, "
            f"expected it to end at byte {end.position}: "
            "the file is truncated, damaged or has bytes before the archive"
        )
    data = bytes(source.read_at(end.offset, end.size))
    return Directory(_parse_records(data, end.count), end.offset)


def _find_end(source: ByteSource) -> _End:
    length = min(source.size, _END.size + _LONGEST_COMMENT)
    tail = bytes(source.read_at(source.size - length, length))
    at = tail.rfind(b"PK\x05\x06")
    while at >= 0:
        fits = at + _END.size <= len(tail)
        if fits and at + _END.size + int.from_bytes(tail[at + 20 : at + 22], "little") == len(tail):
            return _resolve_end(source, source.size - length + at, tail[at : at + _END.size])
        at = tail.rfind(b"PK\x05\x06", 0, at + 3)
    if bytes(source.read_at(0, min(4, source.size))) == b"PK\x03\x04":
        raise DirectoryError("the zip has no end record, expected one at the end: the file is truncated")
    raise DirectoryError("the file is not a zip: no zip end record was found, expected a zip archive")


def _resolve_end(source: ByteSource, position: int, record: bytes) -> _End:
    found: tuple[int, ...] = _END.unpack(record)[1:7]
    full = (_FULL16, _FULL16, _FULL16, _FULL16, _FULL32, _FULL32)
    wide = _find_end64(source, position)
    if wide is not None:
        position, fields = wide
        if any(a not in (b, limit) for a, b, limit in zip(found, fields, full, strict=True)):
            raise DirectoryError(f"the zip end record says {found}, expected the zip64 end record's {fields}")
        found = fields
    disk, start_disk, here, count, size, offset = found
    if disk or start_disk or here != count:
        raise DirectoryError(
            f"the zip is part of a multi-disk set (disk {disk}, {here} of {count} entries), "
            "expected one whole file"
        )
    return _End(position, count, size, offset)


def _find_end64(source: ByteSource, position: int) -> tuple[int, tuple[int, ...]] | None:
    locator_at = position - _END64_LOCATOR.size
    if locator_at < 0:
        return None
    magic, disk, at, disks = _END64_LOCATOR.unpack(source.read_at(locator_at, _END64_LOCATOR.size))
    if magic != b"PK\x06\x07":
        return None
    if disk or disks > 1:
        raise DirectoryError(f"the zip is part of a multi-disk set of {disks}, expected one whole file")
    if at + _END64.size > locator_at:
        raise DirectoryError(
            f"the zip64 end record is declared at byte {at}, expected it before byte {locator_at}"
        )
    magic, length, _, _, *fields = _END64.unpack(source.read_at(at, _END64.size))
    if magic != b"PK\x06\x06" or at + 12 + length != locator_at:
        raise DirectoryError(f"no whole zip64 end record was found at byte {at}, expected one")
    return at, tuple(fields)


def _parse_records(data: bytes, count: int) -> tuple[ZipEntry, ...]:
    entries: list[ZipEntry] = []
    at = 0
    while at < len(data) and len(entries) < count:
        entry, at = _parse_record(data, at, len(entries))
        entries.append(entry)
    if len(entries) != count or at != len(data):
        raise DirectoryError(
            f"the zip directory holds {len(entries)} entries in {at} bytes, "
            f"expected the declared {count} in {len(data)} bytes"
        )
    return tuple(entries)


def _parse_record(data: bytes, at: int, index: int) -> tuple[ZipEntry, int]:
    if at + _RECORD.size > len(data) or data[at : at + 4] != b"PK\x01\x02":
        raise DirectoryError(f"no zip directory record was found for entry {index}, expected one at +{at}")
    fields = _RECORD.unpack_from(data, at)
    flags, method = fields[5], fields[6]
    crc, compressed, size, name_length, extra_length, comment_length, disk = fields[9:16]
    attributes, offset = fields[17], fields[18]
    name_end = at + _RECORD.size + name_length
    extra_end = name_end + extra_length
    if extra_end + comment_length > len(data):
        raise DirectoryError(f"the zip directory record of entry {index} runs past the directory's end")
    raw_name = data[at + _RECORD.size : name_end]
    name = raw_name.decode("utf-8" if flags & _UTF8_NAME else "cp437", errors="backslashreplace")
    size, compressed, offset = _widen((size, compressed, offset), data[name_end:extra_end], index)
    entry = ZipEntry(name, raw_name, flags, method, crc, compressed, size, offset, attributes >> 16, disk)
    return entry, extra_end + comment_length


def _widen(values: tuple[int, int, int], extra: bytes, index: int) -> tuple[int, int, int]:
    """Replace every value that is full by its 64-bit one from the zip64 extra field."""
    if _FULL32 not in values:
        return values
    wide = _zip64_field(extra)
    needed = sum(value == _FULL32 for value in values)
    if len(wide) < 8 * needed:
        raise DirectoryError(f"the zip directory record of entry {index} lacks its zip64 sizes, expected {needed}")
    numbers = iter(struct.unpack_from(f"<{needed}Q", wide))
    size, compressed, offset = (next(numbers) if value == _FULL32 else value for value in values)
    return size, compressed, offset


def _zip64_field(extra: bytes) -> bytes:
    at = 0
    while at + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, at)
        if kind == 1:
            return extra[at + 4 : at + 4 + length]
        at += 4 + length
    return b""
