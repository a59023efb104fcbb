"""Zip archives: bounded parser of the central directory, checks of the entries, and reading of their data.

The limits on the size of the central directory are checked before it is read, and all entries are checked before
the data of any entry is read. Reading a checked entry bounds the inflated size and verifies length and checksum.

``zipfile`` is not used for reading: it allocates the sizes that the directory declares, cuts names at NUL and
accepts archives whose entries overlap. All later checks use the records of this parser.

Backslashes in names separate folders only if the record says that MS-DOS made the entry, as Compress-Archive of
Windows PowerShell 5.1 does (.NET Framework before 4.6.1); elsewhere they are a letter, and refused.
"""

from __future__ import annotations

import re
import stat
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from zlib_ng import zlib_ng

from rebar_depth_bench.base.errors import EntryError, Problem, ProblemCode, escape_text
from rebar_depth_bench.base.reading import LFS_POINTER, ByteSource, is_lfs_pointer

_END_RECORD = struct.Struct("<4s4H2LH")
_ZIP64_END_LOCATOR = struct.Struct("<4sLQL")
_ZIP64_END_RECORD = struct.Struct("<4sQ2H2L4Q")
_DIRECTORY_RECORD = struct.Struct("<4s4B4H3L5H2L")
_MAX_COMMENT_BYTES = 0xFFFF
_FULL16 = 0xFFFF
_FULL32 = 0xFFFFFFFF
_FULL_FIELDS = (_FULL16, _FULL16, _FULL16, _FULL16, _FULL32, _FULL32)
_ZIP64_FIELD = 1
_UTF8_NAME = 0x800
_MSDOS_HOST = 0
_MAX_BYTES_PER_RECORD = 512
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
class ZipEntry:
    """Entry of an archive, from its record in the central directory; sizes and offsets are in bytes.

    ``data_offset`` is where its data starts (0 if unknown). The data of an entry with ``problems`` is not read.
    """

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
    data_offset: int = 0
    problems: tuple[Problem, ...] = ()

    def problem(self, code: ProblemCode, found: str, expected: str = "") -> Problem:
        """Return a problem of the entry, whose name is escaped."""
        return Problem(code, escape_text(self.name), found, expected)


def read_entries(source: ByteSource, max_entries: int, limit: SizeLimit) -> list[ZipEntry]:
    """Return the entries of an archive, in the order of its directory, each with its problems.

    Raises ``EntryError`` if the source is not one complete single-disk zip without leading or trailing bytes, or
    has more than ``max_entries``; ``where`` of its problem is empty.
    """
    end, count, size, start = _read_end_record(source)
    if count > max_entries or size > max_entries * _MAX_BYTES_PER_RECORD:
        found = f"the zip directory declares {count} entries in {size} bytes"
        expected = f"at most {max_entries} entries in {max_entries * _MAX_BYTES_PER_RECORD} bytes"
        raise EntryError(Problem("size", "", found, expected))
    if start + size != end:
        found = f"the zip directory is declared at bytes {start} to {start + size}"
        reason = "the file is truncated, damaged or has bytes before the archive"
        raise EntryError(Problem("damaged", "", found, f"it to end at byte {end}: {reason}"))
    records = bytes(source.read_at(start, size))
    entries: list[ZipEntry] = []
    offset = 0
    while offset < size and len(entries) < count:
        entry, offset = _parse_record(records, offset, len(entries))
        entries.append(entry)
    if len(entries) != count or offset != size:
        found = f"the zip directory holds {len(entries)} entries in {offset} bytes"
        raise EntryError(Problem("damaged", "", found, f"the declared {count} in {size} bytes"))
    for index, entry in enumerate(entries):
        data_offset, problems = _check_local_header(source, entry, start)
        problems = [*_record_problems(entry, limit), *problems]
        entries[index] = replace(entry, data_offset=data_offset, problems=tuple(problems))
    for index, problem in _overlap_problems(entries):
        entries[index] = replace(entries[index], problems=(*entries[index].problems, problem))
    return entries


