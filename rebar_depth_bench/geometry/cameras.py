"""Cameras in OpenCV axes: x right, y down, z forward, pixel centres at integer coordinates; lens distortion.

Lengths are metres, pixels are ``(u, v)`` with u along the width, and a pose is ``cam_from_world``,
a float64 4 x 4 with ``x_cam = cam_from_world @ x_world``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

NOMINAL_WIDTH = 1280
NOMINAL_HEIGHT = 720
NOMINAL_FOCAL_PX = 700.0
"""Focal length of the first-generation ZED at HD720 (nominal, Stereolabs)."""

_NEWTON_STEPS = 50
_NEWTON_TOLERANCE = 1e-15
_NEWTON_CHUNK = 8192
_INVERSE_TOLERANCE = 1e-14


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


def rotation_matrix(rotation_rad: Sequence[float] | Float[ndarray, 3]) -> Float64[ndarray, "3 3"]:
    """Return the matrix of a rotation vector: axis times angle, radians (Rodrigues' formula)."""
    vector = np.asarray(rotation_rad, dtype=np.float64)
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross))


def rotation_vector(rotation: Float[ndarray, "3 3"]) -> Float64[ndarray, 3]:
    """Return the rotation vector of a 3 x 3 rotation by less than half a turn: ``rotation_matrix`` undone."""
    skew = (rotation - rotation.T) / 2
    sine_axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]], dtype=np.float64)
    sine, cosine = float(np.linalg.norm(sine_axis)), (float(np.trace(rotation)) - 1.0) / 2
    return sine_axis if sine == 0.0 else np.asarray(sine_axis * (np.arctan2(sine, cosine) / sine))


def project(
    K: Float[ndarray, "3 3"],
    points_cam: Float[ndarray, "*n 3"],
    distortion: Float[ndarray, 5] | None = None,
) -> Float[ndarray, "*n 2"]:
    """Project camera-frame points (metres, z > 0) to pixels ``(u, v)``; ``distortion`` as for ``distort``."""
    if distortion is None or not np.any(distortion):
        homogeneous = points_cam @ K.T
        return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])
    distorted = distort(points_cam[..., :2] / points_cam[..., 2:], distortion)
    return np.asarray(distorted @ K[:2, :2].T + K[:2, 2])


def pixel_rays(
    K: Float[ndarray, "3 3"], width: int, height: int, distortion: Float[ndarray, 5] | None = None
) -> Float[ndarray, "h w 3"]:
    """Return the ray ``(x, y, 1)`` of every pixel centre, camera frame: a ray's parameter is planar depth.

    Without distortion that is ``((u - cx)/fx, (v - cy)/fy, 1)``, and these ``undistort``-ed with it, which
    raises ``ValueError`` where the lens model cannot be inverted.
    """
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    if distortion is not None and np.any(distortion):
        x, y = np.moveaxis(undistort(np.stack([x, y], axis=-1), distortion), -1, 0)
    return np.stack([x, y, np.ones_like(u)], axis=-1)


