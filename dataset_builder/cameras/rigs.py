"""The bundled ZED rig, and the cameras of a rig from a ``RigSpec`` and the left pose of each view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import resources
from math import isclose

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.specs.config_specs import FocalRigSpec, RigSpec
from rebar_depth_bench.captures.calibration import StereoCalibration, scale_calibration
from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.geometry.cameras import (
    NOMINAL_FOCAL_PX,
    NOMINAL_HEIGHT,
    NOMINAL_WIDTH,
    Camera,
    ideal_K,
    matrix_product,
    right_camera_pose,
    rigid,
)

ZED_CALIBRATION = "zed-hd720.conf"


Pose = Float64[ndarray, "4 4"]
"""``cam_from_world`` of a camera, metres."""


def zed_rig(width: int = NOMINAL_WIDTH, height: int = NOMINAL_HEIGHT, grid: str = "rectified") -> RigSpec:
    """Return the rig of the bundled ZED calibration on its ``raw`` or ``rectified`` grid.

    The factory calibration is for HD720; ``rig_cameras`` scales it to ``width`` x ``height`` pixels.
    """
    resource = resources.files("dataset_builder.cameras").joinpath("calibrations", ZED_CALIBRATION)
    with resources.as_file(resource) as path:
        calibration = read_calibration(path, NOMINAL_WIDTH, NOMINAL_HEIGHT)
    return RigSpec(width, height, calibration.baseline_m, calibration, grid)


def rig_cameras(rig: RigSpec, cam_from_world: Float64[ndarray, "4 4"]) -> dict[str, Camera]:
    """Return the cameras of a rig as ``{"left": ..., "right": ...}``.

    ``cam_from_world`` is the pose of the physical left camera, as given by the trajectory. On the ``raw`` grid the
    cameras are the physical lenses including their distortion. On the ``rectified`` grid they are the parallel
    pinholes of ``rectification.rectify``: the camera centres are the same but the axes are rotated, so the left
    pose differs from ``cam_from_world``. A calibration of another image size is scaled to that of the rig.

    Raises ``ValueError`` for an unknown grid, for a calibrated grid without a calibration, for the ideal grid with
    a calibration, and for a ``baseline_m`` that differs from that of the calibration.
    """
    if rig.grid not in GRIDS:
        raise ValueError(f"no grid {rig.grid!r}, expected one of {', '.join(GRIDS)}")
    return GRIDS[rig.grid](rig, cam_from_world)


def _ideal_cameras(rig: RigSpec, left: Pose) -> dict[str, Camera]:
    if rig.calibration is not None:
        raise ValueError("the grid of a rig with a calibration is 'ideal', expected 'raw' or 'rectified'")
    focal_px = rig.focal_px if isinstance(rig, FocalRigSpec) else NOMINAL_FOCAL_PX
    return _pinholes(rig, ideal_K(rig.width, rig.height, focal_px), left)


def _raw_cameras(rig: RigSpec, left: Pose) -> dict[str, Camera]:
    calibration = _scaled_calibration(rig)
    right = matrix_product(calibration.right_from_left, left)
    eyes = {"left": (calibration.left, left), "right": (calibration.right, right)}
    return {
        eye: Camera(lens.K, np.array(lens.distortion), pose, rig.width, rig.height)
        for eye, (lens, pose) in eyes.items()
    }


def _rectified_cameras(rig: RigSpec, left: Pose) -> dict[str, Camera]:
    from rebar_depth_bench.geometry.rectification import rectify

    pair = _scaled_calibration(rig)
    raw = _raw_cameras(rig, left).values()
    Ks, distortions = [camera.K for camera in raw], [camera.distortion for camera in raw]
    K, (R_left, _) = rectify(Ks, distortions, pair.right_from_left, rig.width, rig.height)
    return _pinholes(rig, K, matrix_product(rigid(R_left, np.zeros(3)), left))


def _pinholes(rig: RigSpec, K: Float64[ndarray, "3 3"], left: Pose) -> dict[str, Camera]:
    """Return two parallel pinholes, the right one exactly ``baseline_m`` along the x axis of the left one."""
    right = right_camera_pose(left, rig.baseline_m)
    return {
        eye: Camera(K, np.zeros(5), pose, rig.width, rig.height)
        for eye, pose in (("left", left), ("right", right))
    }


def _scaled_calibration(rig: RigSpec) -> StereoCalibration:
    if rig.calibration is None:
        raise ValueError(f"a rig with grid {rig.grid!r} requires a calibration")
    baseline_m = rig.calibration.baseline_m
    if not isclose(rig.baseline_m, baseline_m, rel_tol=1e-12):
        raise ValueError(f"the rig's baseline_m is {rig.baseline_m}, expected {baseline_m} as in its calibration")
    return scale_calibration(rig.calibration, rig.width, rig.height)


GRIDS: Mapping[str, Callable[[RigSpec, Pose], dict[str, Camera]]] = {
    "ideal": _ideal_cameras,
    "raw": _raw_cameras,
    "rectified": _rectified_cameras,
}
"""Functions that return the cameras of a rig, by the name of the grid in ``RigSpec.grid``."""
