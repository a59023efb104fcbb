"""Calibration files of an exported stereo pair in other programs' formats, read back to the same numbers.

The formats state quantities from which the reader computes the camera: millimetres, products with the focal
length, intrinsics at another image size. ``_stated`` chooses the number whose reading is exact, if there is one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from rebar_depth_bench.geometry.calibration_conf import STEREOLABS_GRIDS
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration

_NEIGHBOURS = 64


def stereolabs_conf(calibration: StereoCalibration) -> str:
    """Return a calibration as Stereolabs' ``.conf``, at the size of theirs with the nearest aspect ratio."""
    width, height = calibration.width, calibration.height
    suffix = min(STEREOLABS_GRIDS, key=lambda name: _difference(STEREOLABS_GRIDS[name], (width, height)))
    grid_width, grid_height = STEREOLABS_GRIDS[suffix]
    scale_x, scale_y = width / grid_width, height / grid_height
    lines: list[str] = []
    for eye, lens in (("LEFT", calibration.left), ("RIGHT", calibration.right)):
        lines += [f"[{eye}_CAM_{suffix}]", *_lens_lines(lens, scale_x, scale_y), ""]
    millimetres = [_stated(0.0 - x_m, 1000.0, lambda value: value / 1000) for x_m in calibration.translation_m]
    rx, cv, rz = calibration.rotation_rad
    values = {"Baseline": millimetres[0], "TY": millimetres[1], "TZ": millimetres[2]}
    values |= {f"CV_{suffix}": cv, f"RX_{suffix}": rx, f"RZ_{suffix}": rz}
    lines += ["[STEREO]", *(f"{key}={value!r}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def kitti_cam_to_cam(calibration: StereoCalibration) -> str:
    """Return a rectified pair as KITTI's ``calib_cam_to_cam.txt``; cameras 0 and 1 are those of 2 and 3."""
    fx = calibration.left.fx
    offset = _stated(calibration.translation_m[0], fx, lambda value: value / fx)
    lines = ["calib_time: 01-Jan-2000 00:00:00", "corner_dist: 0"]
    for camera in range(4):
        lens, x = (calibration.left, 0.0) if camera % 2 == 0 else (calibration.right, offset)
        K = (lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0)
        P = (lens.fx, 0.0, lens.cx, x, 0.0, lens.fy, lens.cy, 0.0, 0.0, 0.0, 1.0, 0.0)
        baseline_m = calibration.translation_m[0] if camera % 2 else 0.0
        values: dict[str, Sequence[float]] = {
            "S": (calibration.width, calibration.height),
            "K": K,
            "D": (0.0,) * 5,
            "R": _IDENTITY,
            "T": (baseline_m, 0.0, 0.0),
            "S_rect": (calibration.width, calibration.height),
            "R_rect": _IDENTITY,
            "P_rect": P,
        }
        lines += [f"{key}_{camera:02d}: {' '.join(map(repr, numbers))}" for key, numbers in values.items()]
    return "\n".join(lines) + "\n"


def kitti_velo_to_cam() -> str:
    """Return KITTI's ``calib_velo_to_cam.txt`` of a scanner at the left camera: x forward, y left, z up."""
    return "R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n"


_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def _difference(grid: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """Return by how much two sizes differ in aspect ratio and in width, as the reader compares them."""
    return abs(math.log(grid[0] * size[1] / (size[0] * grid[1]))), abs(math.log(grid[0] / size[0]))


def _lens_lines(lens: Lens, scale_x: float, scale_y: float) -> list[str]:
    values = {
        "fx": _stated(lens.fx, 1 / scale_x, lambda fx: fx * scale_x),
        "fy": _stated(lens.fy, 1 / scale_y, lambda fy: fy * scale_y),
        "cx": _nearest((lens.cx + 0.5) / scale_x - 0.5, lens.cx, lambda cx: (cx + 0.5) * scale_x - 0.5),
        "cy": _nearest((lens.cy + 0.5) / scale_y - 0.5, lens.cy, lambda cy: (cy + 0.5) * scale_y - 0.5),
    }
    values |= dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.distortion, strict=True))
    return [f"{key}={value!r}" for key, value in values.items()]


def _stated(value: float, factor: float, read: Callable[[float], float]) -> float:
    """Return the number near ``value`` times ``factor`` from which ``read`` gives ``value``."""
    return _nearest(value * factor, value, read)


def _nearest(guess: float, value: float, read: Callable[[float], float]) -> float:
    """Return the number nearest to ``guess`` whose reading is ``value``, or ``guess`` if there is none."""
    low = high = guess
    for _ in range(_NEIGHBOURS):
        for candidate in (low, high):
            if read(candidate) == value:
                return candidate
        low, high = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    return guess
