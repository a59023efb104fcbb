"""The one place where images and depth become bytes and come back, both without loss.

The choices were measured on rendered views (``benchmarks/codecs.py``; the table stands in ARCHITECTURE.md).
"""

from __future__ import annotations

import io

import numpy as np
import OpenEXR
from jaxtyping import Bool, Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image

DEPTH_CHANNEL = "Y"
"""OpenCV reads a channel named Z as zeros without an error; Y it reads right."""


def encode_depth(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth, metres, as a one-channel OpenEXR image."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {DEPTH_CHANNEL: np.ascontiguousarray(depth_m, dtype=np.float32)}
    stream = io.BytesIO()
    OpenEXR.File(header, channels, num_threads=0).write(stream)
    return stream.getvalue()


def decode_depth(content: bytes) -> Float32[ndarray, "h w"]:
    """Decode planar depth, float32 metres, 0.0 where there is no surface."""
    with OpenEXR.File(io.BytesIO(content), separate_channels=True, num_threads=0) as image:
        pixels: Float32[ndarray, "h w"] = image.channels()[DEPTH_CHANNEL].pixels
        return pixels


def encode_rgb(rgb: UInt8[ndarray, "h w 3"]) -> bytes:
    """Encode 8-bit colour as PNG."""
    return _png(Image.fromarray(rgb))


def encode_mask(mask: Bool[ndarray, "h w"]) -> bytes:
    """Encode a mask as 1-bit PNG."""
    return _png(Image.fromarray(mask))


def encode_bars(bars: UInt16[ndarray, "h w"]) -> bytes:
    """Encode bar ids as 16-bit greyscale PNG."""
    return _png(Image.fromarray(bars))


def encode_palette(indices: UInt8[ndarray, "h w"], palette: bytes) -> bytes:
    """Encode colour-mapped values as 8-bit palette PNG; ``palette`` is up to 256 RGB triples."""
    image = Image.fromarray(indices, mode="L")
    image.putpalette(palette)
    return _png(image)


def decode_rgb(content: bytes) -> UInt8[ndarray, "h w 3"]:
    """Decode 8-bit colour."""
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


def _png(image: Image.Image) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()
