"""``.exr`` entries: the header is parsed here, so that the library only meets a file worth decoding.

``.png`` entries: container and inflated size are checked here, Pillow undoes the row filters.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Mapping
from itertools import pairwise

import numpy as np
import OpenEXR
from PIL import Image

from rebar_depth_bench.errors import EntryError, show, show_shape
from rebar_depth_bench.submission.numpy_formats import Depth

_MAGIC = b"\x76\x2f\x31\x01"
_TILED, _LONG_NAMES, _DEEP, _MULTI_PART = 0x200, 0x400, 0x800, 0x1000
_HEADER_LIMIT = 256 * 1024
_LONGEST_NAME = 255
_PIXEL_TYPES = {0: "UINT", 1: "HALF", 2: "FLOAT"}
_TILE_LIMIT = 1024


def max_exr_bytes(shape: tuple[int, int]) -> int:
    """Return the size of the largest acceptable ``.exr`` of that (H, W), in bytes.

    Uncompressed FLOAT values, eight bytes of offset and eight of leader per scan line, and a header.
    """
    return shape[0] * shape[1] * 4 + shape[0] * 16 + _HEADER_LIMIT


def decode_exr(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the file's only channel, float16 (HALF) or float32 (FLOAT) of (H, W), in metres.

    ``depth_scale`` does not apply. Raises ``EntryError``.
    """
    del depth_scale
    _check_exr_header(name, data, shape)
    try:
        image = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0)
        (channel,) = image.channels().values()
        pixels: Depth = channel.pixels
    except Exception as error:  # The library raises several unrelated types for damaged files.
        raise EntryError(f"{name}: the OpenEXR data is corrupt or truncated ({show(str(error))})") from error
    if pixels.shape != shape or pixels.dtype not in (np.float16, np.float32):
        raise EntryError(
            f"{name}: the image decodes to {pixels.dtype} {pixels.shape}, expected {show_shape(shape)} floats"
        )
    return pixels


def _check_exr_header(name: str, data: memoryview, shape: tuple[int, int]) -> None:
    head = bytes(data[:_HEADER_LIMIT])
    if len(head) < 8 or not head.startswith(_MAGIC):
        raise EntryError(f"{name}: the bytes start with {head[:8]!r}, expected an OpenEXR file")
    flags = int.from_bytes(head[4:8], "little")
    if flags & 0xFF != 2 or flags & ~(0xFF | _TILED | _LONG_NAMES | _DEEP | _MULTI_PART):
        raise EntryError(f"{name}: the OpenEXR version field is {flags:#x}, expected version 2")
    if flags & (_DEEP | _MULTI_PART):
        kind = "deep" if flags & _DEEP else "multi-part"
        raise EntryError(f"{name}: the OpenEXR file is {kind}, expected one flat image")
    try:
        attributes = _attributes(head)
        channels = list(_channels(attributes["channels"]))
        window = struct.unpack("<4i", attributes["dataWindow"])
        tiles = struct.unpack("<2IB", attributes["tiles"]) if flags & _TILED else None
    except (ValueError, KeyError, struct.error) as error:
        raise EntryError(f"{name}: the OpenEXR header is damaged ({show(str(error))})") from error
    _check_channel(name, channels)
    found = (window[3] - window[1] + 1, window[2] - window[0] + 1)
    if found != shape:
        raise EntryError(f"{name}: the data window is {show_shape(found)}, expected {show_shape(shape)} (H x W)")
    if tiles is not None:
        _check_tiles(name, tiles, shape)


def _check_channel(name: str, channels: list[tuple[str, int, int, int]]) -> None:
    if len(channels) != 1:
        names = ", ".join(show(channel[0]) for channel in channels[:4]) + (", ..." if len(channels) > 4 else "")
        raise EntryError(f"{name}: the OpenEXR file has {len(channels)} channels ({names}), expected one")
    label, kind, x_step, y_step = channels[0]
    if kind not in (1, 2):
        found = _PIXEL_TYPES.get(kind, f"of type {kind}")
        raise EntryError(f"{name}: the channel {show(label)} is {found}, expected HALF or FLOAT")
    if (x_step, y_step) != (1, 1):
        raise EntryError(f"{name}: the channel {show(label)} is subsampled {x_step} x {y_step}, expected 1 x 1")


def _check_tiles(name: str, tiles: tuple[int, int, int], shape: tuple[int, int]) -> None:
    most = max(_TILE_LIMIT, *shape)
    width, height, mode = tiles
    if not (0 < width <= most and 0 < height <= most):
        raise EntryError(f"{name}: the tiles are {height} x {width}, expected 1 to {most} each")
    if mode & 0x0F:
        raise EntryError(f"{name}: the OpenEXR file has several resolution levels, expected one")


def _attributes(head: bytes) -> Mapping[str, bytes]:
    """Return the values of the header's attributes. Raises ``ValueError`` if it is not well formed."""
    attributes: dict[str, bytes] = {}
    at = 8
    while True:
        name, at = _text(head, at)
        if not name:
            return attributes
        _, at = _text(head, at)
        (length,) = struct.unpack_from("<i", head, at)
        at += 4
        if length < 0 or at + length > len(head):
            raise ValueError(f"attribute {name} declares {length} bytes")
        if name in attributes:
            raise ValueError(f"attribute {name} stands twice")
        attributes[name] = head[at : at + length]
        at += length


def _channels(value: bytes) -> Iterator[tuple[str, int, int, int]]:
    """Yield name, pixel type, x and y sampling of every channel."""
    at = 0
    while True:
        name, at = _text(value, at)
        if not name:
            return
        kind, _, x_step, y_step = struct.unpack_from("<iI2i", value, at)
        at += 16
        yield name, kind, x_step, y_step


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.find(b"\0", at, at + _LONGEST_NAME + 1)
    if end < 0:
        raise ValueError(f"no end of the name at byte {at}")
    return data[at:end].decode("utf-8", "backslashreplace"), end + 1


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
    header = _check_png_header(name, chunks, shape)
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


def _check_png_header(
    name: str, chunks: list[tuple[bytes, memoryview]], shape: tuple[int, int]
) -> tuple[int, ...]:
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
