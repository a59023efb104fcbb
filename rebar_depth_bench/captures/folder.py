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

import os
from pathlib import Path

from rebar_depth_bench.captures.camera_files import CALIBRATION_SUFFIXES, CAMERAS_FILE, read_cameras
from rebar_depth_bench.captures.image_files import (
    IMAGE_SUFFIXES,
    NAME,
    NAME_RULE,
    common_shape,
    entry_name,
    image_files,
)
from rebar_depth_bench.captures.views import ImageViews
from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.geometry.stereo_calibration import MonoCalibration

CAPTURE_LAYOUT = "left/<name>.png|jpg, right/<name>.png|jpg, calibration.conf|toml or another calibration"


def is_capture(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is meant as a capture.

    It has a folder ``left``, or ``cameras.toml``, or both images and a calibration file.
    """
    root = Path(path)
    if (root / "left").is_dir() or (root / CAMERAS_FILE).is_file():
        return True
    suffixes = {entry.suffix.lower() for entry in root.iterdir()} if root.is_dir() else set()
    return not suffixes.isdisjoint(IMAGE_SUFFIXES) and not suffixes.isdisjoint(CALIBRATION_SUFFIXES)


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
        calibration = MonoCalibration(width, height, calibration.left)
    return ImageViews(
        path=root,
        config=name,
        left={f"{name}/{stem}": left[stem] for stem in sorted(left)},
        right={f"{name}/{stem}": right[stem] for stem in sorted(right)},
        calibration=calibration,
        board=cameras.board,
        board_is_assumed=cameras.board_is_assumed,
        cam_from_world={f"{name}/{stem}": pose for stem, pose in cameras.cam_from_world.items()},
    )
