"""Stereo depth from disparity, for rectified and raw image pairs and any matcher."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

MIN_PARALLAX_PX = 1.0
"""Smallest parallax, pixels, that is converted to depth."""
STEREO_COLUMNS = (
    *("left_rgb", "right_rgb", "left_K", "right_K", "left_distortion", "right_distortion"),
    *("left_cam_from_world", "right_cam_from_world", "baseline_m"),
)
"""Dataset columns that stereo methods read."""

Matcher = Callable[[UInt8[ndarray, "h w 3"], UInt8[ndarray, "h w 3"]], Float32[ndarray, "h w"]]
"""Function from rectified left and right RGB images to the left disparity, pixels; <= 0 where there is none."""


def stereo_depth_m(row: Mapping[str, Any], match: Matcher) -> Float32[ndarray, "h w"]:
    """Return planar depth on the left grid, metres, of a row with ``STEREO_COLUMNS``; NaN: no prediction.

    A raw pair is rectified first, and its depth is transferred back to the raw grid (``geometry.rectification``).
    Needs OpenCV.
    """
    from rebar_depth_bench.geometry import rectification

    if rectification.is_rectified(row):
        disparity_px = match(row["left_rgb"], row["right_rgb"])
        return disparity_to_depth_m(disparity_px, row["left_K"], row["right_K"], row["baseline_m"])
    pair = rectification.rectified_pair(row)
    disparity_px = match(pair.left_rgb, pair.right_rgb)
    depth_m = disparity_to_depth_m(disparity_px, pair.K, pair.K, pair.baseline_m)
    depth_m[~rectification.matched_in_right(pair, disparity_px)] = np.nan
    return rectification.raw_depth_m(pair, depth_m)


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
