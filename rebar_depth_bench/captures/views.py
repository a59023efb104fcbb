"""Images of one size and one calibration as views for methods (``data.rows.Views``)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.captures.image_files import read_image
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.stereo_calibration import (
    Calibration,
    StereoCalibration,
    calibrated_baseline_m,
    lens_distortion,
    lens_K,
    right_from_left,
)
from rebar_depth_bench.submission import CaptureViews

_LEFT_COLUMNS = ("left_rgb", "left_K", "left_distortion", "left_cam_from_world")
_RIGHT_COLUMNS = ("right_rgb", "right_K", "right_distortion", "right_cam_from_world", "baseline_m")


@dataclass(frozen=True, eq=False)
class ImageViews:
    """Image files by view id, and the calibration on their pixel grid, including lens distortion.

    ``right`` is empty for images of one camera. Without poses, ``cam_from_world`` is empty and the world frame of
    a view is that of its left camera. ``board_is_assumed`` is True if the capture does not state its board.
    """

    path: Path
    config: str
    left: Mapping[str, Path]
    right: Mapping[str, Path]
    calibration: Calibration
    board: BoardSpec | None = None
    board_is_assumed: bool = False
    cam_from_world: Mapping[str, Float64[ndarray, "4 4"]] = field(default_factory=dict)

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return tuple(self.left)

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.calibration.height, self.calibration.width

    @property
    def mesh(self) -> Path:
        """Raises ``InputError``: there is no ground truth."""
        raise InputError(f"{self.path}: has no mesh, expected a dataset folder, which has the ground truth")

    @property
    def has_poses(self) -> bool:
        """Whether all views have poses in one world frame."""
        return bool(self.cam_from_world)

    @property
    def rectify(self) -> bool:
        """Whether the images have lens distortion, or are those of a pair that is not parallel."""
        if not isinstance(self.calibration, StereoCalibration):
            return any(self.calibration.left.distortion)
        left, right = self.calibration.left, self.calibration.right
        same = (left.fx, left.fy, left.cy) == (right.fx, right.fy, right.cy)
        moved = (*self.calibration.rotation_rad, *self.calibration.translation_m[1:])
        return not same or any((*left.distortion, *right.distortion, *moved))

    @property
    def identity(self) -> str:
        """Digest of the calibration and of the names, sizes and times of the files."""
        digest = hashlib.sha256(repr((self.calibration, self.board)).encode())
        for view_id in self.view_ids:
            digest.update(repr((view_id, self._pose(view_id).tolist())).encode())
            for files in (self.left, self.right):
                if view_id in files:
                    status = files[view_id].stat()
                    digest.update(repr((status.st_size, status.st_mtime_ns)).encode())
        return digest.hexdigest()

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of a row; without the right image, there are those of the left one only."""
        is_stereo = bool(self.right)
        poses = ("left_cam_from_world",) if self.has_poses or is_stereo else ()
        return (*_LEFT_COLUMNS[:-1], *poses, *(_RIGHT_COLUMNS if is_stereo else ()))

    def expected_views(self) -> CaptureViews:
        """Return every view id with its (height, width)."""
        return CaptureViews(dict.fromkeys(self.view_ids, self.grid))

    def describe_camera(self) -> str:
        """Return a description of K, the baseline and the pixel grid of depth maps."""
        left, (height, width) = self.calibration.left, self.grid
        description = (
            f"left fx {left.fx:.2f}, fy {left.fy:.2f}, cx {left.cx:.2f}, cy {left.cy:.2f} px at {width} x {height}"
        )
        if isinstance(self.calibration, StereoCalibration):
            description += f"; baseline {calibrated_baseline_m(self.calibration) * 1000:.2f} mm"
        grid = "as they are, not of rectified ones" if self.rectify else "(no lens distortion)"
        return f"{description}. Depth maps are on the grid of the left images {grid}"

    def by_scene(self) -> tuple[ImageViews, ...]:
        """Return the views themselves."""
        return (self,)

    def check_columns(self, columns: Sequence[str], reader: str) -> None:
        """Raise ``InputError`` if the views lack columns that ``reader`` needs."""
        missing = [name for name in columns if name not in ("view_id", *self.columns)]
        if missing:
            found = f"{reader} needs {', '.join(missing)}"
            raise InputError(f"{self.path}: {found}, but these images have only {', '.join(self.columns)}")

    def rows(self, *columns: str, skip: Collection[str] = ()) -> Iterator[dict[str, Any]]:
        """Yield the ``view_id`` and named columns of each view that is not in ``skip``, in order.

        Raises ``InputError`` for columns that the views lack, and for damaged images.
        """
        self.check_columns(columns, "the method")
        for view_id in self.view_ids:
            if view_id not in skip:
                yield {
                    "view_id": view_id,
                    **{name: self._cells[name](view_id) for name in columns if name != "view_id"},
                }

    @property
    def _cells(self) -> Mapping[str, Callable[[str], Any]]:
        """Functions that return the cell of a view, by column."""
        left = self.calibration.left
        cells: dict[str, Callable[[str], Any]] = {
            "left_rgb": lambda view_id: read_image(self.left[view_id], self.grid),
            "left_K": lambda _: lens_K(left),
            "left_distortion": lambda _: lens_distortion(left),
            "left_cam_from_world": self._pose,
        }
        if not isinstance(self.calibration, StereoCalibration):
            return cells
        pair, right = self.calibration, self.calibration.right
        return cells | {
            "right_rgb": lambda view_id: read_image(self.right[view_id], self.grid),
            "right_K": lambda _: lens_K(right),
            "right_distortion": lambda _: lens_distortion(right),
            "right_cam_from_world": lambda view_id: right_from_left(pair) @ self._pose(view_id),
            "baseline_m": lambda _: calibrated_baseline_m(pair),
        }

    def _pose(self, view_id: str) -> Float64[ndarray, "4 4"]:
        return self.cam_from_world.get(view_id, np.eye(4))
