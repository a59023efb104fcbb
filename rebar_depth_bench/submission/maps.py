"""Decoders of the depth maps in an archive: ``.npy``, ``.npz``, ``.exr`` and ``.png``.

The header of ``.npy`` is parsed with regular expressions before any value is read. NumPy's reader is not used on
untrusted data: it allocates the size that the header declares, evaluates the header as a Python literal and emits
warnings for old format versions. An ``.npz`` entry is a zip inside the archive and is checked by the same rules as
the archive itself.

The header of OpenEXR is parsed and checked here too, so that the OpenEXR library receives only files with one flat
channel of the expected size. For PNG, the chunks and the inflated size are checked, and Pillow only undoes the row
filters.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rebar_depth_bench.base.errors import EntryError, Problem, escape_text, format_shape, library_message
from rebar_depth_bench.base.reading import MemorySource
from rebar_depth_bench.submission.zip import read_data, read_entries

MAX_HEADER_BYTES = 4096
"""Largest accepted ``.npy`` header, magic string included, in bytes."""

Depth = NDArray[np.floating[Any]]
"""Planar depth along the optical axis in metres: (H, W), float16, float32 or float64 in native byte order."""

_MAGIC = b"\x93NUMPY"
_LENGTH_BYTES = {1: 2, 2: 4, 3: 4}
_DESCR = re.compile(r"'descr'\s*:\s*(?:'([^']*)'|\[[^]]*\])")
_FORTRAN_ORDER = re.compile(r"'fortran_order'\s*:\s*(True|False)")
_SHAPE = re.compile(r"'shape'\s*:\s*\(([0-9L,\s]*)\)")
_FLOAT_DESCR = re.compile(r"[<>=|]?f[248]")
_INTEGER_DESCR = re.compile(r"[<>=|]?[iu][1248]")


def max_npy_bytes(shape: tuple[int, int]) -> int:
    """Return the largest acceptable size of an ``.npy`` file of shape (H, W) in bytes (float64 values)."""
    return shape[0] * shape[1] * 8 + MAX_HEADER_BYTES


def resize_hint(shape: Sequence[object], expected: tuple[int, int]) -> str:
    """Return how a map comes to the (H, W) of its view, for the end of a message.

    It is "" for other than two axes and for another ratio of the sides, as that of a transposed or flattened map,
    which no resizing makes right.
    """
    height, width = expected
    if len(shape) == 2 and all(str(side).isdecimal() for side in shape):
        rows, columns = (int(str(side)) for side in shape)
        if abs(rows * width - columns * height) < max(height, width):
            # Other interpolations make depth that lies between a bar and its background.
            return f"; resize it by cv2.resize(depth, ({width}, {height}), interpolation=cv2.INTER_NEAREST)"
    return ""


def decode_npy(name: str, data: memoryview, shape: tuple[int, int], _: float = 1.0, ints: bool = False) -> Depth:
    """Return the depth array in ``data``, in metres: (H, W), float16, float32 or float64 in native byte order.

    The array is a read-only view on ``data``, or a copy if its bytes had to be swapped or aligned.
    Integers are read with ``ints`` only. Raises ``EntryError`` if data are damaged or have another shape or dtype.
    """
    dtype, fortran_order, offset = _parse_header(name, data, shape, ints)
    actual_bytes, expected_bytes = len(data) - offset, shape[0] * shape[1] * dtype.itemsize
    if actual_bytes != expected_bytes:
        expected = f"{expected_bytes} for {format_shape(shape)} {dtype.name}"
        raise EntryError(Problem("size", name, f"{actual_bytes} bytes of values follow the header", expected))
    values = np.frombuffer(data, dtype, offset=offset)
    array = values.reshape(shape[::-1]).T if fortran_order else values.reshape(shape)
    return np.require(array, array.dtype.newbyteorder("="), "A")


def _parse_header(
    name: str, data: memoryview, shape: tuple[int, int], ints: bool
) -> tuple[np.dtype[np.floating[Any]], bool, int]:
    """Return the type of the values, whether they are in Fortran order, and the offset of the first."""
    head = bytes(data[: MAX_HEADER_BYTES + 1])
    version = head[6] if head.startswith(_MAGIC) and len(head) >= 8 else 0
    if version not in _LENGTH_BYTES:
        pickled = head[:1] == b"\x80"
        actual = "a Python pickle" if pickled else f"bytes that start with {head[:8]!r}"
        raise EntryError(Problem("syntax", name, f"{actual} was found", "a .npy array of version 1, 2 or 3"))
    start = 8 + _LENGTH_BYTES[version]
    end = start + int.from_bytes(head[8:start], "little")
    if end > MAX_HEADER_BYTES:
        found = f"the .npy header declares {end - start} bytes"
        raise EntryError(Problem("size", name, found, f"at most {MAX_HEADER_BYTES - start}"))
    if end > len(head):
        found = f"the .npy header is cut off at {len(head)} bytes"
        raise EntryError(Problem("damaged", name, found, f"{end}"))
    text = head[start:end].decode("utf-8", "backslashreplace")
    descr, fortran, shapes = (pattern.findall(text) for pattern in (_DESCR, _FORTRAN_ORDER, _SHAPE))
    remainder = _SHAPE.sub("", _FORTRAN_ORDER.sub("", _DESCR.sub("", text)))
    if not len(descr) == len(fortran) == len(shapes) == 1 or re.sub(r"[\s,]", "", remainder) != "{}":
        found = f"the .npy header is {escape_text(text.strip())}"
        raise EntryError(Problem("syntax", name, found, "descr, fortran_order and shape"))
    if descr[0].lstrip("<>=|").startswith("O"):
        found = "the array holds pickled Python objects (dtype object)"
        raise EntryError(Problem("invalid", name, found, "float16/32/64"))
    if not _FLOAT_DESCR.fullmatch(descr[0]) and not (ints and _INTEGER_DESCR.fullmatch(descr[0])):
        actual = escape_text(descr[0]) if descr[0] else "structured"
        expected = f"{'integers, ' if ints else ''}float16, float32 or float64"
        raise EntryError(Problem("invalid", name, f"the dtype is {actual}", expected))
    actual_shape = shapes[0].replace("L", "").replace(",", " ").split()
    if actual_shape != [str(size) for size in shape]:
        actual = " x ".join(map(escape_text, actual_shape)) if actual_shape else "a single value"
        expected = f"{format_shape(shape)} (H x W){resize_hint(actual_shape, shape)}"
        raise EntryError(Problem("invalid", name, f"the shape is {actual}", expected))
    return np.dtype(descr[0].replace("|", "=")), fortran[0] == "True", end


# More than the one expected array, so that the error message can list the members of a wrong file.
_MAX_NPZ_MEMBERS = 256
_MAX_NPZ_OVERHEAD_BYTES = 64 * 1024


def max_npz_bytes(shape: tuple[int, int]) -> int:
    """Return the largest acceptable size of an ``.npz`` file of shape (H, W), in bytes."""
    values = max_npy_bytes(shape)
    return values + values // 1024 + _MAX_NPZ_OVERHEAD_BYTES


def decode_npz(name: str, data: memoryview, shape: tuple[int, int], _: float = 1.0, ints: bool = False) -> Depth:
    """Return the only array of an ``.npz`` file, as ``decode_npy`` does. Raises ``EntryError``."""
    source = MemorySource(data)
    try:
        entries = read_entries(source, _MAX_NPZ_MEMBERS, lambda _: max_npy_bytes(shape))
    except EntryError as error:
        raise _inner_error(name, error.problems) from error
    members = [escape_text(entry.name) for entry in entries]
    if len(members) != 1:
        listed = f" ({', '.join(members[:4])}{', ...' if len(members) > 4 else ''})" if members else ""
        raise EntryError(Problem("invalid", name, f"the .npz holds {len(members)} arrays{listed}", "exactly one"))
    [entry] = entries
    if entry.problems:
        raise _inner_error(name, entry.problems)
    if not entry.name.endswith(".npy"):
        raise EntryError(Problem("invalid", name, f"the .npz holds {members[0]}", "one .npy array"))
    try:
        values = read_data(source, entry)
    except EntryError as error:
        raise _inner_error(name, error.problems) from error
    return decode_npy(f"{name} ({members[0]})", values, shape, ints=ints)


def _inner_error(name: str, problems: Sequence[Problem]) -> EntryError:
    """Return the error of an ``.npz`` entry whose zip or member has the given problems."""
    found = f"inside the .npz, {'; '.join(map(str, problems))}"
    return EntryError(Problem(problems[0].code, name, found))


_EXR_MAGIC = b"\x76\x2f\x31\x01"
_TILED, _LONG_NAMES, _DEEP, _MULTI_PART = 0x200, 0x400, 0x800, 0x1000
_MAX_EXR_HEADER_BYTES = 256 * 1024
_MAX_NAME_BYTES = 255
_PIXEL_TYPES = {0: "UINT", 1: "HALF", 2: "FLOAT"}
_MAX_TILE_PX = 1024


def max_exr_bytes(shape: tuple[int, int]) -> int:
    """Return the largest acceptable size of an ``.exr`` file of shape (H, W), in bytes.

    The bound allows uncompressed FLOAT values, an eight-byte offset and an eight-byte block header per scan line,
    and the file header.
    """
    return shape[0] * shape[1] * 4 + shape[0] * 16 + _MAX_EXR_HEADER_BYTES


def decode_exr(name: str, data: memoryview, shape: tuple[int, int], _: float = 1.0) -> Depth:
    """Return the single channel of an OpenEXR file in metres: (H, W), float16 (HALF) or float32 (FLOAT).

    Raises ``EntryError`` if the file is damaged, has another size or pixel type, or is not one flat image with one
    channel, and as ``check_exr_windows``.
    """
    _check_exr_header(name, data, shape)
    import OpenEXR  # A tenth of a second, which archives of other formats do not need.

    try:
        image = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0)
        (channel,) = image.channels().values()
        pixels: Depth = channel.pixels
    except Exception as error:  # OpenEXR raises several unrelated exception types for damaged files.
        found = f"the OpenEXR data is corrupt or truncated ({library_message(error)})"
        raise EntryError(Problem("damaged", name, found)) from error
    if pixels.shape != shape or pixels.dtype not in (np.float16, np.float32):
        found = f"the image decodes to {pixels.dtype} {pixels.shape}"
        raise EntryError(Problem("invalid", name, found, f"{format_shape(shape)} floats"))
    return pixels


def _check_exr_header(name: str, data: memoryview, shape: tuple[int, int]) -> None:
    head = bytes(data[:_MAX_EXR_HEADER_BYTES])
    if len(head) < 8 or not head.startswith(_EXR_MAGIC):
        raise EntryError(Problem("syntax", name, f"the bytes start with {head[:8]!r}", "an OpenEXR file"))
    flags = int.from_bytes(head[4:8], "little")
    if flags & 0xFF != 2 or flags & ~(0xFF | _TILED | _LONG_NAMES | _DEEP | _MULTI_PART):
        raise EntryError(Problem("invalid", name, f"the OpenEXR version field is {flags:#x}", "version 2"))
    if flags & (_DEEP | _MULTI_PART):
        layout = "deep" if flags & _DEEP else "multi-part"
        raise EntryError(Problem("invalid", name, f"the OpenEXR file is {layout}", "one flat image"))
    try:
        attributes = _parse_attributes(head)
        channels = list(_parse_channels(attributes["channels"]))
        window, display = (struct.unpack("<4i", attributes[key]) for key in ("dataWindow", "displayWindow"))
        tiles = struct.unpack("<2IB", attributes["tiles"]) if flags & _TILED else None
    except (ValueError, KeyError, struct.error) as error:
        found = f"the OpenEXR header is damaged ({escape_text(str(error))})"
        raise EntryError(Problem("damaged", name, found)) from error
    _check_channel(name, channels)
    window_shape = (window[3] - window[1] + 1, window[2] - window[0] + 1)
    if window_shape != shape:
        found = f"the data window is {format_shape(window_shape)}"
        expected = f"{format_shape(shape)} (H x W){resize_hint(window_shape, shape)}"
        raise EntryError(Problem("invalid", name, found, expected))
    check_exr_windows(name, window, display)
    if tiles is not None:
        _check_tiles(name, tiles, shape)


def check_exr_windows(name: str, data_window: Sequence[int], display_window: Sequence[int]) -> None:
    """Raise ``EntryError`` if the stored pixels of an OpenEXR file begin beside the picture.

    Windows are (x_min, y_min, x_max, y_max), inclusive, in pixels. The display window is the picture, and the data
    window the part of the plane that is stored: read without the windows, the pixels would be at other places.
    """
    if data_window[:2] != display_window[:2]:
        data, display = (
            f"columns {window[0]} to {window[2]} and rows {window[1]} to {window[3]}"
            for window in (data_window, display_window)
        )
        found = f"the data window, {data}, and the display window, {display}, begin at different pixels"
        expected = "the same first pixel: the whole picture, without crop or overscan"
        raise EntryError(Problem("invalid", name, found, expected))


def _check_channel(name: str, channels: list[tuple[str, int, int, int]]) -> None:
    if len(channels) != 1:
        names = [escape_text(label) for label, *_ in channels[:4]] + ["..."] * (len(channels) > 4)
        found = f"the OpenEXR file has {len(channels)} channels ({', '.join(names)})"
        raise EntryError(Problem("invalid", name, found, "one"))
    label, pixel_type, x_step, y_step = channels[0]
    if pixel_type not in (1, 2):
        found = f"the channel {escape_text(label)} is {_PIXEL_TYPES.get(pixel_type, f'of type {pixel_type}')}"
        raise EntryError(Problem("invalid", name, found, "HALF or FLOAT"))
    if (x_step, y_step) != (1, 1):
        found = f"the channel {escape_text(label)} is subsampled {x_step} x {y_step}"
        raise EntryError(Problem("invalid", name, found, "1 x 1"))


def _check_tiles(name: str, tiles: tuple[int, int, int], shape: tuple[int, int]) -> None:
    max_size = max(_MAX_TILE_PX, *shape)
    width, height, level_mode = tiles
    if not (0 < width <= max_size and 0 < height <= max_size):
        raise EntryError(Problem("invalid", name, f"the tiles are {height} x {width}", f"1 to {max_size} each"))
    if level_mode & 0x0F:
        raise EntryError(Problem("invalid", name, "the OpenEXR file has several resolution levels", "one"))


def _parse_attributes(head: bytes) -> Mapping[str, bytes]:
    """Return the raw values of the header attributes by name. Raises ``ValueError`` if the header is malformed."""
    attributes: dict[str, bytes] = {}
    offset = 8
    while True:
        name, offset = _read_name(head, offset)
        if not name:
            return attributes
        _, offset = _read_name(head, offset)
        (length,) = struct.unpack_from("<i", head, offset)
        offset += 4
        if length < 0 or offset + length > len(head):
            raise ValueError(f"attribute {name} declares {length} bytes")
        if name in attributes:
            raise ValueError(f"attribute {name} occurs twice")
        attributes[name] = head[offset : offset + length]
        offset += length


def _parse_channels(value: bytes) -> Iterator[tuple[str, int, int, int]]:
    """Yield (name, pixel type, x sampling, y sampling) of every channel in a ``channels`` attribute."""
    offset = 0
    while True:
        name, offset = _read_name(value, offset)
        if not name:
            return
        pixel_type, _, x_step, y_step = struct.unpack_from("<iI2i", value, offset)
        offset += 16
        yield name, pixel_type, x_step, y_step


def _read_name(data: bytes, start: int) -> tuple[str, int]:
    """Return the NUL-terminated name at byte ``start`` and the offset after it. Raises ``ValueError``."""
    end = data.find(b"\0", start, start + _MAX_NAME_BYTES + 1)
    if end < 0:
        raise ValueError(f"the name at byte {start} is not terminated")
    return data[start:end].decode("utf-8", "backslashreplace"), end + 1


_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_IHDR = struct.Struct(">2I5B")
_CONTAINER_BYTES = 256 * 1024
# First column, first row, column step and row step of the seven Adam7 passes (PNG specification).
_ADAM7_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
_COLOUR_TYPES = {0: "greyscale", 2: "RGB", 3: "palette", 4: "greyscale with alpha", 6: "RGBA"}


def max_png_bytes(shape: tuple[int, int]) -> int:
    """Return the largest acceptable size of a 16-bit ``.png`` file of shape (H, W), in bytes."""
    rows = shape[0] * (shape[1] * 2 + 1)
    return rows + rows // 64 + _CONTAINER_BYTES


def decode_png(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the 16-bit values times ``depth_scale`` (metres per unit): depth in metres, (H, W), float64.

    In float64 the product ``value * depth_scale`` is rounded once, so it equals what any other reader of the file
    computes; float32 products would differ. Raises ``EntryError`` if the file is damaged or is not a 16-bit
    greyscale image of the expected size.
    """
    chunks = list(_read_chunks(name, data))
    header = _check_png_header(name, chunks, shape)
    rows = _inflate_rows(name, chunks, _filtered_row_bytes(shape, interlaced=bool(header[-1])))
    try:
        with Image.open(io.BytesIO(_minimal_png(header, rows)), formats=["PNG"]) as image:
            units = np.asarray(image)
    except Exception as error:  # Pillow raises several unrelated exception types for damaged files.
        found = f"the PNG data is corrupt ({library_message(error)})"
        raise EntryError(Problem("damaged", name, found)) from error
    if units.shape != shape or units.dtype.kind not in "ui":
        found = f"the PNG decodes to {units.dtype} of shape {units.shape}"
        raise EntryError(Problem("invalid", name, found, format_shape(shape)))
    with np.errstate(over="ignore"):  # Overflow gives infinite depth, which counts as no prediction.
        return units.astype(np.float64) * depth_scale


