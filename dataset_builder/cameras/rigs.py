"""The bundled ZED rig, and the cameras of a rig from a ``RigSpec`` and the left pose of each view."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources
from math import isclose

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.specs.config_specs import FocalRigSpec, RigSpec
from rebar_depth_bench.captures.calibration import Lens, StereoCalibration
from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.data.schema import EYES
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


def zed_rig(width: int = NOMINAL_WIDTH, height: int = NOMINAL_HEIGHT, grid: str = "rectified") -> RigSpec:
    """Return the rig of the bundled ZED calibration on its ``raw`` or ``rectified`` grid.

    The factory calibration is for HD720; ``rig_cameras`` scales it to ``width`` x ``height`` pixels.
    """
    resource = resources.files("dataset_builder.cameras").joinpath("calibrations", ZED_CALIBRATION)
    with resources.as_file(resource) as path:
        calibration = read_calibration(path, NOMINAL_WIDTH, NOMINAL_HEIGHT)
    return RigSpec(width, height, calibration.baseline_m, calibration, grid)


def sized_rig(rig: RigSpec, width: int | None, height: int | None) -> RigSpec:
    """Return the rig for images of another size; a side that is None follows from the other one, or is kept."""
    new_width = width or (rig.width if height is None else round(rig.width * height / rig.height))
    return replace(rig, width=new_width, height=height or round(rig.height * new_width / rig.width))


def resized(calibration: StereoCalibration, width: int, height: int) -> StereoCalibration:
    """Return the calibration for another image size: scaled by the width, with rows cropped or added.

    As many rows are cropped or added at the top as at the bottom, so that pixels keep their shape.
    """
    if (width, height) == (calibration.width, calibration.height):
        return calibration
    scale = width / calibration.width
    top_px = (height - scale * calibration.height) / 2

    def resize(lens: Lens) -> Lens:
        cx, cy = (lens.cx + 0.5) * scale - 0.5, (lens.cy + 0.5) * scale - 0.5 + top_px
        return replace(lens, fx=lens.fx * scale, fy=lens.fy * scale, cx=cx, cy=cy)

    left, right = resize(calibration.left), resize(calibration.right)
    return replace(calibration, width=width, height=height, left=left, right=right)


def rig_cameras(rig: RigSpec, cam_from_world: Float64[ndarray, "4 4"]) -> dict[str, Camera]:
    """Return the cameras of a rig as ``{"left": ..., "right": ...}``.

    ``cam_from_world`` is the pose of the physical left camera, as given by the trajectory. On the ``raw`` grid the
    cameras are the physical lenses including their distortion. On the ``rectified`` grid they are the parallel
    pinholes of ``rectification.rectify``: the camera centres are the same but the axes are rotated, so the left
    pose differs from ``cam_from_world``. A calibration of parallel pinholes is used as it is on every grid.

    Raises ``ValueError`` for a grid other than ``ideal`` without a calibration, for a calibration of other cameras
    than parallel pinholes on a grid other than these two, and for a ``baseline_m`` that differs from that of the
    calibration.
    """
    left, no_distortion = cam_from_world, np.zeros(5)
    if rig.calibration is None:
        if rig.grid != "ideal":
            raise ValueError(f"a rig with grid {rig.grid!r} requires a calibration")
        focal_px = rig.focal_px if isinstance(rig, FocalRigSpec) else NOMINAL_FOCAL_PX
        Ks = [ideal_K(rig.width, rig.height, focal_px)] * 2
        distortions, poses = [no_distortion] * 2, [left, right_camera_pose(left, rig.baseline_m)]
    else:
        if not isclose(rig.baseline_m, rig.calibration.baseline_m, rel_tol=1e-12):
            found = f"the rig's baseline_m is {rig.baseline_m}"
            raise ValueError(f"{found}, expected {rig.calibration.baseline_m} as in its calibration")
        is_rotated = rig.grid != "raw" and not rig.calibration.is_rectified
        # The whole images are rectified, so that rows that are cropped or added change no focal length.
        whole = round(rig.calibration.height * rig.width / rig.calibration.width)
        height = whole if is_rotated else rig.height
        pair = resized(rig.calibration, rig.width, height)
        lenses = (pair.left, pair.right)
        Ks, distortions = [lens.K for lens in lenses], [np.array(lens.distortion) for lens in lenses]
        poses = [left, matrix_product(pair.right_from_left, left)]
        if is_rotated:
            if rig.grid != "rectified":
                raise ValueError(f"the grid of a calibrated rig is {rig.grid!r}, expected 'raw' or 'rectified'")
            from rebar_depth_bench.geometry.rectification import rectify

            K, (R_left, _) = rectify(Ks, distortions, pair.right_from_left, rig.width, height)
            K[1, 2] += (rig.height - height) / 2
            left = matrix_product(rigid(R_left, np.zeros(3)), left)
            Ks, distortions, poses = [K] * 2, [no_distortion] * 2, [left, right_camera_pose(left, rig.baseline_m)]
    return {
        eye: Camera(K, distortion, pose, rig.width, rig.height)
        for eye, K, distortion, pose in zip(EYES, Ks, distortions, poses, strict=True)
    }
