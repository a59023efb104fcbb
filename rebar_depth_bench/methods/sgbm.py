"""Semi-global block matching (SGBM) on the rectified pair, with OpenCV.

A raw pair is rectified first, and its depth is transferred back to the raw grid (``stereo_depth_m``).

Matching: H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", TPAMI 2008, in
OpenCV's 3-way variant. Filter: D. Min et al., "Fast Global Image Smoothing Based on Weighted Least Squares",
TIP 2014, guided by the left image, with left-right consistency as confidence (opencv-contrib ximgproc).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import is_rectified
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor, import_optional

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
RECTIFIED_COLUMNS = frozenset(("left_rgb", "right_rgb", "left_K", "right_K", "right_distortion", "baseline_m"))
"""Columns of a rectified row. The poses of a rectified pair are not among them."""


Matcher = Callable[[Mapping[str, Any]], Float32[ndarray, "h w"]]
"""Function from a rectified row to the disparity of its left image, pixels; <= 0 where there is none.

The match of a pixel must lie inside the right image (``without_invisible``).
"""


def stereo_depth_m(row: Mapping[str, Any], match: Matcher) -> Float32[ndarray, "h w"]:
    """Return planar depth on the left grid, metres, of a row with ``STEREO_COLUMNS``; NaN: no prediction.

    A raw pair is rectified first, and its depth is transferred back to the raw grid (``geometry.rectification``).
    Needs OpenCV.
    """
    from rebar_depth_bench.geometry import rectification

    rectified, pair = rectified_row(row)
    disparity_px = match(rectified)
    depth_m = disparity_to_depth_m(
        disparity_px, rectified["left_K"], rectified["right_K"], rectified["baseline_m"]
    )
    if pair is None:
        return depth_m
    depth_m[~rectification.matched_in_right(pair, disparity_px)] = np.nan
    return rectification.raw_depth_m(pair, depth_m)


def rectified_row(row: Mapping[str, Any]) -> tuple[Mapping[str, Any], RectifiedPair | None]:
    """Return a row with ``STEREO_COLUMNS`` as a rectified row, and the mapping back to its raw left image.

    They are the row itself and None if its images are rectified. Needs OpenCV.
    """
    from rebar_depth_bench.geometry import rectification

    if is_rectified(row):
        return row, None
    pair = rectification.rectified_pair(row)
    return pair_row(pair), pair


def pair_row(pair: RectifiedPair) -> dict[str, Any]:
    """Return the ``RECTIFIED_COLUMNS`` of a rectified pair."""
    return {
        "left_rgb": pair.left_rgb,
        "right_rgb": pair.right_rgb,
        "left_K": pair.K,
        "right_K": pair.K,
        "right_distortion": np.zeros(5),
        "baseline_m": pair.baseline_m,
    }


def largest_disparity_px(rectified: Mapping[str, Any], nearest_m: float | None = None) -> float:
    """Return the largest expected disparity, pixels: that of a surface at ``nearest_m``, at most the image width.

    Without a nearest distance it is ``SEARCH_SHARE_OF_WIDTH`` of the width. No pixel has a match at a disparity
    beyond the width.
    """
    width = rectified["left_rgb"].shape[1]
    if nearest_m is None:
        return float(SEARCH_SHARE_OF_WIDTH * width)
    left_K, right_K = rectified["left_K"], rectified["right_K"]
    parallax_px = left_K[0, 0] * rectified["baseline_m"] / nearest_m
    return float(np.clip(parallax_px + left_K[0, 2] - right_K[0, 2], 0, width))


def without_invisible(disparity_px: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return a disparity with 0 (none) at pixels whose match would lie left of the right image, and for NaN."""
    return np.where(np.arange(disparity_px.shape[1]) >= disparity_px, disparity_px, np.float32(0))


def disparity_to_depth_m(
    disparity_px: Float32[ndarray, "h w"],
    left_K: Float64[ndarray, "3 3"],
    right_K: Float64[ndarray, "3 3"],
    baseline_m: float,
) -> Float32[ndarray, "h w"]:
    """Return z = fx * B / (disparity - (cx_left - cx_right)), metres; NaN if the parallax is below one pixel.

    Such depths are meaningless because an error of half a pixel halves or doubles them.
    """
    parallax_px = disparity_px - (left_K[0, 2] - right_K[0, 2])
    matched = (disparity_px > 0) & (parallax_px >= MIN_PARALLAX_PX)
    depth_m = np.full(disparity_px.shape, np.nan, np.float32)
    depth_m[matched] = left_K[0, 0] * baseline_m / parallax_px[matched]
    return depth_m


