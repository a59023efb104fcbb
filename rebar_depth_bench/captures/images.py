"""Image files of a capture: names, sizes, and decoding of 8-bit pictures."""

from __future__ import annotations

import os
import re
import struct
import warnings
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from jaxtyping import UInt8
from numpy import ndarray
from PIL.ExifTags import Base
from PIL.Image import Image
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile

from rebar_depth_bench.base.errors import (
    EntryError,
    InputError,
    Problem,
    escape_text,
    format_shape,
    library_message,
)
from rebar_depth_bench.base.limits import CELL_BYTES, IMAGE_PIXELS
from rebar_depth_bench.base.reading import open_regular, read_file
from rebar_depth_bench.data.codecs import decode

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
OTHER_SUFFIXES = (".tif", ".tiff", ".bmp", ".webp", ".gif", ".exr", ".ppm", ".pgm", ".jp2", ".heic", ".avif")
"""Suffixes of pictures that are not read."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
NAME_RULE = "a name of 1 to 100 letters, digits, . _ -"


def read_image(path: Path, grid: tuple[int, int]) -> UInt8[ndarray, "h w 3"]:
    """Return an 8-bit image of ``grid`` (height, width) as RGB.

    Raises ``InputError`` if it cannot be read or decoded, or has another size or more bits.
    """
    content = read_file(path, CELL_BYTES, "an image", InputError)
    try:
        return decode("rgb", content, grid)
    except Exception as error:  # Pillow raises many types, which depend on the damage.
        reason = library_message(error)
        raise InputError(f"{path}: cannot be decoded: {reason}, expected an 8-bit PNG or JPEG image") from error


def entry_name(file: Path) -> str:
    """Return the location of an image in the capture, for error messages."""
    return escape_text(f"{file.parent.name}/{file.name}")


def image_files(folder: Path, problems: list[Problem]) -> dict[str, Path]:
    """Return the image files of a folder by stem; append the problems of their names to ``problems``."""
    if not folder.is_dir():
        problems.append(Problem("missing", f"{folder.name}/", "no such folder"))
        return {}
    if not os.access(folder, os.R_OK | os.X_OK):
        problems.append(Problem("unreadable", f"{folder.name}/", "the folder cannot be read"))
        return {}
    files: dict[str, Path] = {}
    entries = [file for file in sorted(folder.iterdir()) if not file.name.startswith(".") and not file.is_dir()]
    others = [escape_text(file.name) for file in entries if file.suffix.lower() in OTHER_SUFFIXES]
    if others:
        found = f"has {len(others)} pictures of other formats, such as {', '.join(others[:3])}"
        problems.append(Problem("invalid", f"{folder.name}/", found, "PNG or JPEG: save them as PNG"))
    for file in entries:
        if file.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        if file.stem in files:
            problems.append(Problem("duplicate", entry_name(file), "the name occurs twice", "one image per view"))
        if not NAME.fullmatch(file.stem):
            problems.append(Problem("name", entry_name(file), "invalid name", NAME_RULE))
        files[file.stem] = file
    return files


def common_shape(images: Sequence[Path], problems: list[Problem]) -> tuple[int, int] | None:
    """Return (height, width) of the first readable image; add a problem for each of another size or unreadable."""
    shape: tuple[int, int] | None = None
    for file in images:
        try:
            height, width = read_image_shape(file)
        except EntryError as error:
            problems += [replace(problem, where=entry_name(file)) for problem in error.problems]
            continue
        shape = shape or (height, width)
        if (height, width) != shape:
            expected = f"{shape[1]} x {shape[0]} as the first"
            problems.append(Problem("invalid", entry_name(file), f"is {width} x {height}", expected))
    return shape


def check_upright(stream: BinaryIO, where: str = "") -> None:
    """Check that a PNG, JPEG or TIFF file does not ask viewers to turn its pixels; damaged metadata do not.

    Raises ``EntryError`` with the location ``where`` for an EXIF orientation other than 1: a calibration may be
    that of the turned or of the stored pixels.
    """
    orientation: object = None
    is_small = stream.seek(0, os.SEEK_END) <= CELL_BYTES.value()  # Larger files are not read.
    for plugin in (PngImageFile, JpegImageFile, TiffImageFile) if is_small else ():
        stream.seek(0)
        with suppress(Exception), warnings.catch_warnings(action="ignore"), plugin(stream) as image:
            if plugin is PngImageFile:  # Pillow knows the chunks before the pixels only.
                stream.seek(0)
                image.info["exif"] = b"".join(_PNG_EXIF.findall(stream.read())[:1])
            # The method of PngImageFile would decode the pixels.
            orientation = Image.getexif(image).get(Base.Orientation)
    if orientation in range(2, 9):
        found = f"the EXIF orientation is {orientation}: viewers turn the pixels"
        remedy = "save the turned pixels (mogrify -auto-orient), or remove the tag (exiftool -Orientation=)"
        expected = f"1, as the calibration may be of either: {remedy}"
        raise EntryError(Problem("invalid", where, found, expected))


# Size of an image, read from its header. No image library takes part: nothing is decoded or inflated, whatever the
# file declares.


_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER_BYTES = 33
_PNG_EXIF = re.compile(rb"eXIf((?:II\*\0|MM\0\*)[\s\S]{4,65536})")
"""Chunk with EXIF data, and what is after it."""
_MAX_JPEG_SEGMENTS = 1000
"""Largest number of JPEG segments and of bytes between them before the one with the size."""
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers of segments that hold the image's size."""


def read_image_shape(path: Path) -> tuple[int, int]:
    """Return (height, width) of a PNG or JPEG file, at most ``IMAGE_PIXELS`` pixels.

    Raises ``EntryError``, whose problem has no location, for any other file and as ``check_upright``.
    """
    try:
        with open_regular(path) as stream:
            shape = _png_shape(stream) or _jpeg_shape(stream)
            if shape:
                check_upright(stream)
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
