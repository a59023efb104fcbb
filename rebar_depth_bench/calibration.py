"""Factory calibration of a stereo camera: two lenses with distortion and the rigid motion between them.

Read from a Stereolabs ``.conf`` file or from TOML; scaled to another grid of the same sensor.
"""

from __future__ import annotations

from dataclasses import dataclass


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