BLOCK_PX = 3
SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 96, 600
"""Smoothness penalties P1 and P2 per pixel of a block.

Higher than in OpenCV's examples because bars are repetitive and their background is uniform.
"""
PRE_FILTER_CAP = 63
WLS_LAMBDA = 8000.0
WLS_SIGMA_COLOUR = 2.5
_DISPARITY_SCALE = 16.0
"""OpenCV returns disparities in 1/16 pixel."""
MAX_LEFT_RIGHT_DIFFERENCE_PX = 2.0
"""Largest difference, pixels, of left and right disparities of one point.

A bar and its background differ by far more.
"""


def _load(*, check_consistency: bool) -> Predictor:
    need = "sgbm needs OpenCV with ximgproc, in an environment without opencv-python, which hides it"
    import_optional("cv2.ximgproc", need, "methods")

    def match(rectified: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        left_px, right_px = filtered_disparities_px(rectified["left_rgb"], rectified["right_rgb"])
        if check_consistency:
            left_px = np.where(left_right_consistent(left_px, right_px), left_px, np.float32(0))
        return without_invisible(left_px)

    return partial(stereo_depth_m, match=match)


def left_right_consistent(
    left_px: Float32[ndarray, "h w"], right_px: Float32[ndarray, "h w"]
) -> Bool[ndarray, "h w"]:
    """Return a mask of left pixels whose match has the same disparity up to ``MAX_LEFT_RIGHT_DIFFERENCE_PX``.

    Both arguments are disparities in pixels, <= 0 where there is none. The match of left column x is column
    x - disparity of the right view, rounded.
    """
    width = left_px.shape[1]
    match = np.rint(np.arange(width, dtype=np.float64) - left_px).astype(np.int64)
    matched_px = np.take_along_axis(right_px, np.clip(match, 0, width - 1), axis=1)
    return np.asarray(
        (match >= 0)
        & (match < width)
        & (left_px > 0)
        & (matched_px > 0)
        & (np.abs(left_px - matched_px) <= MAX_LEFT_RIGHT_DIFFERENCE_PX)
    )


def filtered_disparities_px(
    left_rgb: UInt8[ndarray, "h w 3"], right_rgb: UInt8[ndarray, "h w 3"]
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Return the filtered left disparity and the unfiltered right disparity, pixels; <= 0 where there is none.

    OpenCV gives no disparity in the first ``numDisparities`` columns of the left view and in the last ones of the
    right view; both images are therefore padded by as many columns on either side.
    """
    import cv2

    width = left_rgb.shape[1]
    search_px = int(-(-width * SEARCH_SHARE_OF_WIDTH // 16) * 16)
    left, right = (
        cv2.copyMakeBorder(image, 0, 0, search_px, search_px, cv2.BORDER_REPLICATE)
        for image in (left_rgb, right_rgb)
    )
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=search_px,
        blockSize=BLOCK_PX,
        P1=SMALL_STEP_PENALTY * BLOCK_PX**2,
        P2=LARGE_STEP_PENALTY * BLOCK_PX**2,
        preFilterCap=PRE_FILTER_CAP,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    right_matcher = cv2.ximgproc.createRightMatcher(matcher)
    wls = cv2.ximgproc.createDisparityWLSFilter(matcher)
    wls.setLambda(WLS_LAMBDA)
    wls.setSigmaColor(WLS_SIGMA_COLOUR)
    right_disparity = right_matcher.compute(right, left)
    left_disparity = wls.filter(matcher.compute(left, right), left, None, right_disparity)
    scale = np.float32(_DISPARITY_SCALE)
    left_px, right_px = (
        np.asarray(disparity[:, search_px : search_px + width], np.float32) / scale
        for disparity in (left_disparity, right_disparity)
    )
    return left_px, -right_px


SGBM = Method(
    MethodInfo(
        name="sgbm",
        summary=(
            "OpenCV semi-global matching and weighted-least-squares filter on the stereo pair; no prediction "
            "where the two views disagree"
        ),
        columns=STEREO_COLUMNS,
        uses_intrinsics=True,
        source="OpenCV StereoSGBM and ximgproc",
        licence="Apache-2.0",
    ),
    partial(_load, check_consistency=True),
)
SGBM_FILLED = Method(
    replace(
        SGBM.info,
        name="sgbm-filled",
        summary="semi-global matching as sgbm; where the views disagree, the filter fills in",
    ),
    partial(_load, check_consistency=False),
)
