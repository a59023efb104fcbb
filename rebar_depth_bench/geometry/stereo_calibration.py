"""Two calibrated lenses and the rigid motion between them, as plain values; scaled to another grid."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import rigid, rotation_matrix, undistort


@dataclass(frozen=True)
class Lens:
    """One eye's pinhole and its distortion, pixels; ``distortion`` is k1 k2 p1 p2 k3 (OpenCV's order)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]


@dataclass(frozen=True)
class StereoCalibration:
    """A calibrated pair: ``x_right = R(rotation_rad) @ x_left + translation_m`` in OpenCV axes.

    ``rotation_rad`` is a Rodrigues vector; ``translation_m`` is about (-baseline, 0, 0). The lenses are those
    of the ``width`` x ``height`` grid.
    """

    width: int
    height: int
    left: Lens
    right: Lens
    rotation_rad: tuple[float, float, float]
    translation_m: tuple[float, float, float]


def lens_K(lens: Lens) -> Float64[ndarray, "3 3"]:
    """Return a lens's pinhole matrix, pixels."""
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


def lens_distortion(lens: Lens) -> Float64[ndarray, 5]:
    """Return k1 k2 p1 p2 k3."""
    return np.array(lens.distortion, dtype=np.float64)


def right_from_left(calibration: StereoCalibration) -> Float64[ndarray, "4 4"]:
    """Return the rigid motion ``x_right = R x_left + T`` as a 4 x 4 matrix, metres."""
    return rigid(rotation_matrix(calibration.rotation_rad), np.array(calibration.translation_m))


def calibrated_baseline_m(calibration: StereoCalibration) -> float:
    """Return the metres between the two camera centres."""
    return float(np.linalg.norm(calibration.translation_m))


def scaled(calibration: StereoCalibration, width: int, height: int) -> StereoCalibration:
    """Return the calibration of another grid that covers the very same sensor area.

    Pixel centres stand at integers, so a side that shrinks from W to W' has cx' = (cx + 0.5) W'/W - 0.5. The
    distortion belongs to the plane z = 1 and stays.
    """
    by_x, by_y = width / calibration.width, height / calibration.height
    if (by_x, by_y) == (1.0, 1.0):
        return calibration

    def lens(eye: Lens) -> Lens:
        cx, cy = (eye.cx + 0.5) * by_x - 0.5, (eye.cy + 0.5) * by_y - 0.5
        return replace(eye, fx=eye.fx * by_x, fy=eye.fy * by_y, cx=cx, cy=cy)

    return replace(
        calibration, width=width, height=height, left=lens(calibration.left), right=lens(calibration.right)
    )


def check_invertible(lens: Lens, width: int, height: int) -> None:
    """Raise ``ValueError`` in words where no ray reaches some pixel on the rim of a grid.

    The rim lies farthest out, and the model folds at a radius: an invertible rim means an invertible picture.
    """
    u, v = np.arange(-0.5, width), np.arange(-0.5, height)
    rim = np.concatenate(
        [np.stack(np.broadcast_arrays(u, edge), axis=-1) for edge in (v[0], v[-1])]
        + [np.stack(np.broadcast_arrays(edge, v), axis=-1) for edge in (u[0], u[-1])]
    )
    undistort((rim - (lens.cx, lens.cy)) / (lens.fx, lens.fy), lens_distortion(lens))
