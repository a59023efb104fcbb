"""Textured plane of known depth, seen through two real lenses or two ideal ones."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.geometry.cameras import ideal_K, inverse_rigid, pixel_rays, right_camera_pose, rigid
from tests.bench.geometry.calibrations import SHIPPED_CALIBRATION

WIDTH, HEIGHT = 480, 270
LEFT_CAM_FROM_WORLD = rigid(cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0], np.array([0.02, -0.03, 0.01]))
NORMAL_CAM, OFFSET_M = np.array([0.15, -0.1, 1.0]), 0.45
"""Plane n . x = offset (metres) in the frame of the left raw camera, tilted in both directions."""


def plane_depth_m(
    rays_left: Float64[ndarray, "h w 3"], centre_m: Float64[ndarray, " 3"] | None = None
) -> Float64[ndarray, "h w"]:
    """Return the multiple of each ray at which it meets the plane: planar depth for rays of the left camera.

    Rays and their centre, by default that of the left camera, are in its frame.
    """
    before_m = 0.0 if centre_m is None else float(centre_m @ NORMAL_CAM)
    return np.asarray((OFFSET_M - before_m) / (rays_left @ NORMAL_CAM))


def texture_rgb(points_m: Float64[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """Return a 3D texture, a sum of waves of 12 to 40 mm length in all directions, at points of the left frame."""
    rng = np.random.default_rng(7)
    grey = np.zeros(points_m.shape[:2])
    for wavelength_m in np.linspace(0.012, 0.040, 24):
        direction = rng.normal(size=3)
        wave = points_m @ (direction / np.linalg.norm(direction)) * (2 * np.pi / wavelength_m)
        grey += np.sin(wave + rng.uniform(0, 2 * np.pi))
    grey = np.clip(127 + 25 * grey, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def raw_row() -> dict[str, Any]:
    """Return the row of a raw pair of the shipped ZED, with the exact depth of the left image (``depth_m``)."""
    calibration = read_calibration(SHIPPED_CALIBRATION, WIDTH, HEIGHT)
    left, right = calibration.left, calibration.right
    return _row([(lens.K, np.array(lens.distortion)) for lens in (left, right)], calibration.right_from_left)


def ideal_row() -> dict[str, Any]:
    """Return the same of a pair of ideal pinholes."""
    return _row([(ideal_K(WIDTH, HEIGHT), np.zeros(5))] * 2, right_camera_pose(np.eye(4), 0.12))


def _row(lenses: list[tuple[ndarray, ndarray]], right_from_left: Float64[ndarray, "4 4"]) -> dict[str, Any]:
    """Return the row of a pair whose lenses have these K and distortions."""
    row: dict[str, Any] = {"baseline_m": float(np.linalg.norm(right_from_left[:3, 3]))}
    for eye, (K, distortion), pose in zip(("left", "right"), lenses, (np.eye(4), right_from_left), strict=True):
        left_from_eye = inverse_rigid(pose)
        rays, centre_m = pixel_rays(K, WIDTH, HEIGHT, distortion) @ left_from_eye[:3, :3].T, left_from_eye[:3, 3]
        points_m = centre_m + rays * plane_depth_m(rays, centre_m)[..., None]
        row |= {f"{eye}_rgb": texture_rgb(points_m), f"{eye}_K": K, f"{eye}_distortion": distortion}
        row[f"{eye}_cam_from_world"] = pose @ LEFT_CAM_FROM_WORLD
    return row | {"depth_m": plane_depth_m(pixel_rays(lenses[0][0], WIDTH, HEIGHT, lenses[0][1]))}