def _read_end_record(source: ByteSource) -> tuple[int, int, int, int]:
    """Return where the central directory must end, and what is declared: its entries, its size and its start."""
    length = min(source.size, _ZIP64_END_LOCATOR.size + _END_RECORD.size + _MAX_COMMENT_BYTES)
    tail = bytes(source.read_at(source.size - length, length))
    offset, extra = tail.rfind(b"PK\x05\x06"), 0
    while offset >= 0:
        record = tail[offset : offset + _END_RECORD.size].ljust(_END_RECORD.size, b"\0")
        size, start, comment_bytes = _END_RECORD.unpack(record)[5:]
        rest = len(tail) - offset - _END_RECORD.size - comment_bytes
        if rest == 0:
            break
        if rest > 0 and start + size == source.size - length + offset:  # Not of an archive that is an entry.
            extra = rest
        offset = tail.rfind(b"PK\x05\x06", 0, offset + 3)
    else:
        if extra:
            found = f"{extra} {'byte follows' if extra == 1 else 'bytes follow'} the end of the archive"
            raise EntryError(Problem("damaged", "", found, f"the file to end at byte {source.size - extra}"))
        if bytes(source.read_at(0, min(4, source.size))) == b"PK\x03\x04":
            found = "the zip has no end record"
            raise EntryError(Problem("damaged", "", found, "one at the end: the file is truncated"))
        found = f"the file is not a zip: no zip end record was found in its {source.size} bytes"
        raise EntryError(Problem("syntax", "", found, "a zip archive"))
    position = source.size - length + offset
    fields: tuple[int, ...] = _END_RECORD.unpack_from(tail, offset)[1:7]
    locator = tail[max(0, offset - _ZIP64_END_LOCATOR.size) : offset]
    if len(locator) == _ZIP64_END_LOCATOR.size and locator.startswith(b"PK\x06\x07"):
        position, expected = _read_zip64_end_record(source, position, locator)
        if any(a not in (b, limit) for a, b, limit in zip(fields, expected, _FULL_FIELDS, strict=True)):
            found = f"the zip end record declares {fields}"
            raise EntryError(Problem("damaged", "", found, f"the zip64 end record's {expected}"))
        fields = expected
    disk, start_disk, here, count, size, start = fields
    if disk or start_disk or here != count:
        found = f"the zip is part of a multi-disk set (disk {disk}, {here} of {count} entries)"
        raise EntryError(Problem("kind", "", found, "a single complete file"))
    return position, count, size, start


def _read_zip64_end_record(source: ByteSource, position: int, locator: bytes) -> tuple[int, tuple[int, ...]]:
    """Return where the zip64 end record starts, and its fields; ``locator``, before ``position``, points to it."""
    _, disk, record_offset, disks = _ZIP64_END_LOCATOR.unpack(locator)
    if disk or disks > 1:
        found = f"the zip is part of a multi-disk set of {disks}"
        raise EntryError(Problem("kind", "", found, "a single complete file"))
    locator_offset = position - _ZIP64_END_LOCATOR.size
    if record_offset + _ZIP64_END_RECORD.size > locator_offset:
        found = f"the zip64 end record is declared at byte {record_offset}"
        raise EntryError(Problem("damaged", "", found, f"it before byte {locator_offset}"))
    magic, length, _, _, *fields = _ZIP64_END_RECORD.unpack(source.read_at(record_offset, _ZIP64_END_RECORD.size))
    if magic != b"PK\x06\x06" or record_offset + 12 + length != locator_offset:
        found = f"no complete zip64 end record was found at byte {record_offset}"
        raise EntryError(Problem("damaged", "", found, "one"))
    return record_offset, tuple(fields)


