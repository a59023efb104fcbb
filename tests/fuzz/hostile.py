"""Hostile texts, numbers and image sizes, and damaged zip archives and Parquet tables that stay readable."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

Texts = tuple[bytes, ...]

NUMBERS: Texts = (
    b"nan", b"inf", b"-inf", b"NaN", b"-Infinity", b"1e999", b"-1", b"0", b"-0.0", b"1e-320", b"0x7f",
    b"4294967296", b"9223372036854775808", b"1e300", b"9" * 4400, b"1.5", b"1e", b"--1", b"1_0",
    "\N{ARABIC-INDIC DIGIT SEVEN}".encode(),
)  # fmt: skip
"""Texts in place of a number."""

PATHS: Texts = (
    b"..", b"../victim", b"../../victim/notes.txt", b"../../../victim", b"/../../../victim", b"/dev/zero",
    b"//victim", b"/tmp/rebar-fuzz-victim", b"~/victim", b"a/../../../victim", b"C:\\victim", b"file:///dev/zero",
    b".", b"", b"-rf", b"a\0b", b"hf://datasets/a/b",
)  # fmt: skip
"""Texts in place of a name or path."""

TEXTS: Texts = (
    b"\x1b[2J\x1b[31mred", b"\x1b]0;title\x07", b"\r\rdone", b"\x00", b"\x7f\x9b1m", b"\xff\xfe", b"\xed\xa0\x80",
    "\u202etxt.exe".encode(), "\u2028".encode(), "𝔸".encode(), b"%s%n", b"{0.__class__}", b"[red]a[/red]", b" ",
    b"<script>alert(1)</script>", b"=1+1", b"a" * 100_000, b"a." * 5_000 + b"a",
)  # fmt: skip
"""Texts in place of any text."""

SPAM: Texts = (
    b"[" * 50_000, b"{" * 50_000, b'{"a":' * 50_000, b"(" * 50_000, b"a." * 30_000, b"/* " * 20_000,
    b"0 " * 100_000, b"\n" * 100_000, b"#" * 100_000, b'"' * 9_999, b"'''", b"\xef\xbb\xbf", b"\r",
)  # fmt: skip
"""Texts to insert anywhere."""

LITERALS: Texts = (
    b"null", b"true", b"[]", b"{}", b'""', b"0", b"-1", b"1.5", b"1e308", b"NaN", b"1e999", b"1" * 4400,
    b"[[[[]]]]", b"[" * 60 + b"]" * 60, b"[" * 3_000 + b"]" * 3_000, b'{"a":' * 90 + b"0" + b"}" * 90,
    b"[" + b"0, " * 50_000 + b"0]", b"[1, 2, 3]", b'["a"]', b'{"a": 1}', b'"\\ud800"', b'"\\u001b[2J"',
    b'"\\u202e"', b"9223372036854775808", b'"' + b"a" * 100_000 + b'"', b'"../../victim"', b'"/dev/zero"',
)  # fmt: skip
"""JSON texts in place of a value; most of them are valid."""


def declare_image_size(content: bytes, width: int, height: int) -> bytes:
    """Return an encoded PNG, WebP (lossless) or TIFF image whose header declares another size.

    Content of any other kind is returned unchanged. Raises ``ValueError`` if the header is incomplete.
    """
    try:
        return _with_declared_size(content, width, height)
    except struct.error as error:
        raise ValueError("incomplete header") from error


def _with_declared_size(content: bytes, width: int, height: int) -> bytes:
    if content.startswith(b"\x89PNG"):
        chunk = b"IHDR" + struct.pack(">2I", width, height) + content[24:29]
        return content[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + content[33:]
    if content[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        bits = bits & ~0xFFFFFFF | (width - 1) & 0x3FFF | ((height - 1) & 0x3FFF) << 14
        return content[:21] + struct.pack("<I", bits) + content[25:]
    return _declare_tiff_size(content, width, height) if content.startswith(b"II*\0") else content


def _declare_tiff_size(content: bytes, width: int, height: int) -> bytes:
    data = bytearray(content)
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        (tag,) = struct.unpack_from("<H", data, entry)
        if tag in (256, 257, 278):  # Width, height, rows of a strip.
            struct.pack_into("<2HI2H", data, entry, tag, 3, 1, width if tag == 256 else height, 0)
    return bytes(data)


def other_image_size(rng: np.random.Generator) -> tuple[int, int]:
    """Return a random width and height, from empty to very large."""
    sides = (0, 1, 90, 159, 161, 12_000, 16_384, 65_500)
    width, height = rng.choice(sides, size=2)
    return int(width), int(height)


_EXTREMES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, 1e-308, 0.3)


def damage_zip(
    content: bytes,
    rng: np.random.Generator,
    damage_entry: Callable[[str, bytes, np.random.Generator], tuple[bytes, str]],
) -> bytes:
    """Damage, rename, repeat, delete or link one entry of a zip archive. Raises ``ValueError`` if it is none."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    except (zipfile.BadZipFile, zlib.error, struct.error, OSError, NotImplementedError) as error:
        raise ValueError("no zip archive") from error
    if not entries:
        raise ValueError("no entries")
    at, kind, mode = int(rng.integers(len(entries))), rng.integers(6), 0o100644
    name, data = entries.pop(at)
    if kind == 1:
        paths = (*PATHS, *TEXTS[:10], b"__MACOSX/._a", b"lattice/.DS_Store")
        name = paths[rng.integers(len(paths))].decode("latin-1") + str(rng.choice(("", ".npy", ".png")))
    elif kind == 2:
        entries.insert(at, (name, data))
    elif kind == 3:
        mode = 0o120777
    elif kind != 4:
        data, _ = damage_entry(name, data, rng)
    if kind != 4:
        entries.insert(at, (name, data))
    compression = int(rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    if host := int(rng.choice((0, 3))):
        return _zip(entries, name, mode, compression, host)
    entries = [(other.replace("/", "\\"), data) for other, data in entries]
    return _zip(entries, name.replace("/", "\\"), mode, compression, host)


def _zip(entries: list[tuple[str, bytes]], linked: str, mode: int, compression: int, host: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, data in entries:
            entry = zipfile.ZipInfo(name or "-")
            entry.compress_type, entry.create_system = compression, host
            entry.external_attr = (mode if name == linked else 0o100644) << 16
            archive.writestr(entry, data)
    return out.getvalue()


def damage_parquet(
    content: bytes, rng: np.random.Generator, damage_bytes: Callable[[bytes, np.random.Generator], bytes]
) -> bytes:
    """Damage one cell, row or column of a Parquet table. Raises ``ValueError`` if it is none."""
    try:
        table = pq.read_table(io.BytesIO(content))
    except (OSError, pa.ArrowException) as error:
        raise ValueError("no Parquet table") from error
    names, rows = table.column_names, table.to_pylist()
    if not rows:
        raise ValueError("no rows")
    column, at, kind = names[rng.integers(len(names))], int(rng.integers(len(rows))), rng.integers(12)
    if kind == 0:
        return _parquet(table.drop_columns([column]))
    if kind == 1:
        return _parquet(table.rename_columns([f"{name}x" if name == column else name for name in names]))
    if kind == 2:
        return _parquet(pa.concat_tables([table, table.slice(at, 1)]))
    if kind == 3:
        return _parquet(pa.concat_tables([table.slice(0, at), table.slice(at + 1)]))
    if kind == 4:
        texts = pa.array([str(value)[:50] for value in table.column(column).to_pylist()])
        return _parquet(table.set_column(names.index(column), column, texts))
    cells = [row[column] for row in rows]
    cells[at] = cells[int(rng.integers(len(rows)))] if kind == 5 else _other_cell(cells[at], rng, damage_bytes)
    field = table.schema.field(column)
    try:
        array = pa.array(cells, field.type)
    except (pa.ArrowException, TypeError, OverflowError):  # The cell has another type or length now.
        array, field = pa.array([None if cell is None else str(cell) for cell in cells]), column
    return _parquet(table.set_column(names.index(column), field, array))


def _parquet(table: pa.Table) -> bytes:
    out = io.BytesIO()
    pq.write_table(table, out, row_group_size=1)
    return out.getvalue()


def _other_cell(
    cell: Any, rng: np.random.Generator, damage_bytes: Callable[[bytes, np.random.Generator], bytes]
) -> Any:
    if rng.random() < 0.1:
        return None
    if isinstance(cell, dict):  # An image: its bytes, and a path that nothing should open.
        if rng.random() < 0.2:
            return {**cell, "bytes": None, "path": PATHS[rng.integers(len(PATHS))].decode()}
        return {**cell, "bytes": _other_cell(cell["bytes"], rng, damage_bytes)}
    if isinstance(cell, bytes):
        return damage_image_size(cell, rng) if rng.random() < 0.4 else damage_bytes(cell, rng)
    if isinstance(cell, list):
        if rng.random() < 0.2:
            return cell[:-1]
        at = int(rng.integers(len(cell)))
        return [*cell[:at], _other_cell(cell[at], rng, damage_bytes), *cell[at + 1 :]]
    if isinstance(cell, str):
        texts = (*PATHS, *TEXTS)
        return texts[rng.integers(len(texts))].decode("latin-1")
    return float(rng.choice(_EXTREMES)) if isinstance(cell, float) else int(rng.integers(-5, 1 << 31))


def damage_image_size(content: bytes, rng: np.random.Generator) -> bytes:
    """Declare another size in the header of an image."""
    return declare_image_size(content, *other_image_size(rng))
