"""``.png`` entries: container and inflated size are checked here, Pillow undoes the row filters."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from PIL import Image

from rebar_depth_bench.submission.npy import Depth
from rebar_depth_bench.submission.problems import EntryError, show, show_shape

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER = struct.Struct(">2I5B")
_SLACK_BYTES = 256 * 1024
# First column and row, then their steps, of the seven Adam7 passes.
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_COLOURS = {0: "greyscale", 2: "RGB", 3: "palette", 4: "greyscale with alpha", 6: "RGBA"}


def max_png_bytes(shape: tuple[int, int]) -> int:
    """Return the size of the largest acceptable 16-bit ``.png`` of that (H, W), in bytes."""
    rows = shape[0] * (shape[1] * 2 + 1)
    return rows + rows // 64 + _SLACK_BYTES


def decode_png(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the 16-bit values times ``depth_scale`` (metres per unit) as float64 of (H, W).

    float64 keeps ``value * depth_scale`` to one rounding; the products of a float32 image would not
    be those that a reader of the file computes. Raises ``EntryError``.
    """
    chunks = list(_chunks(name, data))
    header = _check_header(name, chunks, shape)
    rows = _inflate_rows(name, chunks, _row_bytes(shape, interlaced=bool(header[-1])))
    try:
        with Image.open(io.BytesIO(_plain_png(header, rows)), formats=["PNG"]) as image:
            units = np.asarray(image)
    except Exception as error:  # Pillow raises several unrelated types for damaged files.
        raise EntryError(f"{name}: the PNG data is corrupt ({show(str(error))})") from error
    if units.shape != shape or units.dtype.kind not in "ui":
        raise EntryError(
            f"{name}: the PNG decodes to {units.dtype} of shape {units.shape}, expected {show_shape(shape)}"
        )
    with np.errstate(over="ignore"):  # An infinite depth is no prediction, as everywhere.
        return units.astype(np.float64) * depth_scale


def _chunks(name: str, data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield type and content of every chunk up to IEND, each with a right checksum."""
    if bytes(data[:8]) != _SIGNATURE:
        raise EntryError(f"{name}: the bytes start with {bytes(data[:8])!r}, expected a PNG file")
    at, kind = 8, b""
    while kind != b"IEND":
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 12 + length
        if end > len(data):
            raise EntryError(
                f"{name}: the PNG is truncated at {len(data)} bytes, expected {max(end, at + 12)} or more"
            )
        kind, content = bytes(data[at + 4 : at + 8]), data[at + 8 : end - 4]
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            raise EntryError(f"{name}: the PNG chunk at byte {at} is corrupt: its checksum is not the one stored")
        yield kind, content
        at = end
    if at != len(data):
        raise EntryError(f"{name}: {len(data) - at} bytes follow the PNG's end, expected none")


def _check_header(name: str, chunks: list[tuple[bytes, memoryview]], shape: tuple[int, int]) -> tuple[int, ...]:
    kind, content = chunks[0]
    if kind != b"IHDR" or len(content) != _HEADER.size or sum(k == b"IHDR" for k, _ in chunks) != 1:
        raise EntryError(f"{name}: the PNG does not start with its one header chunk, expected IHDR")
    header = _HEADER.unpack(content)
    width, height, bits, colour, compression, filtering, interlace = header
    if (bits, colour) != (16, 0):
        found = f"{bits}-bit {_COLOURS.get(colour, f'colour type {colour}')}"
        raise EntryError(f"{name}: the PNG is {found}, expected 16-bit greyscale")
    if (height, width) != shape:
        raise EntryError(f"{name}: the image is {height} x {width}, expected {show_shape(shape)} (H x W)")
    if compression or filtering or interlace > 1:
        found = f"compression {compression}, filter {filtering}, interlace {interlace}"
        raise EntryError(f"{name}: the PNG header says {found}, expected 0, 0 and 0 or 1")
    return header


def _row_bytes(shape: tuple[int, int], *, interlaced: bool) -> int:
    """Return the bytes of all filtered rows: a filter byte and two bytes per pixel each."""
    if not interlaced:
        return shape[0] * (1 + 2 * shape[1])
    total = 0
    for x, y, x_step, y_step in _ADAM7:
        columns, rows = len(range(x, shape[1], x_step)), len(range(y, shape[0], y_step))
        total += rows * (1 + 2 * columns) if columns else 0
    return total


def _inflate_rows(name: str, chunks: list[tuple[bytes, memoryview]], expected: int) -> bytes:
    at = [index for index, (kind, _) in enumerate(chunks) if kind == b"IDAT"]
    if not at or any(after != before + 1 for before, after in pairwise(at)):
        raise EntryError(f"{name}: the PNG has {len(at)} image chunks, expected one run of IDAT")
    inflater = zlib.decompressobj()
    try:
        rows = inflater.decompress(b"".join(chunks[index][1] for index in at), expected + 1)
    except zlib.error as error:
        raise EntryError(f"{name}: the PNG image data is corrupt ({error})") from error
    if len(rows) != expected or not inflater.eof:
        found = f"more than {expected}" if len(rows) > expected else f"{len(rows)}"
        raise EntryError(f"{name}: the PNG image data inflates to {found} bytes, expected {expected}, whole")
    return rows


def _plain_png(header: tuple[int, ...], rows: bytes) -> bytes:
    """Return a PNG of header and rows alone: no colour profile, text or animation reaches Pillow.

    Deflate level 0 stores the rows, so that they are not compressed and inflated a second time.
    """
    parts = ((b"IHDR", _HEADER.pack(*header)), (b"IDAT", zlib.compress(rows, 0)), (b"IEND", b""))
    chunks = (
        len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")
        for kind, body in parts
    )
    return _SIGNATURE + b"".join(chunks)