def _parse_record(data: bytes, start: int, index: int) -> tuple[ZipEntry, int]:
    if start + _DIRECTORY_RECORD.size > len(data) or data[start : start + 4] != b"PK\x01\x02":
        found = f"no zip directory record was found for entry {index}"
        raise EntryError(Problem("damaged", "", found, f"one at +{start}"))
    fields = _DIRECTORY_RECORD.unpack_from(data, start)
    host, flags, method = fields[2], fields[5], fields[6]
    crc, compressed, size, name_length, extra_length, comment_length, disk = fields[9:16]
    attributes, offset = fields[17], fields[18]
    name_end = start + _DIRECTORY_RECORD.size + name_length
    extra_end = name_end + extra_length
    if extra_end + comment_length > len(data):
        found = f"the zip directory record of entry {index} extends past the directory's end"
        raise EntryError(Problem("damaged", "", found))
    raw_name = data[start + _DIRECTORY_RECORD.size : name_end]
    # In both encodings of names, the byte of a backslash is no part of another character.
    plain_name = raw_name.replace(b"\\", b"/") if host == _MSDOS_HOST else raw_name
    name = plain_name.decode("utf-8" if flags & _UTF8_NAME else "cp437", errors="backslashreplace")
    if _FULL32 in (size, compressed, offset):
        extra = data[name_end:extra_end]
        size, compressed, offset = _zip64_sizes((size, compressed, offset), extra, index)
    entry = ZipEntry(name, raw_name, flags, method, crc, compressed, size, offset, attributes >> 16, disk)
    return entry, extra_end + comment_length


def _zip64_sizes(values: tuple[int, int, int], extra: bytes, index: int) -> tuple[int, int, int]:
    """Replace each saturated 32-bit value by its 64-bit value from the zip64 extra field."""
    needed = sum(value == _FULL32 for value in values)
    start, zip64_values = 0, b""
    while start + 4 <= len(extra) and not zip64_values:
        kind, length = struct.unpack_from("<2H", extra, start)
        start += 4 + length
        zip64_values = extra[start - length : start] if kind == _ZIP64_FIELD else b""
    if len(zip64_values) < 8 * needed:
        found = f"the zip directory record of entry {index} lacks its zip64 sizes"
        raise EntryError(Problem("damaged", "", found, f"{needed}"))
    replacements = iter(struct.unpack_from(f"<{needed}Q", zip64_values))
    size, compressed, offset = (next(replacements) if value == _FULL32 else value for value in values)
    return size, compressed, offset


def _record_problems(entry: ZipEntry, limit: SizeLimit) -> Iterator[Problem]:
    """Yield the problems of an entry's name, type and declared sizes."""
    plain = entry.name.removeprefix("./")  # It is dropped before names are compared.
    if any(ord(character) < 32 or ord(character) == 127 for character in entry.name):
        yield entry.problem("name", "the name has a control character", "plain text")
    elif (
        plain.startswith("/")
        or "\\" in entry.name
        or re.match(r"[A-Za-z]:", plain)
        or ".." in entry.name.split("/")
    ):
        expected = "a relative path without '..', '\\' or a drive"
        yield entry.problem("name", "the name escapes the archive", expected)
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


def _overlap_problems(entries: Sequence[ZipEntry]) -> Iterator[tuple[int, Problem]]:
    """Yield index and problem of every entry whose byte range, header included, overlaps another entry's range."""
    located = sorted(
        (entry.header_offset, entry.data_offset + entry.compressed_size, index)
        for index, entry in enumerate(entries)
        if entry.data_offset
    )
    widest, widest_end = "", 0
    for start, end, index in located:
        if start < widest_end:
            found = f"the data from byte {start} overlaps that of {escape_text(widest)}"
            yield index, entries[index].problem("damaged", found, "separate data")
        if end > widest_end:
            widest, widest_end = entries[index].name, end


def read_data(source: ByteSource, entry: ZipEntry) -> memoryview:
    """Return the uncompressed bytes of an entry.

    Call it only for entries without problems, since their checked declared size bounds the memory use. Raises
    ``EntryError`` if the data is corrupt or the file was truncated.
    """
    try:
        data = source.read_at(entry.data_offset, entry.compressed_size)
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
    if is_lfs_pointer(data):
        raise EntryError(entry.problem("kind", LFS_POINTER))
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
