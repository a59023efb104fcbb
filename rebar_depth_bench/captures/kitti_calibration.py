"""Reader of KITTI's two calibration files of a day: laser projection, and the rectified pair of colour cameras.

Laser points are projected into the rectified colour images as in Geiger et al., "Vision meets Robotics: The KITTI
Dataset", IJRR 2013, equation 8: ``y = P_rect_i  R_rect_00  T_velo_to_cam  x`` in homogeneous coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN, DatasetError, Problem
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration
from rebar_depth_bench.key_lines import with_lines
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import parse_number, read_file
from rebar_depth_bench.validation import format_location, short_repr

CAM_TO_CAM, VELO_TO_CAM = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
MAX_SIDE_PX = 8192
"""Largest accepted width and height of an image, pixels."""
_ROTATION_TOLERANCE = 1e-5
"""Largest deviation of ``R @ R.T`` from the identity; KITTI's files, with seven digits, deviate by up to 1e-7."""
_MAX_MAGNITUDE = 1e6

Numbers = Float64[ndarray, "..."]


@dataclass(frozen=True, eq=False)
class KittiCamera:
    """Rectified colour camera: image size and projection from the laser scanner's frame.

    ``(u d, v d, d) = image_from_velo @ (x, y, z, 1)``, where (x, y, z) is a laser point in the scanner's frame and
    d its planar depth in the camera, both in metres. ``project_scan`` defines the conversion of (u, v) to pixel
    indices.
    """

    width: int
    height: int
    image_from_velo: Float64[ndarray, "3 4"]


def read_camera(day_folder: Path, camera: int) -> KittiCamera:
    """Return colour camera 2 or 3, read from the two calibration files in the folder of a day.

    Raises ``DatasetError`` with all problems of a file.
    """
    size, projection = f"S_rect_{camera:02d}", f"P_rect_{camera:02d}"
    cam = _read_file(day_folder / CAM_TO_CAM, {size: _SIZE, projection: _PROJECTION, "R_rect_00": _ROTATION})
    velo = _read_file(day_folder / VELO_TO_CAM, {"R": _ROTATION, "T": _TRANSLATION})
    rectification, cam_from_velo = np.eye(4), np.eye(4)
    rectification[:3, :3] = cam["R_rect_00"]
    cam_from_velo[:3, :3], cam_from_velo[:3, 3] = velo["R"], velo["T"]
    width, height = map(int, cam[size])
    return KittiCamera(width, height, cam[projection] @ rectification @ cam_from_velo)


def read_pair(day_folder: Path) -> StereoCalibration:
    """Return the rectified colour cameras 2 (left) and 3 (right), which have the same axes and no distortion.

    The baseline is P_rect_02[0, 3] / fx - P_rect_03[0, 3] / fx; the offsets along y and z, a few millimetres that
    rectified images do not show, are left out, as in KITTI's development kit. Raises ``DatasetError`` with all
    problems of the file.
    """
    keys = {f"{name}_{camera:02d}": kind for camera in (2, 3) for name, kind in _CAMERA_KEYS.items()}
    cam = _read_file(day_folder / CAM_TO_CAM, keys, _pair_problems)
    left, right = (_lens(cam[key]) for key in ("P_rect_02", "P_rect_03"))
    width, height = map(int, cam["S_rect_02"])
    return StereoCalibration(width, height, left, right, (0.0, 0.0, 0.0), (-_baseline_m(cam), 0.0, 0.0))


def _lens(projection: Numbers) -> Lens:
    (fx, _, cx, _), (_, fy, cy, _), _ = projection.tolist()
    return Lens(fx, fy, cx, cy, (0.0, 0.0, 0.0, 0.0, 0.0))


def _baseline_m(cam: Mapping[str, Numbers]) -> float:
    left_m, right_m = (float(cam[key][0, 3] / cam[key][0, 0]) for key in ("P_rect_02", "P_rect_03"))
    return left_m - right_m


