"""Which files a view becomes, and how each is encoded."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Bool, Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image

_PNG_LEVEL = 1
"""Three times quicker than the usual level 6, a fifth larger (``benchmarks/codecs.py``)."""

_EXR_CHANNEL = "Y"
"""OpenCV reads a lone channel Y or R as it is, and one named Z as zeros without a word."""

MILLIMETRE_M = 0.001
_LARGEST_MM = np.iinfo(np.uint16).max


def colour_png(rgb: UInt8[ndarray, "h w 3"]) -> bytes:
    """Encode 8-bit colour as PNG."""
    return _png(rgb)


def mask_png(mask: Bool[ndarray, "h w"]) -> bytes:
    """Encode a mask as 8-bit grey PNG, 255 where true: every reader of masks knows that."""
    return _png(np.where(mask, np.uint8(255), np.uint8(0)))


def bars_png(bars: UInt16[ndarray, "h w"]) -> bytes:
    """Encode bar ids as 16-bit grey PNG."""
    return _png(bars)


def depth_exr(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth, metres, as an OpenEXR image of one channel, ZIP compressed: no bit changes."""
    stream = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {_EXR_CHANNEL: np.ascontiguousarray(depth_m)}).write(stream)
    return stream.getvalue()


def depth_mm_png(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode planar depth as 16-bit grey PNG in whole millimetres, rounded to the nearest.

    0 where there is no surface, or where it lies further than 65.535 m.
    """
    depth_mm = np.rint(depth_m.astype(np.float64) / MILLIMETRE_M)
    return _png(np.where(depth_mm <= _LARGEST_MM, depth_mm, 0).astype(np.uint16))


@dataclass(frozen=True)
class Picture:
    """One file of an eye: its folder and ending, the column it is made from, and its encoder."""

    folder: str
    suffix: str
    column: str
    encode: Callable[[Any], bytes]

    def path(self, stem: str) -> str:
        """Return the file's path in the config's folder."""
        return f"{self.folder}/{stem}{self.suffix}"


PICTURES: Mapping[str, Picture] = {
    "image": Picture("images", ".png", "rgb", colour_png),
    "depth": Picture("depth", ".exr", "depth", depth_exr),
    "depth_mm": Picture("depth_mm", ".png", "depth", depth_mm_png),
    "mask": Picture("masks", ".png", "mask", mask_png),
    "bars": Picture("bars", ".png", "bars", bars_png),
}
"""What is written of each eye, by the name ``cameras.json`` gives it."""


def _png(pixels: ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=_PNG_LEVEL)
    return stream.getvalue()
