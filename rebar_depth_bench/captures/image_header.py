"""Size of a PNG or JPEG image, read from its header.

No image library takes part: nothing is decoded or inflated, whatever the file declares.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from rebar_depth_bench.errors import EntryError, Problem, format_shape
from rebar_depth_bench.limits import IMAGE_PIXELS
from rebar_depth_bench.reading import open_regular

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_BYTES = 33
_MAX_JPEG_SEGMENTS = 1000
"""Largest number of JPEG segments and of bytes between them before the one with the size."""
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers of segments that hold the image's size."""


def read_image_shape(path: Path) -> tuple[int, int]:
    """Return (height, width) of a PNG or JPEG file, at most ``IMAGE_PIXELS`` pixels.

    Raises ``EntryError``, whose problem has no location, for any other file.
    """
    try:
        with open_regular(path) as stream:
            shape = _png_shape(stream) or _jpeg_shape(stream)
    except OSError as error:
        raise EntryError(Problem("unreadable", "", f"cannot be read: {error.strerror or error}")) from None
    if not shape or not all(shape):
        raise EntryError(Problem("damaged", "", "is not a readable image", "a PNG or JPEG file"))
    if shape[0] * shape[1] > IMAGE_PIXELS.value():
        found = f"the image is {format_shape(shape)} (H x W)"
        raise EntryError(Problem("size", "", found, IMAGE_PIXELS.allowed("pixels")))
    return shape


def _png_shape(stream: BinaryIO) -> tuple[int, int] | None:
    head = stream.read(_PNG_HEADER_BYTES)
    if len(head) < _PNG_HEADER_BYTES or head[:16] != _PNG_SIGNATURE + b"\0\0\0\rIHDR":
        return None
    if zlib.crc32(head[12:29]) != int.from_bytes(head[29:], "big"):
        return None
    width, height = struct.unpack(">2I", head[16:24])
    return height, width


def _jpeg_shape(stream: BinaryIO) -> tuple[int, int] | None:
    stream.seek(0)
    if stream.read(2) != b"\xff\xd8":
        return None
    for _ in range(_MAX_JPEG_SEGMENTS):
        head = stream.read(9)
        if len(head) < 9 or head[0] != 0xFF:
            return None
        if head[1] == 0xFF:  # Bytes 0xFF may precede a marker.
            stream.seek(-8, 1)
            continue
        if head[1] in _FRAME_MARKERS:
            height, width = struct.unpack(">2H", head[5:9])
            return height, width
        stream.seek(int.from_bytes(head[2:4], "big") - 7, 1)
    return None
