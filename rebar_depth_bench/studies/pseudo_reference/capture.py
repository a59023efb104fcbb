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
from dataclasses import dataclass
from pathlib import Path

from PIL import Image, UnidentifiedImageError

from rebar_depth_bench.errors import InputError, problem_summary
from rebar_depth_bench.geometry.calibration import read_calibration
from rebar_depth_bench.geometry.stereo_calibration import StereoCalibration, calibrated_baseline_m

CAPTURE_LAYOUT = "left/<name>.png|jpg, right/<name>.png|jpg, calibration.conf|toml"
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
_CALIBRATION_FILES = ("calibration.conf", "calibration.toml")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
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
    problems = [] if _NAME.fullmatch(name) else [f"the folder is called {name!r}, expected letters, digits, . _ -"]
    left, right = (_image_files(root / eye, problems) for eye in ("left", "right"))
    problems += [f"left/{left[stem].name}: has no right/{stem}" for stem in sorted(left.keys() - right.keys())]
    problems += [f"right/{right[stem].name}: has no left/{stem}" for stem in sorted(right.keys() - left.keys())]
    sizes = {file: _image_size(file, problems) for files in (left, right) for file in files.values()}
    if left:
        width, height = sizes[min(left.values())]
        problems += [
            f"{file.parent.name}/{file.name}: is {size[0]} x {size[1]}, expected {width} x {height} as the first"
            for file, size in sizes.items()
            if size != (width, height) and all(size)
        ]
    if problems or not left:
        empty = [] if problems else ["left/ has no images"]
        raise InputError(f"{root}: {problem_summary([*problems, *empty])}\nexpected a capture: {CAPTURE_LAYOUT}")
    view_ids = tuple(f"{name}/{stem}" for stem in sorted(left))
    return Capture(root, view_ids, height, width, _read_calibration(root, width, height))


def _image_files(folder: Path, problems: list[str]) -> dict[str, Path]:
    """Return the image files of a folder by stem; append the problems of their names to ``problems``."""
    if not folder.is_dir():
        problems.append(f"{folder.name}/: no such folder")
        return {}
    files: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in _IMAGE_SUFFIXES or not file.is_file():
            continue
        if file.stem in files:
            problems.append(f"{folder.name}/{file.name}: the name occurs twice, expected one image per view")
        if not _NAME.fullmatch(file.stem):
            problems.append(f"{folder.name}/{file.name}: expected a name of letters, digits, . _ -")
        files[file.stem] = file
    return files


def _image_size(file: Path, problems: list[str]) -> tuple[int, int]:
    """Return (width, height) from the image header; if unreadable, return zeros and append to ``problems``."""
    try:
        with Image.open(file) as image:
            return image.size
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        problems.append(f"{file.parent.name}/{file.name}: is not a readable image ({type(error).__name__})")
        return 0, 0


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
