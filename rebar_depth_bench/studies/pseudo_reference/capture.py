"""Real captures: folders of stereo pairs with a camera calibration and without ground-truth depth.

::

    CAPTURE/
      left/<name>.png       left image of a view (.png, .jpg or .jpeg)
      right/<name>.png      right image, with the same stem and size as the left one
      calibration.conf      Stereolabs calibration file, or calibration.toml (``geometry.calibration``)

The id of a view is ``<folder name>/<image stem>``. Images are never decoded, because scoring needs only their
names and sizes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rebar_depth_bench.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.geometry.calibration import read_calibration
from rebar_depth_bench.geometry.stereo_calibration import StereoCalibration, calibrated_baseline_m
from rebar_depth_bench.studies.image_header import read_image_shape

CAPTURE_LAYOUT = "left/<name>.png|jpg, right/<name>.png|jpg, calibration.conf|toml"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_CALIBRATION_FILES = ("calibration.conf", "calibration.toml")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_NAME_RULE = "a name of 1 to 100 letters, digits, . _ -"
_SQUARE_PIXEL_TOLERANCE = 0.03
"""Maximum deviation of fx / fy from 1.

Real cameras deviate by a fraction of a per cent; images of a different aspect ratio than the calibration's cause
larger deviations.
"""


@dataclass(frozen=True)
class Capture:
    """Views of a capture and the stereo calibration on their pixel grid, including lens distortion."""

    path: Path
    view_ids: tuple[str, ...]
    height: int
    width: int
    calibration: StereoCalibration

    def expected_views(self) -> dict[str, tuple[int, int]]:
        """Return every view id with its (height, width)."""
        return dict.fromkeys(self.view_ids, (self.height, self.width))

    def describe_camera(self) -> str:
        """Return a description of K, the baseline and the pixel grid that depth maps must have."""
        left = self.calibration.left
        description = (
            f"left fx {left.fx:.2f}, fy {left.fy:.2f}, cx {left.cx:.2f}, cy {left.cy:.2f} px at "
            f"{self.width} x {self.height}; baseline {calibrated_baseline_m(self.calibration) * 1000:.2f} mm"
        )
        if any(left.distortion):
            return (
                f"{description}. The calibration has lens distortion: it describes raw pictures. Depth maps must "
                "be on the very grid of left/; depth of rectified pictures needs rectified pictures there"
            )
        return f"{description}. Depth maps must be on the very grid of left/"


def is_capture(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is meant as a capture, that is, whether it contains a folder ``left``."""
    return (Path(path) / "left").is_dir()


def open_capture(path: str | os.PathLike[str]) -> Capture:
    """Return the views and the calibration of a capture.

    Raises ``InputError`` with all problems of the stereo pairs, and ``CalibrationError`` for an invalid
    calibration.
    """
    root = Path(path)
    name = root.resolve().name
    problems: list[Problem] = []
    if not _NAME.fullmatch(name):
        problems.append(Problem("name", "", f"the folder is called {name!r}", _NAME_RULE))
    left, right = (_image_files(root / eye, problems) for eye in ("left", "right"))
    for files, other, other_eye in ((left, right, "right"), (right, left, "left")):
        unpaired = sorted(files.keys() - other.keys())
        problems += [Problem("missing", _entry(files[stem]), f"has no {other_eye}/{stem}") for stem in unpaired]
    shape = _common_shape([*left.values(), *right.values()], problems)
    if shape is None and not problems:
        problems.append(Problem("missing", "left/", "has no images"))
    if shape is None or problems:
        raise InputError.from_problems(f"{root}: expected a capture ({CAPTURE_LAYOUT})", problems)
    view_ids = tuple(f"{name}/{stem}" for stem in sorted(left))
    height, width = shape
    return Capture(root, view_ids, height, width, _read_calibration(root, width, height))


def _entry(file: Path) -> str:
    """Return the location of an image in the capture, for error messages."""
    return escape_text(f"{file.parent.name}/{file.name}")


def _image_files(folder: Path, problems: list[Problem]) -> dict[str, Path]:
    """Return the image files of a folder by stem; append the problems of their names to ``problems``."""
    if not folder.is_dir():
        problems.append(Problem("missing", f"{folder.name}/", "no such folder"))
        return {}
    if not os.access(folder, os.R_OK | os.X_OK):
        problems.append(Problem("unreadable", f"{folder.name}/", "the folder cannot be read"))
        return {}
    files: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in _IMAGE_SUFFIXES or file.is_dir():
            continue
        if file.stem in files:
            problems.append(Problem("duplicate", _entry(file), "the name occurs twice", "one image per view"))
        if not _NAME.fullmatch(file.stem):
            problems.append(Problem("name", _entry(file), "invalid name", _NAME_RULE))
        files[file.stem] = file
    return files


def _common_shape(images: Sequence[Path], problems: list[Problem]) -> tuple[int, int] | None:
    """Return (height, width) of the first readable image; add a problem for each of another size or unreadable."""
    shape: tuple[int, int] | None = None
    for file in images:
        try:
            height, width = read_image_shape(file)
        except EntryError as error:
            problems += [replace(problem, where=_entry(file)) for problem in error.problems]
            continue
        shape = shape or (height, width)
        if (height, width) != shape:
            expected = f"{shape[1]} x {shape[0]} as the first"
            problems.append(Problem("invalid", _entry(file), f"is {width} x {height}", expected))
    return shape


def _read_calibration(root: Path, width: int, height: int) -> StereoCalibration:
    paths = [root / name for name in _CALIBRATION_FILES if (root / name).exists()]
    if len(paths) != 1:
        raise InputError(
            f"{root}: {len(paths)} calibration files, expected one of {' or '.join(_CALIBRATION_FILES)}"
        )
    calibration = read_calibration(paths[0], width, height)
    ratio = calibration.left.fx / calibration.left.fy
    if abs(ratio - 1) > _SQUARE_PIXEL_TOLERANCE:
        raise InputError(
            f"{paths[0]}: at the image size {width} x {height} fx is {ratio:.3f} times fy, expected 1: "
            "the calibration belongs to images of another aspect ratio"
        )
    return calibration
