"""Calibration of an exported config, whose views have one pair of cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dataset_builder.export.views import CameraView
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, rotation_vector
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration

_MOTION_DECIMALS = 12
"""Decimals of the motion of the pair, metres and radians; the rest is rounding of the poses."""


def check_layout(config: DatasetConfig, layout: str) -> None:
    """Raise ``InputError`` if a config has no colour or several cameras, which captures cannot state."""
    if config.colour is None:
        raise InputError(
            f"{config.root}: config {config.name} was built without colour, expected colour for --layout {layout}"
        )


def shared_calibration(config: DatasetConfig, views: Sequence[CameraView]) -> StereoCalibration:
    """Return the calibration of all views. Raises ``InputError`` if they have several."""
    calibrations = {view_calibration(view) for view in views}
    if len(calibrations) != 1:
        found = f"config {config.name} has {len(calibrations)} pairs of cameras"
        raise InputError(f"{config.root}: {found}, expected one; --layout plain exports the cameras of each view")
    return calibrations.pop()


def view_calibration(view: CameraView) -> StereoCalibration:
    """Return the calibration of the cameras of a view."""
    left, right = view.cameras["left"], view.cameras["right"]
    motion = np.round(right.cam_from_world @ inverse_rigid(left.cam_from_world), _MOTION_DECIMALS) + 0.0
    rx, ry, rz = (np.round(rotation_vector(motion[:3, :3]), _MOTION_DECIMALS) + 0.0).tolist()
    x_m, y_m, z_m = motion[:3, 3].tolist()
    return StereoCalibration(left.width, left.height, _lens(left), _lens(right), (rx, ry, rz), (x_m, y_m, z_m))


def _lens(camera: Camera) -> Lens:
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))
