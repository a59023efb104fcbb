"""The left views of a config as a multi-view method takes them: pictures on disk, one camera, the markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.aruco import Corners, detected_corners_px
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.config_views import ConfigViews
from rebar_depth_bench.methods.multiview.pinhole import PinholeGrid, pinhole_grid, pinhole_picture

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
