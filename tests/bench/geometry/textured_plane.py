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


def plane_depth_m(rays_left: Float64[ndarray, "h w 3"]) -> Float64[ndarray, "h w"]:
    """Return the planar depth of the plane along rays of the left camera."""
    return np.asarray(OFFSET_M / (rays_left @ NORMAL_CAM))


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
    right_pose = calibration.right_from_left
    left = pixel_rays(calibration.left.K, WIDTH, HEIGHT, np.array(calibration.left.distortion))
    left_from_right = inverse_rigid(right_pose)
    right = pixel_rays(calibration.right.K, WIDTH, HEIGHT, np.array(calibration.right.distortion))
    right_rays, right_centre_m = right @ left_from_right[:3, :3].T, left_from_right[:3, 3]
    right_depth_m = (OFFSET_M - right_centre_m @ NORMAL_CAM) / (right_rays @ NORMAL_CAM)
    depth_m = plane_depth_m(left)
    return {
        "left_rgb": texture_rgb(left * depth_m[..., None]),
        "right_rgb": texture_rgb(right_rays * right_depth_m[..., None] + right_centre_m),
        "left_K": calibration.left.K,
        "right_K": calibration.right.K,
        "left_distortion": np.array(calibration.left.distortion),
        "right_distortion": np.array(calibration.right.distortion),
        "left_cam_from_world": LEFT_CAM_FROM_WORLD,
        "right_cam_from_world": right_pose @ LEFT_CAM_FROM_WORLD,
        "baseline_m": float(np.linalg.norm(right_pose[:3, 3])),
        "depth_m": depth_m,
    }


def ideal_row() -> dict[str, Any]:
    """Return the same of a pair of ideal pinholes."""
    K = ideal_K(WIDTH, HEIGHT)
    rays = pixel_rays(K, WIDTH, HEIGHT)
    right_centre_m = np.array([0.12, 0.0, 0.0])
    right_depth_m = (OFFSET_M - right_centre_m @ NORMAL_CAM) / (rays @ NORMAL_CAM)
    depth_m = plane_depth_m(rays)
    return {
        "left_rgb": texture_rgb(rays * depth_m[..., None]),
        "right_rgb": texture_rgb(rays * right_depth_m[..., None] + right_centre_m),
        "left_K": K,
        "right_K": K,
        "left_distortion": np.zeros(5),
        "right_distortion": np.zeros(5),
        "left_cam_from_world": LEFT_CAM_FROM_WORLD,
        "right_cam_from_world": right_camera_pose(LEFT_CAM_FROM_WORLD, 0.12),
        "baseline_m": 0.12,
        "depth_m": depth_m,
    }
