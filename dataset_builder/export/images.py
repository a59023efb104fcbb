"""Exported image files of a view and their encoders."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Bool, Float32
from numpy import ndarray
from PIL import Image

_PNG_LEVEL = 1
"""Compression level: three times faster than the default 6, files a fifth larger (``benchmarks/codecs.py``)."""

_EXR_CHANNEL = "Y"
"""Channel name: OpenCV reads a single channel Y or R correctly, but one named Z silently as zeros."""

MILLIMETRE_M = 0.001
"""One millimetre in metres."""

_LARGEST_MM = np.iinfo(np.uint16).max
"""Largest depth that a 16-bit PNG can store, millimetres."""


def plain_png(pixels: ndarray) -> bytes:
    """Encode 8-bit colour, 8-bit grey or 16-bit grey pixels as PNG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=_PNG_LEVEL)
    return stream.getvalue()


def mask_png(mask: Bool[ndarray, "h w"]) -> bytes:
    """Encode a mask as 8-bit grey PNG, 255 where true, which all common mask readers accept."""
    return plain_png(np.where(mask, np.uint8(255), np.uint8(0)))


def depth_exr(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth, metres, as a single-channel OpenEXR image, losslessly (ZIP compression)."""
    stream = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {_EXR_CHANNEL: np.ascontiguousarray(depth_m)}).write(stream)
    return stream.getvalue()


def depth_mm_png(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode planar depth as 16-bit grey PNG in whole millimetres, rounded to the nearest.

    0 where there is no surface, or where it is farther than 65.535 m.
    """
    depth_mm = np.rint(depth_m.astype(np.float64) / MILLIMETRE_M)
    return plain_png(np.where(depth_mm <= _LARGEST_MM, depth_mm, 0).astype(np.uint16))


@dataclass(frozen=True)
class ExportFile:
    """One file per eye of a view: its folder and suffix, the dataset column it contains, and its encoder."""

    folder: str
    suffix: str
    column: str
    encode: Callable[[Any], bytes]

    def path(self, stem: str) -> str:
        """Return the path of the file in the config's folder."""
        return f"{self.folder}/{stem}{self.suffix}"


EXPORT_FILES: Mapping[str, ExportFile] = {
    "image": ExportFile("images", ".png", "rgb", plain_png),
    "depth": ExportFile("depth", ".exr", "depth", depth_exr),
    "depth_mm": ExportFile("depth_mm", ".png", "depth", depth_mm_png),
    "mask": ExportFile("masks", ".png", "mask", mask_png),
    "bars": ExportFile("bars", ".png", "bars", plain_png),
}
"""Files exported for each eye, by their key in ``cameras.json``."""
