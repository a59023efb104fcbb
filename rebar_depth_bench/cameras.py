"""Pinhole cameras in OpenCV axes: x right, y down, z forward, pixel centres at integer coordinates.

Lengths are metres, pixels are ``(u, v)`` with u along the width, and a pose is ``cam_from_world``,
a float64 4 x 4 with ``x_cam = cam_from_world @ x_world``.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

NOMINAL_WIDTH = 1280
NOMINAL_HEIGHT = 720
NOMINAL_FOCAL_PX = 700.0
"""Focal length of the first-generation ZED at HD720 (nominal, Stereolabs)."""


def ideal_K(width: int, height: int) -> Float[ndarray, "3 3"]:
    """Return the ideal pinhole matrix of a ``width`` x ``height`` grid, in pixels.

    The nominal 700 px at 1280 x 720 scales with each side; the principal point is the grid's centre.
    """
    fx = NOMINAL_FOCAL_PX * width / NOMINAL_WIDTH
    fy = NOMINAL_FOCAL_PX * height / NOMINAL_HEIGHT
    return np.array([[fx, 0.0, (width - 1) / 2], [0.0, fy, (height - 1) / 2], [0.0, 0.0, 1.0]])


def look_at(
    eye_m: Float[ndarray, 3], target_m: Float[ndarray, 3], up: Float[ndarray, 3] | None = None
) -> Float[ndarray, "4 4"]:
    """Return ``cam_from_world`` of a camera at ``eye_m`` whose optical axis passes through ``target_m``.

    ``up`` (world z by default) points up in the image. Raises ``ValueError`` where the optical axis
    is parallel to it.
    """
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    forward = np.asarray(target_m, float) - np.asarray(eye_m, float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    norm = np.linalg.norm(right)
    if norm < 1e-9:
        raise ValueError(f"the optical axis {forward} is parallel to the up direction {up}")
    right /= norm
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid(rotation, -rotation @ np.asarray(eye_m, float))


def rigid(rotation: Float[ndarray, "3 3"], translation: Float[ndarray, 3]) -> Float[ndarray, "4 4"]:
    """Return the 4 x 4 matrix of ``x -> rotation @ x + translation``."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def inverse_rigid(pose: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Return the inverse of a rigid 4 x 4 matrix, by transposition and so without loss of rigidity."""
    return rigid(pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3])


def camera_centre(cam_from_world: Float[ndarray, "4 4"]) -> Float[ndarray, 3]:
    """Return the camera's centre in the world frame, metres."""
    return inverse_rigid(cam_from_world)[:3, 3]


def right_of_rig(left_cam_from_world: Float[ndarray, "4 4"], baseline_m: float) -> Float[ndarray, "4 4"]:
    """Return the right camera's ``cam_from_world``: parallel, ``baseline_m`` along the left one's x axis."""
    pose = left_cam_from_world.copy()
    pose[0, 3] -= baseline_m
    return pose


def transform(pose: Float[ndarray, "4 4"], points: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Apply a 4 x 4 pose to points."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def project(K: Float[ndarray, "3 3"], points_cam: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 2"]:
    """Project camera-frame points (metres, z > 0) to pixels ``(u, v)``."""
    homogeneous = points_cam @ K.T
    return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])


def pixel_rays(
    K: Float[ndarray, "3 3"], width: int, height: int, distortion: Float[ndarray, " 5"] | None = None
) -> Float[ndarray, "h w 3"]:
    """Return ``((u - cx)/fx, (v - cy)/fy, 1)`` at every pixel centre: a ray's parameter is planar depth."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
