"""Stereo depth from disparity, for rectified and raw image pairs and any matcher."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

if TYPE_CHECKING:
    from rebar_depth_bench.geometry.rectification import RectifiedPair

MIN_PARALLAX_PX = 1.0
"""Smallest parallax, pixels, that is converted to depth."""
SEARCH_SHARE_OF_WIDTH = 0.5
"""Largest expected disparity as a fraction of the image width; for the ideal rig: all distances from 0.13 m."""
STEREO_COLUMNS = (
    *("left_rgb", "right_rgb", "left_K", "right_K", "left_distortion", "right_distortion"),
    *("left_cam_from_world", "right_cam_from_world", "baseline_m"),
)
"""Dataset columns that stereo methods read."""


@dataclass(frozen=True, eq=False)
class StereoImages:
    """Rectified left and right RGB images of the same size, with their pinhole matrices (pixels) and baseline."""

    left_rgb: UInt8[ndarray, "h w 3"]
    right_rgb: UInt8[ndarray, "h w 3"]
    K_left: Float64[ndarray, "3 3"]
    K_right: Float64[ndarray, "3 3"]
    baseline_m: float


Matcher = Callable[[StereoImages], Float32[ndarray, "h w"]]
"""Function from rectified images to the disparity of the left one, pixels; <= 0 where there is none."""


def stereo_depth_m(row: Mapping[str, Any], match: Matcher) -> Float32[ndarray, "h w"]:
    """Return planar depth on the left grid, metres, of a row with ``STEREO_COLUMNS``; NaN: no prediction.

    A raw pair is rectified first, and its depth is transferred back to the raw grid (``geometry.rectification``).
    Needs OpenCV.
    """
    from rebar_depth_bench.geometry import rectification

    images, pair = rectified_images(row)
    disparity_px = match(images)
    depth_m = disparity_to_depth_m(disparity_px, images.K_left, images.K_right, images.baseline_m)
    if pair is None:
        return depth_m
    depth_m[~rectification.matched_in_right(pair, disparity_px)] = np.nan
    return rectification.raw_depth_m(pair, depth_m)


def rectified_images(row: Mapping[str, Any]) -> tuple[StereoImages, RectifiedPair | None]:
    """Return the rectified images of a row with ``STEREO_COLUMNS``, and the mapping back to a raw left image.

    The mapping is None if the row's own images are rectified. Needs OpenCV.
    """
    from rebar_depth_bench.geometry import rectification

    if rectification.is_rectified(row):
        names = ("left_rgb", "right_rgb", "left_K", "right_K", "baseline_m")
        return StereoImages(*(row[name] for name in names)), None
    pair = rectification.rectified_pair(row)
    return StereoImages(pair.left_rgb, pair.right_rgb, pair.K, pair.K, pair.baseline_m), pair


def largest_disparity_px(images: StereoImages, nearest_m: float | None = None) -> float:
    """Return the largest expected disparity, pixels: that of a surface at ``nearest_m``, at most the image width.

    Without a nearest distance it is ``SEARCH_SHARE_OF_WIDTH`` of the width. No pixel has a match at a disparity
    beyond the width.
    """
    width = images.left_rgb.shape[1]
    if nearest_m is None:
        return SEARCH_SHARE_OF_WIDTH * width
    parallax_px = images.K_left[0, 0] * images.baseline_m / nearest_m
    return float(np.clip(parallax_px + images.K_left[0, 2] - images.K_right[0, 2], 0, width))


def disparity_to_depth_m(
    disparity_px: Float32[ndarray, "h w"],
    left_K: Float64[ndarray, "3 3"],
    right_K: Float64[ndarray, "3 3"],
    baseline_m: float,
) -> Float32[ndarray, "h w"]:
    """Return z = fx * B / (disparity - (cx_left - cx_right)), metres; NaN if the parallax is below one pixel.

    Such depths are meaningless because an error of half a pixel halves or doubles them. Pixels whose match would
    lie outside the right image on the left are NaN as well.
    """
    columns = np.arange(disparity_px.shape[1], dtype=np.float64)
    parallax_px = disparity_px - (left_K[0, 2] - right_K[0, 2])
    matched = (disparity_px > 0) & (parallax_px >= MIN_PARALLAX_PX) & (columns - disparity_px >= 0)
    depth_m = np.full(disparity_px.shape, np.nan, np.float32)
    depth_m[matched] = left_K[0, 0] * baseline_m / parallax_px[matched]
    return depth_m
