"""Captures: folders of images with their cameras and without ground-truth depth.

::

    CAPTURE/
      left/<name>.png       left image of a view (.png, .jpg or .jpeg)
      right/<name>.png      right image, with the same stem and size as the left one
      calibration.conf      Stereolabs calibration file, or another one (``captures.camera_files``)

Images of one camera are in ``left/`` without ``right/``, or in the folder itself. The id of a view is
``<folder name>/<image stem>``.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.captures.calibration import Calibration, MonoCalibration, StereoCalibration, camera_columns
from rebar_depth_bench.captures.camera_files import CAMERAS_FILE, read_cameras
from rebar_depth_bench.captures.images import (
    IMAGE_SUFFIXES,
    NAME,
    NAME_RULE,
    OTHER_SUFFIXES,
    common_shape,
    entry_name,
    image_files,
    read_image,
)
from rebar_depth_bench.geometry.aruco_board import BoardSpec
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
        """Whether the images have lens distortion, or come from a pair that is not parallel."""
        return not self.calibration.is_rectified

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
        """Columns of a row; without the right image, only columns of the left one."""
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
            description += f"; baseline {self.calibration.baseline_m * 1000:.2f} mm"
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
                row = {"view_id": view_id, **camera_columns(self.calibration, self._pose(view_id))}
                for column, files in (("left_rgb", self.left), ("right_rgb", self.right)):
                    if column in columns:
                        row[column] = read_image(files[view_id], self.grid)
                yield {name: row[name] for name in ("view_id", *columns)}

    def _pose(self, view_id: str) -> Float64[ndarray, "4 4"]:
        return self.cam_from_world.get(view_id, np.eye(4))


CAPTURE_LAYOUT = "left/<name>.png|jpg, right/<name>.png|jpg, calibration.conf|toml or another calibration"


def is_capture(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is meant as a capture.

    It has a folder ``left``, ``cameras.toml`` or ``calibration.toml``, or images.
    """
    root = Path(path)
    if (root / "left").is_dir() or any((root / name).is_file() for name in (CAMERAS_FILE, "calibration.toml")):
        return True
    pictures = (*IMAGE_SUFFIXES, *OTHER_SUFFIXES)
    return root.is_dir() and any(entry.suffix.lower() in pictures for entry in root.iterdir())


def open_capture(path: str | os.PathLike[str]) -> ImageViews:
    """Return the views and the calibration of a capture.

    Raises ``InputError`` with all problems of the images, and ``CalibrationError`` for an invalid calibration.
    """
    root = Path(path)
    name = root.resolve().name
    problems: list[Problem] = []
    if not NAME.fullmatch(name):
        problems.append(Problem("name", "", f"the folder is called {name!r}", NAME_RULE))
    has_left, is_stereo = (root / "left").is_dir(), (root / "right").exists()
    left = image_files(root / "left" if has_left or is_stereo else root, problems)
    right = image_files(root / "right", problems) if is_stereo else {}
    for files, other, other_eye in ((left, right, "right"), (right, left, "left")):
        unpaired = sorted(files.keys() - other.keys()) if is_stereo else []
        problems += [
            Problem("missing", entry_name(files[stem]), f"has no {other_eye}/{stem}") for stem in unpaired
        ]
    shape = common_shape([*left.values(), *right.values()], problems)
    if shape is None and not problems:
        problems.append(Problem("missing", "left/" if has_left else "", "has no images"))
    if shape is None or problems:
        raise InputError.from_problems(f"{root}: expected a capture ({CAPTURE_LAYOUT})", problems)
    height, width = shape
    cameras = read_cameras(root, sorted(left), width, height, is_stereo=is_stereo)
    calibration = cameras.calibration
    if not is_stereo:
        calibration = MonoCalibration(width, height, calibration.left, calibration.notes)
    return ImageViews(
        path=root,
        config=name,
        left={f"{name}/{stem}": left[stem] for stem in sorted(left)},
        right={f"{name}/{stem}": right[stem] for stem in sorted(right)},
        calibration=calibration,
        board=cameras.board or BoardSpec(),
        board_is_assumed=cameras.board is None,
        cam_from_world={f"{name}/{stem}": pose for stem, pose in cameras.cam_from_world.items()},
    )
