"""Lossless codecs of the dataset's images and depth maps.

The formats were chosen by measurements on rendered views (``benchmarks/codecs.py``; table in ARCHITECTURE.md).
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image

_TIFF_PREDICTOR, _FLOATING_POINT = 317, 3
_TIFF_ROWS_PER_STRIP = 278


def encode_depth(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth in metres as TIFF: floating-point predictor, zstd, one strip."""
    tags = {_TIFF_PREDICTOR: _FLOATING_POINT, _TIFF_ROWS_PER_STRIP: depth_m.shape[0]}
    image = Image.fromarray(np.ascontiguousarray(depth_m, dtype=np.float32))
    return _encode_image(image, "TIFF", compression="zstd", tiffinfo=tags)


def decode_depth(content: bytes) -> Float32[ndarray, "h w"]:
    """Decode planar depth: float32, metres, 0.0 where there is no surface."""
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image, dtype=np.float32)


def encode_rgb(rgb: UInt8[ndarray, "h w 3"]) -> bytes:
    """Encode 8-bit colour as lossless WebP."""
    return _encode_image(Image.fromarray(rgb), "WEBP", lossless=True)


def encode_mask(mask: Bool[ndarray, "h w"]) -> bytes:
    """Encode a mask as 1-bit PNG."""
    return _encode_image(Image.fromarray(mask), "PNG")


def encode_bars(bars: UInt16[ndarray, "h w"]) -> bytes:
    """Encode bar ids as 16-bit greyscale PNG."""
    return _encode_image(Image.fromarray(bars), "PNG")


def encode_palette(indices: UInt8[ndarray, "h w"], palette: bytes) -> bytes:
    """Encode colour-mapped values as 8-bit palette PNG; ``palette`` holds up to 256 RGB triples."""
    image = Image.fromarray(indices, mode="L")
    image.putpalette(palette)
    return _encode_image(image, "PNG")


def decode_rgb(content: bytes) -> UInt8[ndarray, "h w 3"]:
    """Decode an 8-bit RGB image."""
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB") if image.mode != "RGB" else image)


def decode_mask(content: bytes) -> Bool[ndarray, "h w"]:
    """Decode a 1-bit mask."""
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image, dtype=bool)


def decode_bars(content: bytes) -> UInt16[ndarray, "h w"]:
    """Decode 16-bit bar ids."""
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image, dtype=np.uint16)


def _encode_image(image: Image.Image, image_format: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, image_format, **options)
    return stream.getvalue()