def _pair_problems(cam: Mapping[str, Numbers]) -> Iterator[Problem]:
    """Yield why two rectified cameras are no pair of a left and a right one."""
    if cam["S_rect_02"].tolist() != cam["S_rect_03"].tolist():
        yield Problem("conflict", "S_rect_03", "differs from S_rect_02", "images of one size")
    if not _baseline_m(cam) > 0:
        found = f"the right camera is {_baseline_m(cam):.6g} m to the right of the left one"
        yield Problem("conflict", "P_rect_03", found, "a distance above 0")


@dataclass(frozen=True)
class _Quantity:
    """Shape of the numbers of a key, what they are, and a predicate that they fulfil."""

    shape: tuple[int, ...]
    expected: str
    accept: Callable[[Numbers], bool]


def _is_size(sides: Numbers) -> bool:
    return all(side in range(1, MAX_SIDE_PX + 1) for side in sides.tolist())


def _is_projection(projection: Numbers) -> bool:
    return projection[2, :3].tolist() == [0, 0, 1] and bool(projection[0, 0] > 0) and bool(projection[1, 1] > 0)


def _is_rotation(rotation: Numbers) -> bool:
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    return bool(deviation <= _ROTATION_TOLERANCE and np.linalg.det(rotation) > 0)


_SIZE = _Quantity((2,), f"width and height, whole numbers from 1 to {MAX_SIDE_PX}", _is_size)
_PROJECTION = _Quantity((3, 4), "12 numbers, a projection whose last row is 0 0 1 t", _is_projection)
_ROTATION = _Quantity((3, 3), "9 numbers, the rows of a rotation", _is_rotation)
_TRANSLATION = _Quantity((3,), "3 numbers, metres", lambda _: True)
_CAMERA_KEYS = {"S_rect": _SIZE, "P_rect": _PROJECTION}


def _read_file(
    path: Path,
    quantities: Mapping[str, _Quantity],
    conflicts: Callable[[Mapping[str, Numbers]], Iterable[Problem]] = lambda _: (),
) -> dict[str, Numbers]:
    """Return numbers by key. Raises ``DatasetError`` with all problems, ``conflicts`` only of valid numbers."""
    content = read_file(path, TOML_BYTES, "KITTI's calibration of the day", DatasetError)
    problems: list[Problem] = []
    texts = _key_values(content, problems)
    values = {key: _parse_numbers(texts, key, quantity, problems) for key, quantity in quantities.items()}
    problems += [] if problems else conflicts(values)
    if problems:
        raise DatasetError.from_problems(path, with_lines(problems, content))
    return values


def _key_values(content: bytes, problems: list[Problem]) -> dict[str, str]:
    """Return the text after the colon by key; lines without a colon are ignored."""
    texts: dict[str, str] = {}
    for number, line in enumerate(content.decode("ascii", "replace").splitlines(), start=1):
        key, colon, text = (part.strip() for part in line.partition(":"))
        if colon and key in texts and len(problems) < MAX_PROBLEMS_SHOWN:
            place = format_location("", key)
            problems.append(Problem("duplicate", place, f"line {number}: the key occurs twice", "each key once"))
        elif colon:
            texts[key] = text
    return texts


def _parse_numbers(texts: Mapping[str, str], key: str, quantity: _Quantity, problems: list[Problem]) -> Numbers:
    """Return the numbers of a key in their shape; zeros, after adding a problem, if missing or invalid."""
    if key not in texts:
        problems.append(Problem("missing", key, "missing", quantity.expected))
        return np.zeros(quantity.shape)
    numbers = np.array([parse_number(part) for part in texts[key].split()])
    if numbers.size == np.prod(quantity.shape) and (np.abs(numbers) <= _MAX_MAGNITUDE).all():
        shaped = numbers.reshape(quantity.shape)
        if quantity.accept(shaped):
            return shaped
    problems.append(Problem("invalid", key, f"got {short_repr(texts[key])}", quantity.expected))
    return np.zeros(quantity.shape)
