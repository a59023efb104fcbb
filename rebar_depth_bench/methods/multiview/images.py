"""The left views of a config as a multi-view method takes them: pictures on disk, one camera, the markers.

A row's left picture as a pinhole camera would take it, and depth brought back to the row's own grid.

Which pictures to match with which: those that, by the board's markers, are turned little against each other.

A lattice looks nearly the same after a quarter or half a turn. On 24 views of it, 512 x 288, opposite views match
with up to 74 inliers, where neighbours 15 degrees apart have 85 to 177: no count of inliers keeps them apart at
every size, and COLMAP registers views on the wrong side. Markers carry names, which steel does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.data.dataset import ConfigViews
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.aruco_detection import Corners, board_pose, detected_corners_px
from rebar_depth_bench.geometry.cameras import pixel_rays, project
from rebar_depth_bench.geometry.rectification import canvas, resampled
from rebar_depth_bench.methods.multiview.pose_errors import rotation_deg


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


COLUMNS = ("left_rgb", "left_K", "left_distortion", "left_cam_from_world")


@dataclass(frozen=True, eq=False)
class LeftPictures:
    """Pictures in ``folder``, by name; ``names`` gives each view's. The true poses serve the report alone."""

    folder: Path
    names: Mapping[str, str]
    grid: PinholeGrid
    markers: Mapping[str, Corners]
    cam_from_world: Mapping[str, Float64[ndarray, "4 4"]]


def write_pictures(views: ConfigViews, folder: Path) -> LeftPictures:
    """Write every left picture, undistorted where its lens distorts, and find the board's markers in it.

    Raises ``MethodError`` for views that are not all of one camera.
    """
    folder.mkdir(exist_ok=True)
    height, width = views.grid
    grid: PinholeGrid | None = None
    camera: tuple[ndarray, ndarray] | None = None
    names, markers, poses = {}, {}, {}
    for row in views.rows(*COLUMNS):
        mine = (row["left_K"], row["left_distortion"])
        if grid is None or camera is None:
            camera, grid = mine, pinhole_grid(row, width, height)
        if not all(np.array_equal(a, b) for a, b in zip(camera, mine, strict=True)):
            raise MethodError(
                f"{row['view_id']}: another K or distortion than the view before, expected one camera"
            )
        name = names[row["view_id"]] = row["view_id"].rpartition("/")[2] + ".png"
        rgb = pinhole_picture(row, grid)
        if not cv2.imwrite(str(folder / name), rgb[..., ::-1]):
            raise MethodError(f"{folder / name}: cannot be written")
        markers[name] = detected_corners_px(rgb, views.board.dictionary) if views.board else {}
        poses[name] = row["left_cam_from_world"]
    if grid is None:
        raise MethodError(f"{views.config}: no view, expected three or more")
    return LeftPictures(folder, names, grid, markers, poses)


MOST_TURNED_DEG = 60.0


def plausible_pairs(
    markers: Mapping[str, Corners], board: BoardSpec, K: Float64[ndarray, "3 3"]
) -> list[tuple[str, str]]:
    """Return the pairs of pictures (pinhole, K in pixels) to match; a picture without markers goes with all."""
    poses = {name: board_pose(found, board, K) for name, found in markers.items()}
    kept = []
    for one, other in combinations(sorted(markers), 2):
        first, second = poses[one], poses[other]
        if first is None or second is None or rotation_deg(second[:3, :3] @ first[:3, :3].T) <= MOST_TURNED_DEG:
            kept.append((one, other))
    return kept
