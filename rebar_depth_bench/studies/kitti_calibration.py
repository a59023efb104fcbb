"""KITTI's calibration of a day: where a laser point falls in a rectified colour picture.

Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, equation 8:
``y = P_rect_i  R_rect_00  T_velo_to_cam  x``, homogeneous.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.errors import DatasetError

CAM_TO_CAM, VELO_TO_CAM = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
_LARGEST_SIDE = 8192


@dataclass(frozen=True, eq=False)
class KittiCamera:
    """One rectified colour camera: its picture's size and ``(u z, v z, z) = image_from_velo @ (x, y, z, 1)``.

    z on the left is planar depth; x, y, z on the right is a laser point; metres. ``kitti_truth.project_scan`` says
    which pixel u, v is.
    """

    width: int
    height: int
    image_from_velo: Float64[ndarray, "3 4"]


def read_camera(day: Path, camera: int) -> KittiCamera:
    """Read camera 2 or 3 from the two calibration files of a day's folder.

    Raises ``DatasetError`` naming the file and the key that is missing, has another count of numbers or a number
    that is none.
    """
    cam = _read_values(day / CAM_TO_CAM)
    velo = _read_values(day / VELO_TO_CAM)
    size = _numbers(cam, day / CAM_TO_CAM, f"S_rect_{camera:02d}", 2)
    projection = _numbers(cam, day / CAM_TO_CAM, f"P_rect_{camera:02d}", 12).reshape(3, 4)
    rectification, cam_from_velo = np.eye(4), np.eye(4)
    rectification[:3, :3] = _numbers(cam, day / CAM_TO_CAM, "R_rect_00", 9).reshape(3, 3)
    cam_from_velo[:3, :3] = _numbers(velo, day / VELO_TO_CAM, "R", 9).reshape(3, 3)
    cam_from_velo[:3, 3] = _numbers(velo, day / VELO_TO_CAM, "T", 3)
    width, height = (int(side) for side in size)
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise DatasetError(
            f"{day / CAM_TO_CAM}: S_rect_{camera:02d} is {width} x {height}, expected 1 to {_LARGEST_SIDE} each"
        )
    return KittiCamera(width, height, projection @ rectification @ cam_from_velo)


def _read_values(path: Path) -> dict[str, str]:
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not ASCII text"
        raise DatasetError(f"{path}: cannot be read: {reason}, expected KITTI's calibration of the day") from None
    pairs = (line.partition(":") for line in text.splitlines())
    return {key.strip(): value.strip() for key, colon, value in pairs if colon}


def _numbers(values: dict[str, str], path: Path, key: str, count: int) -> Float64[ndarray, " n"]:
    if key not in values:
        raise DatasetError(f"{path}: has no {key}, expected {count} numbers under that key")
    found = values[key].split()
    try:
        numbers = [float(part) for part in found]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise DatasetError(f"{path}: {key} is {values[key][:120]!r}, expected {count} finite numbers")
    return np.array(numbers)
