"""Semi-global block matching on the rectified pair, with OpenCV.

A raw pair is rectified first and its depth brought back to the raw grid (``raw_stereo``).

Matching: H. Hirschmueller, "Stereo Processing by Semiglobal Matching and Mutual Information", TPAMI 2008, in
OpenCV's 3-way variant. Filter: D. Min et al., "Fast Global Image Smoothing Based on Weighted Least Squares",
TIP 2014, guided by the left picture, with left-right consistency as confidence (opencv-contrib ximgproc).
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.stereo.disparity import STEREO_COLUMNS, stereo_depth_m

BLOCK_PX = 3
SEARCH_SHARE_OF_WIDTH = 0.5
"""Disparities from 0 to this share of the width are searched: any distance from 0.13 m on, for the ideal rig."""
SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 96, 600
"""Per pixel of a block: higher than OpenCV's examples, for bars repeat and their background is plain."""
PRE_FILTER_CAP = 63
WLS_LAMBDA = 8000.0
WLS_SIGMA_COLOUR = 2.5
_FIXED_POINT = 16.0
AGREEMENT_PX = 2.0
"""Left and right disparities of one point are the same to this; a bar and what is behind it differ by far more."""


def _loader(*, checked: bool) -> Callable[[], Predictor]:
    def load() -> Predictor:
        try:
            import cv2
            import cv2.ximgproc
        except ImportError as error:
            raise MethodError(
                f"sgbm needs OpenCV with ximgproc ({error}): pip install 'rebar-depth-bench[methods]'"
            ) from None
        return lambda row: stereo_depth_m(row, lambda left, right: _disparity_px(cv2, left, right, checked))

    return load


def _disparity_px(
    cv2: ModuleType, left_rgb: UInt8[ndarray, "h w 3"], right_rgb: UInt8[ndarray, "h w 3"], checked: bool
) -> Float32[ndarray, "h w"]:
    """Return the left view's disparity, pixels; <= 0 where there is none, or none that the right view confirms."""
    left_px, right_px = filtered_disparities_px(cv2, left_rgb, right_rgb)
    return np.where(confirmed(left_px, right_px), left_px, np.float32(0)) if checked else left_px


def confirmed(left_px: Float32[ndarray, "h w"], right_px: Float32[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Tell where the right view's disparity at a left pixel's match is the same to ``AGREEMENT_PX``.

    Both are disparities in pixels, the match of left column x is x - disparity, rounded; <= 0 means none.
    """
    width = left_px.shape[1]
    match = np.rint(np.arange(width, dtype=np.float64) - left_px).astype(np.int64)
    found_px = np.take_along_axis(right_px, np.clip(match, 0, width - 1), axis=1)
    return np.asarray(
        (match >= 0)
        & (match < width)
        & (left_px > 0)
        & (found_px > 0)
        & (np.abs(left_px - found_px) <= AGREEMENT_PX)
    )


def filtered_disparities_px(
    cv2: ModuleType, left_rgb: UInt8[ndarray, "h w 3"], right_rgb: UInt8[ndarray, "h w 3"]
) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Return the left view's disparity, filtered, and the right view's, as matched; pixels, <= 0 where none.

    OpenCV answers only right of ``numDisparities`` columns, and for the right view only left of as many: both
    pictures are padded by them on either side.
    """
    width = left_rgb.shape[1]
    search_px = int(-(-width * SEARCH_SHARE_OF_WIDTH // 16) * 16)
    left, right = (
        cv2.copyMakeBorder(picture, 0, 0, search_px, search_px, cv2.BORDER_REPLICATE)
        for picture in (left_rgb, right_rgb)
    )
    matcher = cv2.StereoSGBM_create(
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
    of_right = right_matcher.compute(right, left)
    of_left = wls.filter(matcher.compute(left, right), left, None, of_right)
    scale = np.float32(_FIXED_POINT)
    left_px, right_px = (
        np.asarray(one[:, search_px : search_px + width], np.float32) / scale for one in (of_left, of_right)
    )
    return left_px, -right_px


def _method(name: str, summary: str, *, checked: bool) -> Method:
    info = MethodInfo(
        name=name,
        summary=summary,
        columns=STEREO_COLUMNS,
        uses_intrinsics=True,
        source="OpenCV StereoSGBM and ximgproc",
        licence="Apache-2.0",
    )
    return Method(info, _loader(checked=checked))


SGBM = _method(
    "sgbm",
    "OpenCV semi-global matching and weighted-least-squares filter on the stereo pair; no answer where the "
    "two views disagree",
    checked=True,
)
SGBM_FILLED = _method(
    "sgbm-filled",
    "the same, with an answer everywhere: where the views disagree the filter fills in",
    checked=False,
)
