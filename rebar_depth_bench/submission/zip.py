"""Zip archives: bounded parser of the central directory, checks of the entries, and reading of their data.

The limits on the size of the central directory are checked before it is read, and all entries are checked before
the data of any entry is read. Reading a checked entry bounds the inflated size and verifies length and checksum.

``zipfile`` is not used for reading: it allocates the sizes that the directory declares, cuts names at NUL and
accepts archives whose entries overlap. All later checks use the records of this parser.
"""

from __future__ import annotations

import re
import stat
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from zlib_ng import zlib_ng

from rebar_depth_bench.errors import EntryError, Problem, ProblemCode, escape_text
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

    def problem(self, code: ProblemCode, found: str, expected: str = "") -> Problem:
        """Return a problem of the entry, whose name is escaped."""
        return Problem(code, escape_text(self.name), found, expected)


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


STORED = 0
DEFLATED = 8
_LOCAL_HEADER = struct.Struct("<4s5H3L2H")
_ENCRYPTED = 0x0001 | 0x0040 | 0x2000
_HAS_DATA_DESCRIPTOR = 0x0008
_PATCH_DATA = 0x0020
_FILE_TYPES = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFDIR: "a directory",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}

SizeLimit = Callable[[str], int | None]
"""Function from an entry name to its largest acceptable uncompressed size in bytes; None for no limit."""


@dataclass(frozen=True, slots=True)
class CheckedEntry:
    """Entry with its problems; ``data_offset`` is the byte where its data starts (0 if unknown)."""

    entry: ZipEntry
    data_offset: int
    problems: tuple[Problem, ...]

    @property
    def span(self) -> tuple[int, int]:
        """Byte range (start, end) of the entry in the file, from its local header to the end of its data."""
        return self.entry.header_offset, self.data_offset + self.entry.compressed_size


def has_unsafe_name(entry: ZipEntry) -> bool:
    """Return whether the name escapes the archive or has control characters."""
    return _name_problem(entry) is not None


def check_entries(source: ByteSource, directory: Directory, limit: SizeLimit) -> tuple[CheckedEntry, ...]:
    """Return every entry of the directory, in its order, with its structural problems."""
    checked = tuple(_check_entry(source, entry, directory.offset, limit) for entry in directory.entries)
    overlaps = _overlap_problems(checked)
    return tuple(
        CheckedEntry(check.entry, check.data_offset, check.problems + overlaps.get(index, ()))
        for index, check in enumerate(checked)
    )


def _check_entry(source: ByteSource, entry: ZipEntry, directory_offset: int, limit: SizeLimit) -> CheckedEntry:
    data_offset, local_problems = _check_local_header(source, entry, directory_offset)
    name_problem = _name_problem(entry)
    problems = [name_problem] if name_problem else []
    problems += [*_type_problems(entry), *_size_problems(entry, limit), *local_problems]
    return CheckedEntry(entry, data_offset, tuple(problems))


def _name_problem(entry: ZipEntry) -> Problem | None:
    name = entry.name
    if any(ord(character) < 32 or ord(character) == 127 for character in name):
        return entry.problem("name", "the name has a control character", "plain text")
    plain = name.removeprefix("./")  # It is dropped before names are compared.
    if plain.startswith("/") or "\\" in name or re.match(r"[A-Za-z]:", plain) or ".." in name.split("/"):
        expected = "a relative path without '..', '\\' or a drive"
        return entry.problem("name", "the name escapes the archive", expected)
    return None


def _type_problems(entry: ZipEntry) -> Iterator[Problem]:
    kind = stat.S_IFMT(entry.unix_mode)
    if kind not in (0, stat.S_IFREG) and not (kind == stat.S_IFDIR and entry.name.endswith("/")):
        file_type = _FILE_TYPES.get(kind, f"of file type {kind:#o}")
        yield entry.problem("kind", f"the entry is {file_type}", "a regular file")
    if entry.flags & _ENCRYPTED:
        yield entry.problem("kind", "the entry is encrypted", "plain data")
    if entry.flags & _PATCH_DATA:
        yield entry.problem("kind", "the entry is patch data", "plain data")
    if entry.method not in (STORED, DEFLATED):
        expected = f"{STORED} (stored) or {DEFLATED} (deflated)"
        yield entry.problem("kind", f"the compression method is {entry.method}", expected)
    if entry.disk:
        found = f"the entry is on disk {entry.disk} of a multi-disk set"
        yield entry.problem("kind", found, "a single complete file")


def _size_problems(entry: ZipEntry, limit: SizeLimit) -> Iterator[Problem]:
    allowed = 0 if entry.name.endswith("/") else limit(entry.name)
    if allowed is not None and entry.size > allowed:
        yield entry.problem("size", f"the declared size is {entry.size} bytes", f"at most {allowed}")
    if entry.method == STORED and entry.compressed_size != entry.size:
        yield entry.problem("size", f"{entry.compressed_size} bytes are stored", f"the declared {entry.size}")
    # Deflate enlarges incompressible data by at most 5 bytes per block of 16 KiB.
    max_compressed = entry.size + entry.size // 1024 + 1024
    if entry.method == DEFLATED and entry.compressed_size > max_compressed:
        found = f"{entry.compressed_size} bytes are deflated for {entry.size}"
        yield entry.problem("size", found, f"at most {max_compressed}")