def _read_chunks(name: str, data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield type and content of every chunk up to IEND.

    Raises ``EntryError`` for a truncated file, a wrong checksum or bytes after IEND.
    """
    if bytes(data[:8]) != _PNG_SIGNATURE:
        raise EntryError(Problem("syntax", name, f"the bytes start with {bytes(data[:8])!r}", "a PNG file"))
    offset, kind = 8, b""
    while kind != b"IEND":
        length = int.from_bytes(data[offset : offset + 4], "big")
        end = offset + 12 + length
        if end > len(data):
            found = f"the PNG is truncated at {len(data)} bytes"
            raise EntryError(Problem("damaged", name, found, f"{max(end, offset + 12)} or more"))
        kind, content = bytes(data[offset + 4 : offset + 8]), data[offset + 8 : end - 4]
        if zlib.crc32(data[offset + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            found = f"the PNG chunk at byte {offset} is corrupt: its checksum does not match the stored one"
            raise EntryError(Problem("damaged", name, found))
        yield kind, content
        offset = end
    if offset != len(data):
        raise EntryError(Problem("damaged", name, f"{len(data) - offset} bytes follow the PNG's end", "none"))


def _check_png_header(
    name: str, chunks: list[tuple[bytes, memoryview]], shape: tuple[int, int]
) -> tuple[int, ...]:
    kind, content = chunks[0]
    if (
        kind != b"IHDR"
        or len(content) != _IHDR.size
        or sum(chunk_kind == b"IHDR" for chunk_kind, _ in chunks) != 1
    ):
        found = "the PNG does not start with its header chunk"
        raise EntryError(Problem("damaged", name, found, "exactly one IHDR"))
    header = _IHDR.unpack(content)
    width, height, bits, colour, compression, filtering, interlace = header
    if (bits, colour) != (16, 0):
        actual = f"{bits}-bit {_COLOUR_TYPES.get(colour, f'colour type {colour}')}"
        raise EntryError(Problem("invalid", name, f"the PNG is {actual}", "16-bit greyscale"))
    if (height, width) != shape:
        found = f"the image is {height} x {width}"
        expected = f"{format_shape(shape)} (H x W){resize_hint((height, width), shape)}"
        raise EntryError(Problem("invalid", name, found, expected))
    if compression or filtering or interlace > 1:
        actual = f"compression {compression}, filter {filtering}, interlace {interlace}"
        raise EntryError(Problem("invalid", name, f"the PNG header declares {actual}", "0, 0 and 0 or 1"))
    return header


def _filtered_row_bytes(shape: tuple[int, int], *, interlaced: bool) -> int:
    """Return the total size of the filtered rows in bytes: one filter byte per row and two bytes per pixel."""
    if not interlaced:
        return shape[0] * (1 + 2 * shape[1])
    total = 0
    for x, y, x_step, y_step in _ADAM7_PASSES:
        columns, rows = len(range(x, shape[1], x_step)), len(range(y, shape[0], y_step))
        total += rows * (1 + 2 * columns) if columns else 0
    return total


def _inflate_rows(name: str, chunks: list[tuple[bytes, memoryview]], expected: int) -> bytes:
    indices = [index for index, (kind, _) in enumerate(chunks) if kind == b"IDAT"]
    if not indices or any(after != before + 1 for before, after in pairwise(indices)):
        raise EntryError(Problem("damaged", name, f"the PNG has {len(indices)} image chunks", "one run of IDAT"))
    inflater = zlib.decompressobj()
    try:
        rows = inflater.decompress(b"".join(chunks[index][1] for index in indices), expected + 1)
    except zlib.error as error:
        raise EntryError(Problem("damaged", name, f"the PNG image data is corrupt ({error})")) from error
    if len(rows) != expected or not inflater.eof:
        actual = f"more than {expected}" if len(rows) > expected else f"{len(rows)}"
        found = f"the PNG image data inflates to {actual} bytes"
        raise EntryError(Problem("size", name, found, f"{expected} and a complete stream"))
    return rows


def _minimal_png(header: tuple[int, ...], rows: bytes) -> bytes:
    """Return a PNG file with only the given header and rows, so that Pillow parses no ancillary chunks.

    Colour profiles, text and animation are left out. Deflate level 0 stores the rows uncompressed, which avoids
    compressing and inflating them a second time.
    """
    parts = ((b"IHDR", _IHDR.pack(*header)), (b"IDAT", zlib.compress(rows, 0)), (b"IEND", b""))
    chunks = (
        len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")
        for kind, body in parts
    )
    return _PNG_SIGNATURE + b"".join(chunks)
