"""Undistorted left images of a config on disk, their markers, and the selection of image pairs to match.

All images are resampled to one pinhole camera; depth on its grid is transferred back to the grid of the left
camera.

Image pairs are matched only if their relative rotation, measured with the markers of the board, is small. A
lattice looks nearly the same after a quarter or half turn. On 24 views of it (512 x 288), opposite views match
with up to 74 inliers, while neighbours 15 degrees apart have 85 to 177: no threshold on inliers separates them at
every image size, and COLMAP registers views on the wrong side. Unlike steel, markers have unique ids.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.atomic_io import write_bytes
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.aruco_detection import Corners, board_pose, detected_corners_px
from rebar_depth_bench.geometry.undistortion import PinholeGrid, pinhole_grid, pinhole_image
from rebar_depth_bench.methods.multiview.pose_errors import rotation_angle_deg


def row_columns(views: Views) -> tuple[str, ...]:
    """Return the columns that are read; the poses, where there are any, serve only for error reports."""
    columns = ("left_rgb", "left_K", "left_distortion")
    return (*columns, "left_cam_from_world") if views.has_poses else columns


@dataclass(frozen=True, eq=False)
class LeftImages:
    """Undistorted images in ``folder``, with the pinhole grid that they share.

    ``names`` maps view ids to image names; ``markers`` and ``cam_from_world`` are keyed by image name. The true
    poses are used only for error reports; there are none of captures without poses.
    """

    folder: Path
    names: Mapping[str, str]
    grid: PinholeGrid
    markers: Mapping[str, Corners]
    cam_from_world: Mapping[str, Float64[ndarray, "4 4"]]


def write_left_images(views: Views, folder: Path) -> LeftImages:
    """Write all left images, undistorted if the lens has distortion, and detect the markers of the board.

    Raises ``MethodError`` if the views differ in K or distortion or if there are none, and ``OutputError`` if an
    image cannot be written.
    """
    folder.mkdir(exist_ok=True)
    height, width = views.grid
    grid: PinholeGrid | None = None
    camera: tuple[ndarray, ndarray] | None = None
    names, markers, poses = {}, {}, {}
    for row in views.rows(*row_columns(views)):
        row_camera = (row["left_K"], row["left_distortion"])
        if grid is None or camera is None:
            camera, grid = row_camera, pinhole_grid(row, width, height)
        if not all(np.array_equal(a, b) for a, b in zip(camera, row_camera, strict=True)):
            raise MethodError(
                f"{row['view_id']}: K or distortion differs from the previous view, expected one camera"
            )
        name = names[row["view_id"]] = row["view_id"].rpartition("/")[2] + ".png"
        rgb = pinhole_image(row, grid)
        write_bytes(folder / name, cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        markers[name] = detected_corners_px(rgb, views.board.dictionary) if views.board else {}
        if views.has_poses:
            poses[name] = row["left_cam_from_world"]
    if grid is None:
        raise MethodError(f"{views.config}: has no views, expected three or more")
    return LeftImages(folder, names, grid, markers, poses)


MAX_PAIR_ROTATION_DEG = 60.0
"""Largest relative rotation of two images that are matched."""


def select_pairs(
    markers: Mapping[str, Corners], board: BoardSpec, K: Float64[ndarray, "3 3"]
) -> list[tuple[str, str]]:
    """Return the pairs of image names to match; images without a board pose are matched with all others.

    ``markers`` are detections in pinhole images with intrinsics ``K``, pixels.
    """
    poses = {name: board_pose(corners, board, K) for name, corners in markers.items()}
    pairs = []
    for name, other in combinations(sorted(markers), 2):
        pose, other_pose = poses[name], poses[other]
        if (
            pose is None
            or other_pose is None
            or rotation_angle_deg(other_pose[:3, :3] @ pose[:3, :3].T) <= MAX_PAIR_ROTATION_DEG
        ):
            pairs.append((name, other))
    return pairs
