"""The rectified pair of a calibrated stereo camera, as OpenCV computes it. Scoring never comes here.

A pair on the raw grid for methods that want it rectified, and their depth brought back to the raw left grid.

Nothing is invented on the way back: each raw pixel takes the one rectified pixel its ray falls on, and depth
along the rectified axis becomes depth along the raw one by that ray.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import inverse_rigid, pixel_rays, project
from rebar_depth_bench.geometry.stereo_calibration import (
    StereoCalibration,
    calibrated_baseline_m,
    lens_distortion,
    lens_K,
    right_from_left,
)


@dataclass(frozen=True, eq=False)
class Rectification:
    """Two parallel pinholes that stand where the eyes stand.

    ``K`` (pixels) is both eyes'; ``R_left`` and ``R_right`` turn an eye's own axes into the rectified ones,
    ``x_rectified = R x_eye``; the right eye then stands ``baseline_m`` along the rectified x axis.
    """

    K: Float64[ndarray, "3 3"]
    R_left: Float64[ndarray, "3 3"]
    R_right: Float64[ndarray, "3 3"]
    baseline_m: float


def rectify(calibration: StereoCalibration) -> Rectification:
    """Return the rectification on the calibration's own grid.

    ``cv2.stereoRectify`` with zero disparity at infinity and ``alpha=0``, which leaves no pixel outside the raw
    pictures: what Stereolabs' open capture code calls. (Bouguet's method: each eye turns by half.)
    """
    motion = right_from_left(calibration)
    return rectify_pair(
        (lens_K(calibration.left), lens_K(calibration.right)),
        (lens_distortion(calibration.left), lens_distortion(calibration.right)),
        motion,
        calibration.width,
        calibration.height,
        calibrated_baseline_m(calibration),
    )


def rectify_pair(
    K: tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]],
    distortion: tuple[Float64[ndarray, 5], Float64[ndarray, 5]],
    right_from_left: Float64[ndarray, "4 4"],
    width: int,
    height: int,
    baseline_m: float,
) -> Rectification:
    """Return the rectification of two eyes (left, right) given as a dataset row gives them, metres and pixels."""
    R_left, R_right, P_left, *_ = cv2.stereoRectify(
        K[0],
        distortion[0],
        K[1],
        distortion[1],
        (width, height),
        np.ascontiguousarray(right_from_left[:3, :3]),
        np.ascontiguousarray(right_from_left[:3, 3]),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    return Rectification(np.asarray(P_left[:, :3]), np.asarray(R_left), np.asarray(R_right), baseline_m)


PARALLEL_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """A rectified pair, and the way back to the raw left grid.

    Both pictures have the pinhole ``K`` (pixels) and lie on one canvas, wide enough for every raw pixel of both
    eyes. ``seen_by_right`` tells which pixels of the canvas the raw right picture shows. ``pixel`` is the canvas
    pixel (column, row) that each raw left pixel's ray falls on, ``depth_ratio`` raw depth over rectified depth.
    """

    left_rgb: UInt8[ndarray, "hc wc 3"]
    right_rgb: UInt8[ndarray, "hc wc 3"]
    K: Float64[ndarray, "3 3"]
    baseline_m: float
    seen_by_right: Bool[ndarray, "hc wc"]
    pixel: Int64[ndarray, "h w 2"]
    depth_ratio: Float64[ndarray, "h w"]


def is_rectified(row: Mapping[str, Any]) -> bool:
    """Tell whether a row's eyes are parallel pinholes, the right one on the left one's x axis."""
    parallel = np.eye(4)
    parallel[0, 3] = -row["baseline_m"]
    straight = not (row["left_distortion"].any() or row["right_distortion"].any())
    return straight and bool(np.abs(_right_from_left(row) - parallel).max() <= PARALLEL_TOLERANCE)


def rectified_pair(row: Mapping[str, Any]) -> RectifiedPair:
    """Rectify a dataset row's pair with its own K, distortion and poses (``rectification.rectify_pair``).

    Raises ``ValueError`` in words for a lens model that cannot be inverted.
    """
    height, width, _ = row["left_rgb"].shape
    Ks, distortions = (row["left_K"], row["right_K"]), (row["left_distortion"], row["right_distortion"])
    rectified = rectify_pair(Ks, distortions, _right_from_left(row), width, height, row["baseline_m"])
    rays = [
        pixel_rays(K, width, height, distortion) @ rotation.T
        for K, distortion, rotation in zip(Ks, distortions, _rotations(rectified), strict=True)
    ]
    K, size = canvas(rectified.K, [project(rectified.K, eye) for eye in rays])
    left, right = (
        cv2.initUndistortRectifyMap(*eye, K, size, cv2.CV_32FC1)
        for eye in zip(Ks, distortions, _rotations(rectified), strict=True)
    )
    return RectifiedPair(
        left_rgb=resampled(row["left_rgb"], left),
        right_rgb=resampled(row["right_rgb"], right),
        K=K,
        baseline_m=rectified.baseline_m,
        seen_by_right=(np.abs(right[0] - (width - 1) / 2) <= width / 2)
        & (np.abs(right[1] - (height - 1) / 2) <= height / 2),
        pixel=np.rint(project(K, rays[0])).astype(np.int64),
        depth_ratio=1.0 / rays[0][..., 2],
    )


def raw_depth_m(pair: RectifiedPair, rectified_depth_m: Float32[ndarray, "hc wc"]) -> Float32[ndarray, "h w"]:
    """Return the raw left grid's planar depth from the rectified left picture's; NaN stays NaN."""
    column, row = np.moveaxis(pair.pixel, -1, 0)
    return np.asarray(rectified_depth_m[row, column] * pair.depth_ratio, dtype=np.float32)


def matched_in_right(pair: RectifiedPair, disparity_px: Float32[ndarray, "hc wc"]) -> Bool[ndarray, "hc wc"]:
    """Tell which pixels of the rectified left picture have their match inside the raw right picture."""
    rows, columns = np.indices(disparity_px.shape)
    match = np.rint(columns - np.nan_to_num(disparity_px)).astype(np.int64)
    on_canvas = (match >= 0) & (match < disparity_px.shape[1])
    return np.asarray(on_canvas & pair.seen_by_right[rows, np.where(on_canvas, match, 0)])


def _right_from_left(row: Mapping[str, Any]) -> Float64[ndarray, "4 4"]:
    return np.asarray(row["right_cam_from_world"] @ inverse_rigid(row["left_cam_from_world"]))


def _rotations(rectified: Rectification) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]:
    return rectified.R_left, rectified.R_right


def canvas(
    K: Float64[ndarray, "3 3"], places_px: list[Float64[ndarray, "h w 2"]]
) -> tuple[Float64[ndarray, "3 3"], tuple[int, int]]:
    """Return K moved by whole pixels, and the width and height, so that all places lie on the canvas."""
    low = np.floor(np.min([eye.min(axis=(0, 1)) for eye in places_px], axis=0)).astype(int)
    high = np.ceil(np.max([eye.max(axis=(0, 1)) for eye in places_px], axis=0)).astype(int)
    moved = K.copy()
    moved[:2, 2] -= low
    width, height = (high - low + 1).tolist()
    return moved, (width, height)


def resampled(rgb: UInt8[ndarray, "h w 3"], maps: Any) -> UInt8[ndarray, "hc wc 3"]:
    """Return a picture on another grid, bicubic, by OpenCV's two maps."""
    map_x, map_y = maps
    return np.asarray(cv2.remap(rgb, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
