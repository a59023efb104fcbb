"""Pinhole cameras with lens distortion: intrinsics, poses, projection and undistortion.

Camera axes are OpenCV's: x right, y down, z forward, with pixel centres at integer coordinates. Lengths are
metres, pixels are ``(u, v)`` with u along the width, and a pose is ``cam_from_world``, a float64 4 x 4 matrix with
``x_cam = cam_from_world @ x_world``.

Poses do not depend on the processor to the last bit: BLAS, which has other kernels for each, multiplies none of
them (``matrix_product``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, sin
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

NOMINAL_WIDTH = 1280
NOMINAL_HEIGHT = 720
NOMINAL_FOCAL_PX = 700.0
"""Nominal focal length of the first-generation ZED at HD720, pixels (Stereolabs)."""

HALF_PIXEL = 0.5
"""Offset of COLMAP's and nerfstudio's pixel coordinates from ours, pixels."""

ROTATION_TOLERANCE = 1e-6
"""Largest deviation of ``R @ R.T`` from the identity for a rotation ``R``."""

_MOTION_DECIMALS = 12
PARALLEL_TOLERANCE = 1e-9
"""Largest deviation of an entry of ``right_from_left`` from that of a rectified pair."""

_NEWTON_STEPS = 50
_NEWTON_TOLERANCE = 1e-15
_NEWTON_CHUNK = 8192
_INVERSE_TOLERANCE = 1e-14


@dataclass(frozen=True, eq=False)
class Camera:
    """Camera of one eye of a view: pinhole matrix ``K``, ``width`` and ``height`` in pixels, pose, distortion.

    ``distortion`` holds k1 k2 p1 p2 k3 (see ``distort``), zeros without distortion.
    """

    K: Float64[ndarray, "3 3"]
    distortion: Float64[ndarray, " 5"]
    cam_from_world: Float64[ndarray, "4 4"]
    width: int
    height: int

    def rays(self) -> Float[ndarray, "h w 3"]:
        """Return the ``pixel_rays`` of the camera. Raises ``ValueError`` as that does."""
        return pixel_rays(self.K, self.width, self.height, self.distortion)


def ideal_K(width: int, height: int, focal_px: float = NOMINAL_FOCAL_PX) -> Float[ndarray, "3 3"]:
    """Return the ideal pinhole matrix of a ``width`` x ``height`` image, in pixels.

    Pixels are square: ``focal_px``, the focal length of an image 1280 pixels wide, is scaled with the width. The
    principal point is the image centre.
    """
    focal_px = focal_px * width / NOMINAL_WIDTH
    return np.array([[focal_px, 0.0, (width - 1) / 2], [0.0, focal_px, (height - 1) / 2], [0.0, 0.0, 1.0]])


def look_at(
    eye_m: Float[ndarray, 3], target_m: Float[ndarray, 3], up: Float[ndarray, 3] | None = None
) -> Float[ndarray, "4 4"]:
    """Return ``cam_from_world`` of a camera at ``eye_m`` whose optical axis passes through ``target_m``.

    ``up`` (world z by default) points up in the image. Raises ``ValueError`` if the optical axis is parallel to
    ``up``.
    """
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    forward = np.asarray(target_m, float) - np.asarray(eye_m, float)
    forward /= vector_length(forward)
    right = np.cross(forward, up)
    norm = vector_length(right)
    if norm < 1e-9:
        raise ValueError(f"the optical axis {forward} is parallel to the up direction {up}")
    right /= norm
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid(rotation, matrix_product(-rotation, np.asarray(eye_m, float)))


def matrix_product(a: Float[ndarray, "*n k"], b: Float[ndarray, "k ..."]) -> Float[ndarray, ...]:
    """Return ``a @ b``, for a vector or matrix ``b``, with the same bits on every processor."""
    return np.asarray(np.einsum("...k,k->..." if b.ndim == 1 else "...k,km->...m", a, b))


def vector_length(vector: Float[ndarray, " k"]) -> float:
    """Return the Euclidean norm of a vector, with the same bits on every processor."""
    return float(np.sqrt(np.einsum("k,k->", vector, vector)))


def rigid(rotation: Float[ndarray, "3 3"], translation: Float[ndarray, 3]) -> Float[ndarray, "4 4"]:
    """Return the 4 x 4 matrix of ``x -> rotation @ x + translation``."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def inverse_rigid(pose: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Return the inverse of a rigid 4 x 4 matrix, computed by transposition, so that it is rigid as well."""
    return rigid(pose[:3, :3].T, matrix_product(-pose[:3, :3].T, pose[:3, 3]))


def is_rotation(matrix: Float[ndarray, "3 3"], tolerance: float = ROTATION_TOLERANCE) -> bool:
    """Return whether a 3 x 3 matrix times its transpose is the identity within ``tolerance``, and is no mirror."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(error <= tolerance and np.linalg.det(matrix) > 0)  # The error of NaN is NaN.


def is_rigid(pose: Float[ndarray, "4 4"], tolerance: float = ROTATION_TOLERANCE) -> bool:
    """Return whether a 4 x 4 matrix holds a rotation (``is_rotation``), a finite translation and 0 0 0 1."""
    is_motion = np.isfinite(pose).all() and (pose[3] == (0, 0, 0, 1)).all()
    return bool(is_motion) and is_rotation(pose[:3, :3], tolerance)


def nearest_rotation(matrix: Float[ndarray, "3 3"]) -> Float64[ndarray, "3 3"]:
    """Return the rotation nearest to one that was rounded to a few digits."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt)


