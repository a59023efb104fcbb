"""A real capture: a folder of stereo pairs and the camera's calibration, without any depth of its own.

::

    CAPTURE/
      left/<name>.png       or .jpg, .jpeg: one a view
      right/<name>.png      its right eye, of the same name before the suffix and of the same size
      calibration.conf      the camera's Stereolabs file, or calibration.toml (``calibration.read_calibration``)

A view's id is ``<name of the folder>/<name of the picture>``. Pictures are never decoded: only their names and
sizes count for a score.
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

LAYOUT = "left/<name>.png|jpg, right/<name>.png|jpg, calibration.conf|toml"
_PICTURES = (".png", ".jpg", ".jpeg")
_CALIBRATIONS = ("calibration.conf", "calibration.toml")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_SQUARE_PIXEL_TOLERANCE = 0.03
"""Real cameras have fx/fy within a fraction of a per cent of 1; pictures of another shape make it stray."""


@dataclass(frozen=True)
class Capture:
    """A capture's views and its calibration on their grid (lens distortion and all)."""

    path: Path
    view_ids: tuple[str, ...]
    height: int
    width: int
    calibration: StereoCalibration

    def expected_views(self) -> dict[str, tuple[int, int]]:
        """Return every view id with its (height, width)."""
        return dict.fromkeys(self.view_ids, (self.height, self.width))

    def camera_words(self) -> str:
        """Return K and baseline in words, with what they ask of depth maps."""
        left = self.calibration.left
        words = (
            f"left fx {left.fx:.2f}, fy {left.fy:.2f}, cx {left.cx:.2f}, cy {left.cy:.2f} px at "
            f"{self.width} x {self.height}; baseline {calibrated_baseline_m(self.calibration) * 1000:.2f} mm"
        )
        if any(left.distortion):
            return (
                f"{words}. The calibration has lens distortion: it describes raw pictures. Depth maps must be on "
                "the very grid of left/; depth of rectified pictures needs rectified pictures there"
            )
        return f"{words}. Depth maps must be on the very grid of left/"


def is_capture(path: str | os.PathLike[str]) -> bool:
    """Tell whether a folder is meant as a capture: it has a ``left`` folder in it."""
    return (Path(path) / "left").is_dir()


def open_capture(path: str | os.PathLike[str]) -> Capture:
    """Read a capture's outline.

    Raises ``InputError`` with every problem of the pairs; ``CalibrationError`` for a bad calibration.
    """
    root = Path(path)
    name = root.resolve().name
    problems = [] if _NAME.fullmatch(name) else [f"the folder is called {name!r}, expected letters, digits, . _ -"]
    left, right = (_pictures(root / eye, problems) for eye in ("left", "right"))
    problems += [f"left/{left[stem].name}: has no right/{stem}" for stem in sorted(left.keys() - right.keys())]
    problems += [f"right/{right[stem].name}: has no left/{stem}" for stem in sorted(right.keys() - left.keys())]
    sizes = {file: _size(file, problems) for files in (left, right) for file in files.values()}
    if left:
        width, height = sizes[min(left.values())]
        problems += [
            f"{file.parent.name}/{file.name}: is {size[0]} x {size[1]}, expected {width} x {height} as the first"
            for file, size in sizes.items()
            if size != (width, height) and all(size)
        ]
    if problems or not left:
        empty = [] if problems else ["left/ holds no picture"]
        raise InputError(f"{root}: {problem_summary([*problems, *empty])}\nexpected a capture: {LAYOUT}")
    view_ids = tuple(f"{name}/{stem}" for stem in sorted(left))
    return Capture(root, view_ids, height, width, _calibration(root, width, height))


def _pictures(folder: Path, problems: list[str]) -> dict[str, Path]:
    """Return a folder's pictures by name before the suffix."""
    if not folder.is_dir():
        problems.append(f"{folder.name}/: no such folder")
        return {}
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in _PICTURES or not file.is_file():
            continue
        if file.stem in found:
            problems.append(f"{folder.name}/{file.name}: the name stands twice, expected one picture a view")
        if not _NAME.fullmatch(file.stem):
            problems.append(f"{folder.name}/{file.name}: expected a name of letters, digits, . _ -")
        found[file.stem] = file
    return found


def _size(file: Path, problems: list[str]) -> tuple[int, int]:
    """Return (width, height) from the picture's header, zeros and a problem where it has none."""
    try:
        with Image.open(file) as image:
            return image.size
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        problems.append(f"{file.parent.name}/{file.name}: is no readable picture ({type(error).__name__})")
        return 0, 0


def _calibration(root: Path, width: int, height: int) -> StereoCalibration:
    found = [root / name for name in _CALIBRATIONS if (root / name).exists()]
    if len(found) != 1:
        raise InputError(f"{root}: {len(found)} calibration files, expected one of {' or '.join(_CALIBRATIONS)}")
    calibration = read_calibration(found[0], width, height)
    ratio = calibration.left.fx / calibration.left.fy
    if abs(ratio - 1) > _SQUARE_PIXEL_TOLERANCE:
        raise InputError(
            f"{found[0]}: at the pictures' {width} x {height} pixels fx is {ratio:.3f} times fy, expected 1: "
            "the calibration belongs to pictures of another shape"
        )
    return calibration
