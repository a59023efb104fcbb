"""Calibration of one camera or of a stereo pair: intrinsics, distortion, and the rigid motion of the pair."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import rigid, rotation_matrix, undistort


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one camera: pinhole parameters, pixels, and distortion k1 k2 p1 p2 k3 (OpenCV's order)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class StereoCalibration:
    """Calibrated stereo pair, with ``x_right = R(rotation_rad) @ x_left + translation_m`` in OpenCV axes.

    ``rotation_rad`` is a Rodrigues vector; ``translation_m`` is about (-baseline, 0, 0). The intrinsics apply to
    images of ``width`` x ``height`` pixels.
    """

    width: int
    height: int
    left: Lens
    right: Lens
    rotation_rad: tuple[float, float, float]
    translation_m: tuple[float, float, float]


@dataclass(frozen=True)
class MonoCalibration:
    """Calibrated camera, for images of ``width`` x ``height`` pixels."""

    width: int
    height: int
    left: Lens


Calibration = StereoCalibration | MonoCalibration
_AnyCalibration = TypeVar("_AnyCalibration", StereoCalibration, MonoCalibration, Calibration)


def lens_K(lens: Lens) -> Float64[ndarray, "3 3"]:
    """Return the pinhole matrix of a camera, pixels."""
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


def lens_distortion(lens: Lens) -> Float64[ndarray, 5]:
    """Return the distortion coefficients k1 k2 p1 p2 k3."""
    return np.array(lens.distortion, dtype=np.float64)


def right_from_left(calibration: StereoCalibration) -> Float64[ndarray, "4 4"]:
    """Return the rigid motion ``x_right = R x_left + T`` as a 4 x 4 matrix, metres."""
    return rigid(rotation_matrix(calibration.rotation_rad), np.array(calibration.translation_m))


def calibrated_baseline_m(calibration: StereoCalibration) -> float:
    """Return the distance between the camera centres, metres."""
    return float(np.linalg.norm(calibration.translation_m))


def scale_calibration(calibration: _AnyCalibration, width: int, height: int) -> _AnyCalibration:
    """Return the calibration for another image size that covers the same sensor area.

    Pixel centres are at integers, so scaling a side from W to W' gives cx' = (cx + 0.5) W'/W - 0.5. The distortion
    coefficients refer to the plane z = 1 and do not change.
    """
    scale_x, scale_y = width / calibration.width, height / calibration.height
    if (scale_x, scale_y) == (1.0, 1.0):
        return calibration

    def scale_lens(lens: Lens) -> Lens:
        cx, cy = (lens.cx + 0.5) * scale_x - 0.5, (lens.cy + 0.5) * scale_y - 0.5
        return replace(lens, fx=lens.fx * scale_x, fy=lens.fy * scale_y, cx=cx, cy=cy)

    scaled = replace(calibration, width=width, height=height, left=scale_lens(calibration.left))
    return scaled if isinstance(scaled, MonoCalibration) else replace(scaled, right=scale_lens(scaled.right))


def check_invertible(lens: Lens, width: int, height: int) -> None:
    """Check that the distortion can be inverted at all pixels on the rim of a ``width`` x ``height`` image.

    The rim is farthest from the principal point and the model folds at a radius, so that an invertible rim implies
    an invertible image. Raises ``ValueError`` if it cannot be inverted.
    """
    u, v = np.arange(-0.5, width), np.arange(-0.5, height)
    rim = np.concatenate(
        [np.stack(np.broadcast_arrays(u, edge), axis=-1) for edge in (v[0], v[-1])]
        + [np.stack(np.broadcast_arrays(edge, v), axis=-1) for edge in (u[0], u[-1])]
    )
    undistort((rim - (lens.cx, lens.cy)) / (lens.fx, lens.fy), lens_distortion(lens))
