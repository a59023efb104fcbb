"""Hostile values of text, numbers, structured data and images, for the generators in ``damage``."""

from __future__ import annotations

import struct
import zlib

import numpy as np

Texts = tuple[bytes, ...]

NUMBERS: Texts = (
    b"nan", b"inf", b"-inf", b"NaN", b"-Infinity", b"1e999", b"-1", b"0", b"-0.0", b"1e-320", b"0x7f",
    b"4294967296", b"9223372036854775808", b"1e300", b"9" * 4400, b"1.5", b"1e", b"--1", b"1_0",
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
