"""What depth networks put out, to metres on the left grid; the geometry of their pictures. Nothing needs torch.

Each function follows what the network's authors publish: Metric3D v2 (M. Hu et al., TPAMI 2024; ``hubconf.py`` of
its repository), Depth Anything 3 (H. Lin et al., 2025; ``utils/alignment.py`` and the questions and answers of its
package 0.1.1), UniDepth v2 (L. Piccinelli et al., 2025; the key ``depth`` of ``infer``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy import ndarray

METRIC3D_FOCAL_PX = 1000.0
"""The focal length of Metric3D's canonical camera."""
METRIC3D_MAX_M = 300.0
DA3_FOCAL_PX = 300.0
"""The focal length at which Depth Anything 3's metric model puts out metres."""


@dataclass(frozen=True)
class Margins:
    """Pixels around a picture."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class Fit:
    """A picture in a network's fixed input: resized by ``scale`` to height x width pixels, margins around it."""

    scale: float
    height_px: int
    width_px: int
    margins: Margins


def fit_keeping_ratio(grid: tuple[int, int], target: tuple[int, int]) -> Fit:
    """Return how Metric3D puts a picture of ``grid`` = (H, W) into its input of ``target`` = (h, w) pixels.

    The largest that fits, sides rounded down, in the middle, the odd pixel below and right (``hubconf.py``).
    """
    scale = min(target[0] / grid[0], target[1] / grid[1])
    height, width = (max(1, int(side * scale)) for side in grid)
    high, wide = target[0] - height, target[1] - width
    margins = Margins(top=high // 2, bottom=high - high // 2, left=wide // 2, right=wide - wide // 2)
    return Fit(scale, height, width, margins)


def margins_to_multiple(grid: tuple[int, int], step_px: int) -> Margins:
    """Return the margins that bring (H, W) to multiples of ``step_px``, the odd pixel below and right.

    Both pictures of a pair get the same ones, so that disparities stay what they are.
    """
    high, wide = (-side % step_px for side in grid)
    return Margins(top=high // 2, bottom=high - high // 2, left=wide // 2, right=wide - wide // 2)


def padded(picture: ndarray, margins: Margins, colour: tuple[int, ...] | None = None) -> ndarray:
    """Return an H x W x C picture with margins of one colour, or, without one, of its border pixels repeated."""
    if colour is None:
        return np.pad(picture, _widths(picture, margins), mode="edge")
    height, width, channels = picture.shape
    full = (height + margins.top + margins.bottom, width + margins.left + margins.right, channels)
    canvas = np.broadcast_to(np.asarray(colour, picture.dtype), full).copy()
    canvas[margins.top : margins.top + height, margins.left : margins.left + width] = picture
    return canvas


def without_margins(values: Any, margins: Margins) -> Any:
    """Return an h x w array or tensor without its margins: a view."""
    height, width = values.shape
    return values[margins.top : height - margins.bottom, margins.left : width - margins.right]


def metric3d_depth_m(
    canonical: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"], scale: float
) -> Float32[ndarray, "h w"]:
    """Return z = canonical * fx * scale / 1000, at most 300 m; NaN where that is not above 0.

    ``K``, pixels, belongs to the left grid; ``scale`` is the one the picture was resized by: fx * scale is the
    focal length of the picture that the network saw. Source: ``hubconf.py`` of Metric3D, "de-canonical transform".
    """
    z_m = canonical.astype(np.float64) * (K[0, 0] * scale / METRIC3D_FOCAL_PX)
    return positive_or_nan(np.clip(z_m, 0, METRIC3D_MAX_M))


def da3_focal_px(K: Float64[ndarray, "3 3"], grid: tuple[int, int], seen: tuple[int, int]) -> float:
    """Return the mean of fx and fy, pixels, of the picture that Depth Anything 3 saw.

    ``K`` belongs to the left grid of (H, W) pixels, which was resized to ``seen`` = (h, w): long side 504, both
    sides to multiples of 14, so that fx and fy differ by a little. Source: ``apply_metric_scaling``.
    """
    return float(K[0, 0] * seen[1] / grid[1] + K[1, 1] * seen[0] / grid[0]) / 2


def da3_depth_m(values: Float[ndarray, "h w"], focal_px: float) -> Float32[ndarray, "h w"]:
    """Return z = value * focal / 300, NaN where that is not above 0; ``focal_px`` from ``da3_focal_px``."""
    return positive_or_nan(values.astype(np.float64) * (focal_px / DA3_FOCAL_PX))


def positive_or_nan(depth_m: Float[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return depth as float32, NaN where it is not finite or not above 0: no answer there."""
    with np.errstate(over="ignore"):
        found = depth_m.astype(np.float32)
    return np.where(np.isfinite(found) & (found > 0), found, np.float32(np.nan))


def _widths(picture: ndarray, margins: Margins) -> tuple[tuple[int, int], ...]:
    return (margins.top, margins.bottom), (margins.left, margins.right), *((0, 0),) * (picture.ndim - 2)