def _check_local_header(source: ByteSource, entry: ZipEntry, directory_offset: int) -> tuple[int, list[Problem]]:
    """Compare the entry with its local header; return its data's byte offset (0 if unknown) and the problems."""
    start = entry.header_offset
    before_directory = f"it before the directory at {directory_offset}"
    if start + _LOCAL_HEADER.size > directory_offset:
        return 0, [entry.problem("damaged", f"the data is declared at byte {start}", before_directory)]
    magic, _, flags, method, _, _, crc, compressed, size, name_length, extra_length = _LOCAL_HEADER.unpack(
        source.read_at(start, _LOCAL_HEADER.size)
    )
    if magic != b"PK\x03\x04":
        return 0, [entry.problem("damaged", f"no local header was found at byte {start}", "one")]
    data_offset = start + _LOCAL_HEADER.size + name_length + extra_length
    end = data_offset + entry.compressed_size
    if end > directory_offset:
        return 0, [entry.problem("damaged", f"the data ends at byte {end}", before_directory)]
    raw_name = bytes(source.read_at(start + _LOCAL_HEADER.size, name_length))
    comparisons: list[tuple[str, object, object]] = [
        ("name", raw_name, entry.raw_name),
        ("compression method", method, entry.method),
        ("encryption", bool(flags & _ENCRYPTED), bool(entry.flags & _ENCRYPTED)),
    ]
    # The local header lacks sizes that follow the data in a data descriptor or are in a zip64 extra field.
    if not (flags | entry.flags) & _HAS_DATA_DESCRIPTOR:
        comparisons.append(("checksum", crc, entry.crc))
        comparisons += [("size", size, entry.size)] if size != _FULL32 else []
        comparisons += [("compressed size", compressed, entry.compressed_size)] if compressed != _FULL32 else []
    return data_offset, [
        entry.problem(
            "damaged",
            f"the {field} in the local header is {escape_text(str(local))}",
            f"the directory's {escape_text(str(central))}",
        )
        for field, local, central in comparisons
        if local != central
    ]


def _overlap_problems(checked: Sequence[CheckedEntry]) -> dict[int, tuple[Problem, ...]]:
    """Return, by entry index, the problem of every entry whose byte range overlaps that of another entry."""
    located = [index for index, check in enumerate(checked) if check.data_offset]
    located.sort(key=lambda index: (checked[index].span, index))
    problems: dict[int, tuple[Problem, ...]] = {}
    widest = -1
    for index in located:
        start, end = checked[index].span
        if widest >= 0 and start < checked[widest].span[1]:
            found = f"the data from byte {start} overlaps that of {escape_text(checked[widest].entry.name)}"
            problems[index] = (checked[index].entry.problem("damaged", found, "separate data"),)
        if widest < 0 or end > checked[widest].span[1]:
            widest = index
    return problems


def read_data(source: ByteSource, checked: CheckedEntry) -> memoryview:
    """Return the entry's uncompressed bytes; for a stored entry a view on the source, not a copy.

    Call it only for entries without problems, since their checked declared size bounds the memory use. Raises
    ``EntryError`` if the data is corrupt or the file was truncated.
    """
    entry = checked.entry
    try:
        data = source.read_at(checked.data_offset, entry.compressed_size)
    except EOFError as error:
        found = f"the archive was truncated while it was read: {error}"
        raise EntryError(entry.problem("damaged", found)) from error
    if entry.method == DEFLATED:
        data = _inflate(entry, data)
    # zlib-ng's CRC-32 is six times as fast as zlib's, whose time exceeds the rest of reading a view.
    crc = zlib_ng.crc32(data)
    if crc != entry.crc:
        found = f"the data is corrupt: its checksum is {crc:08x}"
        raise EntryError(entry.problem("damaged", found, f"{entry.crc:08x}"))
    return data


def _inflate(entry: ZipEntry, data: memoryview) -> memoryview:
    size, inflater = entry.size, zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        # One byte more than declared suffices to detect a stream that is too long.
        inflated = inflater.decompress(data, size + 1)
    except zlib.error as error:
        found = f"the deflated data is corrupt ({error})"
        raise EntryError(entry.problem("damaged", found, f"{size} bytes")) from error
    if len(inflated) > size:
        found = f"the data inflates to more than {size} bytes"
        raise EntryError(entry.problem("size", found, f"the declared {size}"))
    if not inflater.eof or len(inflated) != size:
        found = f"the data inflates to {len(inflated)} bytes and stops"
        raise EntryError(entry.problem("size", found, f"{size}"))
    if inflater.unused_data:
        found = f"{len(inflater.unused_data)} bytes follow the deflated data"
        raise EntryError(entry.problem("damaged", found, "none"))
    return memoryview(inflated)
