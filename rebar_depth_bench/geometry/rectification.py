"""Stereo rectification with OpenCV, and transfer of depth from the rectified to the raw left image.

Methods that need a rectified pair use it on raw (distorted) images; scoring does not. Depth is transferred without
interpolation: each raw pixel takes the value of the rectified pixel nearest to its ray, and depth along the
rectified optical axis is converted to depth along the raw optical axis with that ray.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import pixel_rays, project, right_from_left


def rectify(
    K: Sequence[Float64[ndarray, "3 3"]],
    distortion: Sequence[Float64[ndarray, 5]],
    right_from_left: Float64[ndarray, "4 4"],
    width: int,
    height: int,
) -> tuple[Float64[ndarray, "3 3"], tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]]:
    """Return K (pixels) of two parallel pinhole cameras at the centres of a pair, and the rotations to their axes.

    ``K`` and ``distortion`` are those of the left and the right camera. Each rotation is that of
    ``x_rectified = R x_cam``; the right rectified camera is along the x axis of the left one. Calls
    ``cv2.stereoRectify`` with zero disparity at infinity and ``alpha=0``, which leaves no pixel outside the raw
    images, as Stereolabs' open capture code does. (Bouguet's method: each camera is rotated by half.)
    """
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
    return np.asarray(P_left[:, :3]), (np.asarray(R_left), np.asarray(R_right))


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Rectified image pair, with the mapping back to the raw left image.

    Both images have the pinhole matrix ``K`` (pixels) and the same canvas, large enough for every raw pixel of
    both cameras. ``seen_by_right`` marks the canvas pixels that the raw right image covers. ``pixel`` is the
    canvas pixel (column, row) nearest to the ray of each raw left pixel, ``depth_ratio`` the raw depth divided by
    the rectified depth.
    """

    left_rgb: UInt8[ndarray, "hc wc 3"]
    right_rgb: UInt8[ndarray, "hc wc 3"]
    K: Float64[ndarray, "3 3"]
    baseline_m: float
    seen_by_right: Bool[ndarray, "hc wc"]
    pixel: Int64[ndarray, "h w 2"]
    depth_ratio: Float64[ndarray, "h w"]


def rectified_pair(row: Mapping[str, Any]) -> RectifiedPair:
    """Rectify the image pair of a dataset row with its K, distortion and poses (``rectify``).

    Raises ``ValueError`` if a distortion model cannot be inverted.
    """
    height, width, _ = row["left_rgb"].shape
    Ks, distortions = (row["left_K"], row["right_K"]), (row["left_distortion"], row["right_distortion"])
    rectified_K, rotations = rectify(Ks, distortions, right_from_left(row), width, height)
    rays = [
        pixel_rays(K, width, height, distortion) @ rotation.T
        for K, distortion, rotation in zip(Ks, distortions, rotations, strict=True)
    ]
    K, size = enclosing_canvas(rectified_K, [project(rectified_K, eye) for eye in rays])
    left, right = (
        cv2.initUndistortRectifyMap(*eye, K, size, cv2.CV_32FC1)
        for eye in zip(Ks, distortions, rotations, strict=True)
    )
    return RectifiedPair(
        left_rgb=resample(row["left_rgb"], left),
        right_rgb=resample(row["right_rgb"], right),
        K=K,
        baseline_m=row["baseline_m"],
        seen_by_right=(np.abs(right[0] - (width - 1) / 2) <= width / 2)
        & (np.abs(right[1] - (height - 1) / 2) <= height / 2),
        pixel=np.rint(project(K, rays[0])).astype(np.int64),
        depth_ratio=1.0 / rays[0][..., 2],
    )


def raw_depth_m(pair: RectifiedPair, rectified_depth_m: Float32[ndarray, "hc wc"]) -> Float32[ndarray, "h w"]:
    """Convert planar depth of the rectified left image to that of the raw left image; NaN is preserved."""
    column, row = np.moveaxis(pair.pixel, -1, 0)
    return np.asarray(rectified_depth_m[row, column] * pair.depth_ratio, dtype=np.float32)


