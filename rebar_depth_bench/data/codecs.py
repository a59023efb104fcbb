"""Lossless codecs of the dataset's images and depth maps.

docs/design.md has the reasons for these formats.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image, __version__, features
from PIL.ImageFile import ImageFile

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import CELL_BYTES

_TIFF_PREDICTOR, _FLOATING_POINT = 317, 3
_TIFF_ROWS_PER_STRIP, _TIFF_TILE_WIDTH = 278, 322

_ZSTANDARD_PIXEL = bytes.fromhex(
    "49492a00080000000a000001030001000000010000000101030001000000010000000201030001000000200000000301030001000000"
    "50c3000006010300010000000100000011010300010000008600000015010300010000000100000016010300010000000100000017010300"
    "010000000d0000005301030001000000030000000000000028b52ffd006021000000000000"
)
"""TIFF of one pixel, float32, compressed with Zstandard."""


@dataclass(frozen=True)
class PictureKind:
    """Images of a kind of column: formats and modes of Pillow that are read, and mode and type when decoded."""

    formats: tuple[str, ...]
    modes: tuple[str, ...]
    mode: str
    dtype: type[np.generic]


_COLOUR = PictureKind(("WEBP", "PNG", "JPEG", "TIFF"), ("RGB", "RGBA", "P", "L"), "RGB", np.uint8)
PICTURE_KINDS: Mapping[str, PictureKind] = {
    "rgb": _COLOUR,
    "preview": _COLOUR,
    "depth": PictureKind(("TIFF",), ("F",), "F", np.float32),
    "mask": PictureKind(("PNG",), ("1", "L"), "1", np.bool_),
    "bars": PictureKind(("PNG",), ("I;16", "I", "L"), "I;16", np.uint16),
}
"""Images by the kind of their column (see ``schema.column_kind``)."""


class Picture(Image.Image):
    """Decoded image without a file, whose NumPy array is writable.

    It has no ``format``, so that ``datasets`` stores a changed picture as PNG or TIFF, without loss.
    """

    def __init__(self, image: Image.Image) -> None:
        super().__init__()
        vars(self).update({name: vars(image)[name] for name in vars(self)})

    @property
    def __array_interface__(self) -> dict[str, Any]:
        """Description of a copy of the pixels, for NumPy."""
        interface: dict[str, Any] = super().__array_interface__
        return interface | {"data": bytearray(interface["data"])}


@cache
def check_codecs() -> None:
    """Raise ``InputError`` if Pillow is built without a codec of the dataset's images, as wheels before 12 are."""
    missing = [] if features.check("webp") else ["WebP"]
    try:
        with Image.open(io.BytesIO(_ZSTANDARD_PIXEL)) as pixel:
            pixel.load()
    except OSError:
        missing.append("TIFF with Zstandard")
    if missing:
        raise InputError(
            f"Pillow {__version__} lacks {' and '.join(missing)}, expected all codecs of the dataset's images: "
            "pip install 'pillow>=12'"
        )


def encode_depth(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth in metres as TIFF: floating-point predictor, zstd, one strip.

    Raises ``InputError`` if Pillow is built without Zstandard.
    """
    check_codecs()  # Wheels of Pillow without Zstandard end the process.
    tags = {_TIFF_PREDICTOR: _FLOATING_POINT, _TIFF_ROWS_PER_STRIP: depth_m.shape[0]}
    image = Image.fromarray(np.ascontiguousarray(depth_m, dtype=np.float32))
    return _encode_image(image, "TIFF", compression="zstd", tiffinfo=tags)


def encode_rgb(rgb: UInt8[ndarray, "h w 3"]) -> bytes:
    """Encode 8-bit colour as lossless WebP."""
    return _encode_image(Image.fromarray(rgb), "WEBP", lossless=True)


def encode_png(image: Bool[ndarray, "h w"] | UInt16[ndarray, "h w"]) -> bytes:
    """Encode a mask as 1-bit PNG, or bar ids as 16-bit greyscale PNG."""
    return _encode_image(Image.fromarray(image), "PNG")


def encode_palette(indices: UInt8[ndarray, "h w"], palette: bytes) -> bytes:
    """Encode colour-mapped values as 8-bit palette PNG; ``palette`` holds up to 256 RGB triples."""
    image = Image.fromarray(indices, mode="L")
    image.putpalette(palette)
    return _encode_image(image, "PNG")


def decode(kind: str, content: bytes, grid: tuple[int, int]) -> ndarray[Any, Any]:
    """Decode the image of a column of ``kind`` and ``grid`` (height, width) to a writable array.

    It is uint8 H x W x 3 for colour and previews, float32 H x W for depth (metres, 0.0 where there is no surface),
    bool H x W for masks and uint16 H x W for bar ids. Raises ``ValueError`` or an error of Pillow, which has no
    base class, for other content.
    """
    return np.asarray(open_picture(kind, content, grid))


def open_picture(kind: str, content: bytes, grid: tuple[int, int]) -> Picture:
    """Decode the image of a column of ``kind`` and ``grid`` (height, width) to the mode of that kind.

    Format, mode and size are checked before the pixels are decoded. Raises ``ValueError`` or an error of Pillow,
    which has no base class, for other content.
    """
    expected, (height, width) = PICTURE_KINDS[kind], grid
    if len(content) > CELL_BYTES.value():
        raise ValueError(f"it has {len(content)} bytes, expected {CELL_BYTES.allowed()}")
    plugin = next((plugin for start, plugin in _plugins().items() if content.startswith(start)), None)
    if plugin is None or plugin.format not in expected.formats:
        raise ValueError(f"it starts with {content[:4]!r}, expected {' or '.join(expected.formats)}")
    with plugin(io.BytesIO(content)) as file:
        if file.size != (width, height):
            raise ValueError(f"its size is {file.size[0]} x {file.size[1]}, expected {width} x {height}")
        if file.mode not in expected.modes:
            raise ValueError(f"its mode is {file.mode}, expected {' or '.join(expected.modes)}")
        if _TIFF_TILE_WIDTH in getattr(file, "tag_v2", ()):
            raise ValueError("it is a TIFF of tiles, whose size is not that of the image, expected strips")
        file.load()
        image: Image.Image = file
        if file.mode != expected.mode:
            is_colour = expected.mode == "RGB"
            image = file.convert("RGB") if is_colour else Image.fromarray(np.asarray(file, expected.dtype))
    if kind == "depth":
        depth_m = np.asarray(image)
        if not (depth_m.min() >= 0 and depth_m.max() < np.inf):
            raise ValueError("it holds negative or non-finite values, expected depth from 0")
    return Picture(image)


@cache
def _plugins() -> Mapping[bytes, type[ImageFile]]:
    """Return Pillow's reader of an image by the first bytes of its content.

    ``Image.open`` would warn of a large image before its size can be compared. The readers are imported on use,
    which scoring with a filled cache does not need.
    """
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile
    from PIL.TiffImagePlugin import TiffImageFile
    from PIL.WebPImagePlugin import WebPImageFile

    tiff, png, webp, jpeg = TiffImageFile, PngImageFile, WebPImageFile, JpegImageFile
    return {b"II": tiff, b"MM": tiff, b"\x89PNG": png, b"RIFF": webp, b"\xff\xd8": jpeg}


def _encode_image(image: Image.Image, image_format: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, image_format, **options)
    return stream.getvalue()
