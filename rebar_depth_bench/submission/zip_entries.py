"""Structural checks of a zip's entries, made before the data of any entry is read.

The data of one checked entry: bounded inflation, exact length, verified checksum.
"""

from __future__ import annotations

import re
import stat
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from zlib_ng import zlib_ng

from rebar_depth_bench.errors import EntryError, show
from rebar_depth_bench.submission.zip_directory import ByteSource, Directory, ZipEntry

STORED = 0
DEFLATED = 8
_LOCAL = struct.Struct("<4s5H3L2H")
_ENCRYPTED = 0x0001 | 0x0040 | 0x2000
_SIZES_FOLLOW = 0x0008
_PATCH = 0x0020
_FULL32 = 0xFFFFFFFF
_KINDS = {
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFDIR: "a directory",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}

SizeLimit = Callable[[str], int | None]
"""The largest uncompressed size in bytes that an entry of this name needs; None if its size is no matter."""


@dataclass(frozen=True, slots=True)
class CheckedEntry:
    """An entry with everything wrong about it, and the byte where its data starts (0 if unknown)."""

    entry: ZipEntry
    data_offset: int
    problems: tuple[str, ...]

    @property
    def span(self) -> tuple[int, int]:
        """The bytes that the entry takes in the file, from its local header to the end of its data."""
        return self.entry.header_offset, self.data_offset + self.entry.compressed_size


def has_bad_name(entry: ZipEntry) -> bool:
    """Tell whether the name escapes the archive or has control characters."""
    return bool(_name_problems(entry))


def check_entries(source: ByteSource, directory: Directory, limit: SizeLimit) -> tuple[CheckedEntry, ...]:
    """Check every entry of the directory, in its order."""
    checked = tuple(_check_entry(source, entry, directory.offset, limit) for entry in directory.entries)
    overlaps = _overlaps(checked)
    return tuple(
        CheckedEntry(item.entry, item.data_offset, item.problems + overlaps.get(index, ()))
        for index, item in enumerate(checked)
    )


def _check_entry(source: ByteSource, entry: ZipEntry, directory_offset: int, limit: SizeLimit) -> CheckedEntry:
    data_offset, local_problems = _check_local(source, entry, directory_offset)
    found = [*_name_problems(entry), *_kind_problems(entry), *_size_problems(entry, limit), *local_problems]
    return CheckedEntry(entry, data_offset, tuple(f"{show(entry.name)}: {problem}" for problem in found))


def _name_problems(entry: ZipEntry) -> list[str]:
    name = entry.name
    if any(ord(character) < 32 or ord(character) == 127 for character in name):
        return ["the name has a control character, expected plain text"]
    escapes = name.startswith("/") or "\\" in name or re.match(r"[A-Za-z]:", name) or ".." in name.split("/")
    return (
        ["the name escapes the archive, expected a relative path without '..', '\\' or a drive"] if escapes else []
    )


def _kind_problems(entry: ZipEntry) -> list[str]:
    found = []
    kind = stat.S_IFMT(entry.unix_mode)
    if kind not in (0, stat.S_IFREG) and not (kind == stat.S_IFDIR and entry.name.endswith("/")):
        found.append(f"the entry is {_KINDS.get(kind, f'of file type {kind:#o}')}, expected a regular file")
    if entry.flags & _ENCRYPTED:
        found.append("the entry is encrypted, expected plain data")
    if entry.flags & _PATCH:
        found.append("the entry is patch data, expected plain data")
    if entry.method not in (STORED, DEFLATED):
        found.append(
            f"the compression method is {entry.method}, expected {STORED} (stored) or {DEFLATED} (deflated)"
        )
    if entry.disk:
        found.append(f"the entry is on disk {entry.disk} of a multi-disk set, expected one whole file")
    return found


def _size_problems(entry: ZipEntry, limit: SizeLimit) -> list[str]:
    found = []
    allowed = 0 if entry.name.endswith("/") else limit(entry.name)
    if allowed is not None and entry.size > allowed:
        found.append(f"the declared size is {entry.size} bytes, expected at most {allowed}")
    if entry.method == STORED and entry.compressed_size != entry.size:
        found.append(f"{entry.compressed_size} bytes are stored, expected the declared {entry.size}")
    # Deflate grows data by 5 bytes per block of 16 KiB at worst; more only wastes the reader's time.
    most = entry.size + entry.size // 1024 + 1024
    if entry.method == DEFLATED and entry.compressed_size > most:
        found.append(f"{entry.compressed_size} bytes are deflated for {entry.size}, expected at most {most}")
    return found


def _check_local(source: ByteSource, entry: ZipEntry, directory_offset: int) -> tuple[int, list[str]]:
    """Compare the entry with its local header; return where its data starts, and what is wrong."""
    start = entry.header_offset
    if start + _LOCAL.size > directory_offset:
        return 0, [f"the data is declared at byte {start}, expected it before the directory at {directory_offset}"]
    magic, _, flags, method, _, _, crc, compressed, size, name_length, extra_length = _LOCAL.unpack(
        source.read_at(start, _LOCAL.size)
    )
    if magic != b"PK\x03\x04":
        return 0, [f"no local header was found at byte {start}, expected one"]
    data_offset = start + _LOCAL.size + name_length + extra_length
    end = data_offset + entry.compressed_size
    if end > directory_offset:
        return 0, [f"the data ends at byte {end}, expected it before the directory at {directory_offset}"]
    raw_name = bytes(source.read_at(start + _LOCAL.size, name_length))
    pairs: list[tuple[str, object, object]] = [
        ("name", raw_name, entry.raw_name),
        ("compression method", method, entry.method),
        ("encryption", bool(flags & _ENCRYPTED), bool(entry.flags & _ENCRYPTED)),
    ]
    # Sizes that follow the data, or stand in a zip64 field, are not in the header to be compared.
    if not (flags | entry.flags) & _SIZES_FOLLOW:
        pairs.append(("checksum", crc, entry.crc))
        pairs += [("size", size, entry.size)] if size != _FULL32 else []
        pairs += [("compressed size", compressed, entry.compressed_size)] if compressed != _FULL32 else []
    return data_offset, [
        f"the {what} in the local header is {show(str(local))}, expected the directory's {show(str(central))}"
        for what, local, central in pairs
        if local != central
    ]


def _overlaps(checked: Sequence[CheckedEntry]) -> dict[int, tuple[str, ...]]:
    """Return the problem of every entry whose bytes are also another entry's."""
    located = [index for index, item in enumerate(checked) if item.data_offset]
    located.sort(key=lambda index: (checked[index].span, index))
    found: dict[int, tuple[str, ...]] = {}
    widest = -1
    for index in located:
        start, end = checked[index].span
        if widest >= 0 and start < checked[widest].span[1]:
            name, other = show(checked[index].entry.name), show(checked[widest].entry.name)
            problem = f"{name}: the data from byte {start} overlaps that of {other}, expected separate data"
            found[index] = (problem,)
        if widest < 0 or end > checked[widest].span[1]:
            widest = index
    return found


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
