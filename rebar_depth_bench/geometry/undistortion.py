"""Undistorted images of one camera, and transfer of depth back to the grid of its distorted image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import pixel_rays, project
from rebar_depth_bench.geometry.rectification import enclosing_canvas, resample


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
