"""``.exr`` entries: the header is parsed here, so that the library only meets a file worth decoding."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Mapping

import numpy as np
import OpenEXR

from rebar_depth_bench.submission.npy import Depth
from rebar_depth_bench.submission.problems import EntryError, show, show_shape

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
    _check_header(name, data, shape)
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


def _check_header(name: str, data: memoryview, shape: tuple[int, int]) -> None:
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