def distort(points_xy: Float[ndarray, "*n 2"], distortion: Float[ndarray, 5]) -> Float64[ndarray, "*n 2"]:
    """Return where a lens images the rays ``(x, y, 1)``, on the plane z = 1 (Brown-Conrady).

    ``distortion`` is k1 k2 p1 p2 k3 as OpenCV defines them (calib3d's camera model):
    ``x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)``, and the like for y with p1, p2 swapped.
    """
    k1, k2, p1, p2, k3 = (float(term) for term in distortion)
    points = np.asarray(points_xy, dtype=np.float64)
    x, y = points[..., 0], points[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    cross = x * y
    return np.stack(
        [
            x * radial + 2.0 * p1 * cross + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * cross,
        ],
        axis=-1,
    )


def undistort(points_xy: Float[ndarray, "*n 2"], distortion: Float[ndarray, 5]) -> Float64[ndarray, "*n 2"]:
    """Return the rays ``(x, y)`` that ``distort`` sends to ``points_xy``, to float64 rounding.

    Newton's method on both coordinates, from the distorted point. Raises ``ValueError`` where it does not
    converge, and where it ends beyond the radius at which the model folds back: such points no ray reaches.
    """
    wanted = np.asarray(points_xy, dtype=np.float64).reshape(-1, 2)
    found, sound = np.empty_like(wanted), np.empty(len(wanted), dtype=bool)
    fold = fold_radius(distortion)
    for start in range(0, len(wanted), _NEWTON_CHUNK):  # as many points at once as a cache holds
        part = slice(start, start + _NEWTON_CHUNK)
        found[part] = _newton(wanted[part], distortion)
        sound[part] = _is_inverse(found[part], wanted[part], distortion, fold)
    if not sound.all():
        first = wanted[np.flatnonzero(~sound)[0]]
        raise ValueError(
            f"the lens model k1 k2 p1 p2 k3 = {[float(term) for term in distortion]} cannot be inverted at"
            f" {int((~sound).sum())} of {len(wanted)} points, first at (x, y) = ({first[0]:.6g}, {first[1]:.6g})"
            f" on the plane z = 1; it folds back at the radius {fold:.6g}"
        )
    return found.reshape(np.shape(points_xy))


def _newton(wanted: Float64[ndarray, "n 2"], distortion: Float[ndarray, 5]) -> Float64[ndarray, "n 2"]:
    found = wanted.copy()
    with np.errstate(all="ignore"):  # points that run away are told of in words by ``undistort``
        for _ in range(_NEWTON_STEPS):
            off_x, off_y = np.moveaxis(distort(found, distortion) - wanted, -1, 0)
            by_xx, by_xy, by_yy = _jacobian(found, distortion)
            determinant = by_xx * by_yy - by_xy * by_xy
            step_x = (by_yy * off_x - by_xy * off_y) / determinant
            step_y = (by_xx * off_y - by_xy * off_x) / determinant
            found -= np.stack([step_x, step_y], axis=-1)
            if not max(np.abs(step_x).max(initial=0.0), np.abs(step_y).max(initial=0.0)) > _NEWTON_TOLERANCE:
                break
    return found


def _jacobian(
    points_xy: Float64[ndarray, "n 2"], distortion: Float[ndarray, 5]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the derivatives xx, xy (= yx) and yy of ``distort`` at points."""
    k1, k2, p1, p2, k3 = (float(term) for term in distortion)
    x, y = points_xy[:, 0], points_xy[:, 1]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    growth = 2.0 * (k1 + square * (2.0 * k2 + square * (3.0 * k3)))  # of ``radial``, by x, over x
    xx = radial + growth * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + growth * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, growth * x * y + 2.0 * p1 * x + 2.0 * p2 * y, yy


def _is_inverse(
    found: Float64[ndarray, "n 2"], wanted: Float64[ndarray, "n 2"], distortion: Float[ndarray, 5], fold: float
) -> Bool[ndarray, " n"]:
    """Tell which ``found`` points the model sends to ``wanted`` ones, on the near side of its fold."""
    with np.errstate(all="ignore"):
        off = np.abs(distort(found, distortion) - wanted).max(axis=1)
        xx, xy, yy = _jacobian(found, distortion)
        reached = off <= _INVERSE_TOLERANCE * (1.0 + np.abs(wanted).max(axis=1))
        return np.asarray(reached & (np.hypot(found[:, 0], found[:, 1]) < fold) & (xx * yy > xy * xy))


def fold_radius(distortion: Float[ndarray, 5]) -> float:
    """Return the undistorted radius (plane z = 1) at which the radial model stops growing; infinity if never."""
    k1, k2, _, _, k3 = (float(term) for term in distortion)
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of d/dr r (1 + k1 r^2 + k2 r^4 + k3 r^6), in r^2
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(squares.min(initial=np.inf)))