def camera_centre(cam_from_world: Float[ndarray, "4 4"]) -> Float[ndarray, 3]:
    """Return the camera centre in the world frame, metres."""
    return inverse_rigid(cam_from_world)[:3, 3]


def swap_camera_axes(cam_from_world: Float[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
    """Return a pose in OpenGL's camera axes (x right, y up, z backwards) from one in OpenCV's, or the reverse."""
    return np.asarray(np.diag([1.0, -1.0, -1.0, 1.0]) @ cam_from_world)


def right_camera_pose(left_cam_from_world: Float[ndarray, "4 4"], baseline_m: float) -> Float[ndarray, "4 4"]:
    """Return ``cam_from_world`` of a right camera parallel to the left one, ``baseline_m`` along its x axis."""
    pose = left_cam_from_world.copy()
    pose[0, 3] -= baseline_m
    return pose


def right_from_left(row: Mapping[str, Any]) -> Float64[ndarray, "4 4"]:
    """Return the motion of the pair without the rounding errors of its poses, so that it is that of all views."""
    motion = row["right_cam_from_world"] @ inverse_rigid(row["left_cam_from_world"])
    return np.asarray(np.round(motion, _MOTION_DECIMALS))


def is_rectified(row: Mapping[str, Any]) -> bool:
    """Return whether a row's cameras are undistorted and parallel, and differ along the left one's x axis only.

    The principal points may differ in x, which is a constant of all disparities.
    """
    parallel = np.eye(4)
    parallel[0, 3] = -row["baseline_m"]
    differs = row["left_K"] != row["right_K"]
    differs[0, 2] = False
    has_lens = differs.any() or row["left_distortion"].any() or row["right_distortion"].any()
    return not has_lens and bool(np.abs(right_from_left(row) - parallel).max() <= PARALLEL_TOLERANCE)


def transform(pose: Float[ndarray, "4 4"], points: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """Apply a rigid 4 x 4 matrix to points."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def rotation_matrix(rotation_rad: Sequence[float] | Float[ndarray, 3]) -> Float64[ndarray, "3 3"]:
    """Return the rotation matrix of a rotation vector, axis times angle in radians (Rodrigues' formula)."""
    vector = np.asarray(rotation_rad, dtype=np.float64)
    angle = vector_length(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + sin(angle) * cross + (1.0 - cos(angle)) * matrix_product(cross, cross))


def rotation_vector(rotation: Float[ndarray, "3 3"]) -> Float64[ndarray, 3]:
    """Return the rotation vector (radians) of a rotation by less than half a turn (see ``rotation_matrix``)."""
    skew = (rotation - rotation.T) / 2
    sine_axis = np.array([skew[2, 1], skew[0, 2], skew[1, 0]], dtype=np.float64)
    sine, cosine = float(np.linalg.norm(sine_axis)), (float(np.trace(rotation)) - 1.0) / 2
    return sine_axis if sine == 0.0 else np.asarray(sine_axis * (np.arctan2(sine, cosine) / sine))


def project(
    K: Float[ndarray, "3 3"],
    points_cam: Float[ndarray, "*n 3"],
    distortion: Float[ndarray, 5] | None = None,
) -> Float[ndarray, "*n 2"]:
    """Project camera-frame points (metres, z > 0) to pixels ``(u, v)``; ``distortion`` is that of ``distort``."""
    if distortion is None or not np.any(distortion):
        homogeneous = points_cam @ K.T
        return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])
    distorted = distort(points_cam[..., :2] / points_cam[..., 2:], distortion)
    return np.asarray(distorted @ K[:2, :2].T + K[:2, 2])


def pixel_rays(
    K: Float[ndarray, "3 3"], width: int, height: int, distortion: Float[ndarray, 5] | None = None
) -> Float[ndarray, "h w 3"]:
    """Return the ray ``(x, y, 1)`` of every pixel centre in the camera frame; depth times ray is a point.

    Without distortion the ray is ``((u - cx)/fx, (v - cy)/fy, 1)``; with distortion, x and y are passed through
    ``undistort``. Raises ``ValueError`` if the distortion model cannot be inverted at a pixel.
    """
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
    if distortion is not None and np.any(distortion):
        x, y = np.moveaxis(undistort(np.stack([x, y], axis=-1), distortion), -1, 0)
    return np.stack([x, y, np.ones_like(u)], axis=-1)


def distort(points_xy: Float[ndarray, "*n 2"], distortion: Float[ndarray, 5]) -> Float64[ndarray, "*n 2"]:
    """Apply Brown-Conrady lens distortion to the rays ``(x, y, 1)``; returns points on the plane z = 1.

    ``distortion`` is k1 k2 p1 p2 k3 as OpenCV defines them (calib3d's camera model): x becomes
    ``x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)``, and y likewise with p1 and p2 swapped.
    """
    k1, k2, p1, p2, k3 = (float(term) for term in distortion)
    points = np.asarray(points_xy, dtype=np.float64)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    cross = x * y
    return np.stack(
        [
            x * radial + 2.0 * p1 * cross + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * cross,
        ],
        axis=-1,
    )


def undistort(points_xy: Float[ndarray, "*n 2"], distortion: Float[ndarray, 5]) -> Float64[ndarray, "*n 2"]:
    """Return the rays ``(x, y)`` that ``distort`` maps to ``points_xy``, to float64 rounding.

    Newton's method on both coordinates, started at the distorted point. Raises ``ValueError`` if it does not
    converge at a point or ends beyond the radius at which the model folds back (``fold_radius``): no ray is imaged
    there.
    """
    distorted_xy = np.asarray(points_xy, dtype=np.float64).reshape(-1, 2)
    rays_xy, is_valid = np.empty_like(distorted_xy), np.empty(len(distorted_xy), dtype=bool)
    fold_r = fold_radius(distortion)
    for start in range(0, len(distorted_xy), _NEWTON_CHUNK):  # A chunk fits into the CPU cache.
        chunk = slice(start, start + _NEWTON_CHUNK)
        rays_xy[chunk] = _newton_undistort(distorted_xy[chunk], distortion)
        is_valid[chunk] = _is_inverse(rays_xy[chunk], distorted_xy[chunk], distortion, fold_r)
    if not is_valid.all():
        bad = distorted_xy[np.flatnonzero(~is_valid)[0]]
        raise ValueError(
            f"the lens model k1 k2 p1 p2 k3 = {[float(term) for term in distortion]} cannot be inverted at"
            f" {int((~is_valid).sum())} of {len(distorted_xy)} points, first at (x, y) ="
            f" ({bad[0]:.6g}, {bad[1]:.6g}) on the plane z = 1; it folds back at the radius {fold_r:.6g}"
        )
    return rays_xy.reshape(np.shape(points_xy))


def _newton_undistort(
    distorted_xy: Float64[ndarray, "n 2"], distortion: Float[ndarray, 5]
) -> Float64[ndarray, "n 2"]:
    rays_xy = distorted_xy.copy()
    with np.errstate(all="ignore"):  # ``undistort`` checks for diverged points.
        for _ in range(_NEWTON_STEPS):
            error_x, error_y = np.moveaxis(distort(rays_xy, distortion) - distorted_xy, -1, 0)
            d_xx, d_xy, d_yy = _jacobian(rays_xy, distortion)
            determinant = d_xx * d_yy - d_xy * d_xy
            step_x = (d_yy * error_x - d_xy * error_y) / determinant
            step_y = (d_xx * error_y - d_xy * error_x) / determinant
            rays_xy -= np.stack([step_x, step_y], axis=-1)
            if not max(np.abs(step_x).max(initial=0.0), np.abs(step_y).max(initial=0.0)) > _NEWTON_TOLERANCE:
                break
    return rays_xy


def _jacobian(
    points_xy: Float64[ndarray, "n 2"], distortion: Float[ndarray, 5]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the partial derivatives xx, xy (= yx) and yy of ``distort`` at ``points_xy``."""
    k1, k2, p1, p2, k3 = (float(term) for term in distortion)
    x, y = points_xy[:, 0], points_xy[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    radial_slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3)))  # (d radial / dx) / x
    xx = radial + radial_slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    yy = radial + radial_slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return xx, radial_slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y, yy


def _is_inverse(
    rays_xy: Float64[ndarray, "n 2"],
    distorted_xy: Float64[ndarray, "n 2"],
    distortion: Float[ndarray, 5],
    fold: float,
) -> Bool[ndarray, " n"]:
    """Return a mask of the rays that ``distort`` maps to ``distorted_xy`` and that lie inside the fold radius."""
    with np.errstate(all="ignore"):
        error = np.abs(distort(rays_xy, distortion) - distorted_xy).max(axis=1)
        xx, xy, yy = _jacobian(rays_xy, distortion)
        reached = error <= _INVERSE_TOLERANCE * (1.0 + np.abs(distorted_xy).max(axis=1))
        return np.asarray(reached & (np.hypot(rays_xy[:, 0], rays_xy[:, 1]) < fold) & (xx * yy > xy * xy))


def fold_radius(distortion: Float[ndarray, 5]) -> float:
    """Return the undistorted radius on the plane z = 1 at which the distorted radius stops growing.

    Returns infinity if it grows everywhere.
    """
    k1, k2, _, _, k3 = (float(term) for term in distortion)
    terms = np.array([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # in r^2, of d/dr r (1 + k1 r^2 + k2 r^4 + k3 r^6)
    terms[np.abs(terms) < 1e-100] = 0.0  # np.roots divides by the first term that is not zero.
    roots = np.roots(terms)
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(np.sqrt(squares.min(initial=np.inf)))
