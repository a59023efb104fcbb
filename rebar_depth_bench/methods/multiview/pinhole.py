"""A row's left picture as a pinhole camera would take it, and depth brought back to the row's own grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.cameras import pixel_rays, project
from rebar_depth_bench.raw_stereo import canvas, resampled


@dataclass(frozen=True, eq=False)
class PinholeGrid:
    """A pinhole canvas that holds every pixel of a camera's grid; without distortion, that grid itself.

    ``pixel`` is the canvas pixel (column, row) that each of the camera's pixels falls on, None where they are the
    same. The optical axis is the camera's: planar depth stays what it is.
    """

    K: Float64[ndarray, "3 3"]
    width: int
    height: int
    pixel: Int64[ndarray, "h w 2"] | None

    def depth_on_left_grid(self, depth: Float32[ndarray, "hc wc"]) -> Float32[ndarray, "h w"]:
        """Return planar depth, in any unit, on the camera's grid: each pixel takes the pixel its ray falls on."""
        if self.pixel is None:
            return depth
        column, row = np.moveaxis(self.pixel, -1, 0)
        return np.asarray(depth[row, column])


def pinhole_grid(row: Mapping[str, Any], width: int, height: int) -> PinholeGrid:
    """Return the canvas of a row's left camera (``left_K``, ``left_distortion``), whose grid is width x height."""
    K, distortion = row["left_K"], row["left_distortion"]
    if not distortion.any():
        return PinholeGrid(K, width, height, None)
    rays = pixel_rays(K, width, height, distortion)
    wide_K, (wide_width, wide_height) = canvas(K, [project(K, rays)])
    return PinholeGrid(wide_K, wide_width, wide_height, np.rint(project(wide_K, rays)).astype(np.int64))


def pinhole_picture(row: Mapping[str, Any], grid: PinholeGrid) -> UInt8[ndarray, "hc wc 3"]:
    """Return a row's left picture on its canvas, resampled (bicubic) where the lens distorts."""
    if grid.pixel is None:
        return np.asarray(row["left_rgb"])
    maps = cv2.initUndistortRectifyMap(
        row["left_K"], row["left_distortion"], np.eye(3), grid.K, (grid.width, grid.height), cv2.CV_32FC1
    )
    return resampled(row["left_rgb"], maps)
