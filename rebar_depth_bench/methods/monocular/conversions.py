"""Conversions of network outputs to metres, and resizing and padding of network inputs. Torch is not needed.

Each function follows the network's authors: Metric3D v2 (M. Hu et al., TPAMI 2024; ``hubconf.py`` of its
repository), Depth Anything 3 (H. Lin et al., 2025; ``utils/alignment.py`` and the FAQ of its package 0.1.1),
UniDepth v2 (L. Piccinelli et al., 2025; the key ``depth`` of ``infer``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy import ndarray

METRIC3D_FOCAL_PX = 1000.0
"""Focal length of Metric3D's canonical camera, pixels."""
METRIC3D_MAX_M = 300.0
"""Largest depth that Metric3D returns, metres."""
DA3_FOCAL_PX = 300.0
"""Focal length, pixels, at which the output of Depth Anything 3's metric model is in metres."""


@dataclass(frozen=True)
class Margins:
    """Width of the margins around an image, pixels."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class Letterbox:
    """Placement of an image in a fixed-size network input.

    The image is resized by ``scale`` to ``height_px`` x ``width_px`` and surrounded by ``margins``.
    """

    scale: float
    height_px: int
    width_px: int
    margins: Margins


def fit_letterbox(grid: tuple[int, int], target: tuple[int, int]) -> Letterbox:
    """Return Metric3D's letterboxing of an image of ``grid`` = (H, W) into an input of ``target`` = (h, w) pixels.

    The image is scaled to the largest size that fits (sides rounded down) and centred; an odd pixel of margin goes
    to the bottom or right. Source: ``hubconf.py``.
    """
    scale = min(target[0] / grid[0], target[1] / grid[1])
    height, width = (max(1, int(side * scale)) for side in grid)
    return Letterbox(scale, height, width, _centring_margins(target[0] - height, target[1] - width))


def margins_to_multiple(grid: tuple[int, int], step_px: int) -> Margins:
    """Return the margins that pad (H, W) to multiples of ``step_px``; an odd pixel goes to the bottom or right.

    Both images of a stereo pair get the same margins, so that disparities are unchanged.
    """
    return _centring_margins(-grid[0] % step_px, -grid[1] % step_px)


def _centring_margins(rows: int, columns: int) -> Margins:
    """Return as many margin pixels in total, evenly on both sides; an odd one goes to the bottom or right."""
    return Margins(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


def padded(image: ndarray, margins: Margins, colour: tuple[int, ...] | None = None) -> ndarray:
    """Return an H x W x C image with margins of one colour, or of repeated border pixels if ``colour`` is None."""
    if colour is None:
        widths = ((margins.top, margins.bottom), (margins.left, margins.right), (0, 0))
        return np.pad(image, widths, mode="edge")
    height, width, channels = image.shape
    padded_shape = (height + margins.top + margins.bottom, width + margins.left + margins.right, channels)
    canvas = np.broadcast_to(np.asarray(colour, image.dtype), padded_shape).copy()
    canvas[margins.top : margins.top + height, margins.left : margins.left + width] = image
    return canvas


def crop_margins(values: Any, margins: Margins) -> Any:
    """Return a view of an h x w array or tensor without its margins."""
    height, width = values.shape
    return values[margins.top : height - margins.bottom, margins.left : width - margins.right]


def metric3d_depth_m(
    canonical: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"], scale: float
) -> Float32[ndarray, "h w"]:
    """Return z = canonical * fx * scale / 1000, metres, at most 300 m; NaN where it is not above 0.

    ``K`` (pixels) belongs to the left grid and ``scale`` is the resize factor of the image: fx * scale is the
    focal length of the network's input image. Source: ``hubconf.py`` of Metric3D, "de-canonical transform".
    """
    z_m = canonical.astype(np.float64) * (K[0, 0] * scale / METRIC3D_FOCAL_PX)
    return positive_or_nan(np.clip(z_m, 0, METRIC3D_MAX_M))


def da3_focal_px(K: Float64[ndarray, "3 3"], grid: tuple[int, int], input_grid: tuple[int, int]) -> float:
    """Return the mean of fx and fy, pixels, of the input image of Depth Anything 3.

    ``K`` belongs to the left ``grid`` = (H, W), which was resized to ``input_grid`` = (h, w): long side 504, both
    sides multiples of 14, so that fx and fy differ slightly. Source: ``apply_metric_scaling``.
    """
    return float(K[0, 0] * input_grid[1] / grid[1] + K[1, 1] * input_grid[0] / grid[0]) / 2


def da3_depth_m(values: Float[ndarray, "h w"], focal_px: float) -> Float32[ndarray, "h w"]:
    """Return z = value * focal / 300, metres; NaN where it is not above 0. ``focal_px``: see ``da3_focal_px``."""
    return positive_or_nan(values.astype(np.float64) * (focal_px / DA3_FOCAL_PX))


def positive_or_nan(depth_m: Float[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return depth as float32, with NaN (no prediction) where it is not finite or not above 0."""
    with np.errstate(over="ignore"):
        single = depth_m.astype(np.float32)
    return np.where(np.isfinite(single) & (single > 0), single, np.float32(np.nan))