def matched_in_right(pair: RectifiedPair, disparity_px: Float32[ndarray, "hc wc"]) -> Bool[ndarray, "hc wc"]:
    """Return a mask of the rectified left pixels whose match lies inside the raw right image."""
    rows, columns = np.indices(disparity_px.shape)
    match = np.rint(columns - np.nan_to_num(disparity_px)).astype(np.int64)
    on_canvas = (match >= 0) & (match < disparity_px.shape[1])
    return np.asarray(on_canvas & pair.seen_by_right[rows, np.where(on_canvas, match, 0)])


def enclosing_canvas(
    K: Float64[ndarray, "3 3"], points_px: list[Float64[ndarray, "h w 2"]]
) -> tuple[Float64[ndarray, "3 3"], tuple[int, int]]:
    """Return K shifted by whole pixels and the (width, height) of the smallest canvas that holds all points."""
    low = np.floor(np.min([eye.min(axis=(0, 1)) for eye in points_px], axis=0)).astype(int)
    high = np.ceil(np.max([eye.max(axis=(0, 1)) for eye in points_px], axis=0)).astype(int)
    shifted_K = K.copy()
    shifted_K[:2, 2] -= low
    width, height = (high - low + 1).tolist()
    return shifted_K, (width, height)


def resample(rgb: UInt8[ndarray, "h w 3"], maps: Any) -> UInt8[ndarray, "hc wc 3"]:
    """Resample an image with OpenCV's two coordinate maps; bicubic, border pixels replicated."""
    map_x, map_y = maps
    return np.asarray(cv2.remap(rgb, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


# Undistorted images of one camera, and transfer of depth back to the grid of its distorted image.


@dataclass(frozen=True, eq=False)
class PinholeGrid:
    """Pinhole image grid that contains every pixel of a camera; without distortion, the camera's own grid.

    ``canvas_pixel`` is the pixel (column, row) of this grid for each pixel of the camera, None if both grids are
    the same. The optical axis is that of the camera, so planar depth is unchanged.
    """

    K: Float64[ndarray, "3 3"]
    width: int
    height: int
    canvas_pixel: Int64[ndarray, "h w 2"] | None

    def depth_on_left_grid(self, depth: Float32[ndarray, "hc wc"]) -> Float32[ndarray, "h w"]:
        """Return planar depth (any unit) on the camera's grid, sampled at the pixel that each ray falls on."""
        if self.canvas_pixel is None:
            return depth
        column, row = np.moveaxis(self.canvas_pixel, -1, 0)
        return np.asarray(depth[row, column])


def pinhole_grid(row: Mapping[str, Any], width: int, height: int) -> PinholeGrid:
    """Return the pinhole grid of a row's ``width`` x ``height`` left camera (``left_K``, ``left_distortion``)."""
    K, distortion = row["left_K"], row["left_distortion"]
    if not distortion.any():
        return PinholeGrid(K, width, height, None)
    rays = pixel_rays(K, width, height, distortion)
    wide_K, (wide_width, wide_height) = enclosing_canvas(K, [project(K, rays)])
    return PinholeGrid(wide_K, wide_width, wide_height, np.rint(project(wide_K, rays)).astype(np.int64))


def pinhole_image(row: Mapping[str, Any], grid: PinholeGrid) -> UInt8[ndarray, "hc wc 3"]:
    """Return a row's left image on its pinhole grid, resampled (bicubic) if the lens has distortion."""
    if grid.canvas_pixel is None:
        return np.asarray(row["left_rgb"])
    maps = cv2.initUndistortRectifyMap(
        row["left_K"], row["left_distortion"], np.eye(3), grid.K, (grid.width, grid.height), cv2.CV_32FC1
    )
    return resample(row["left_rgb"], maps)
