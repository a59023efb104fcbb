"""Cover of bars: the distance of a bar's surface from a plane of formwork, both as predicted.

A camera that sees a bar and the form behind it sees both ends of the cover. The form is measured on pixels whose
true points are on the plane; a plane is fitted to the predicted depth of these pixels, by Gauss-Newton steps on
planar depth with Tukey's biweight, as for cylinders. Which pixels show the plane is taken from the ground truth.
Frame: the camera's, metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.data.schema import FormPlane
from rebar_depth_bench.extended.fits import (
    MAX_DEPTH_M,
    MIN_PREDICTED_SHARE,
    PRIOR_WEIGHT,
    SIGMA_PER_MAD,
    TUKEY_CONSTANT,
)
from rebar_depth_bench.extended.judged import VisibleSegments, spread
from rebar_depth_bench.extended.steel import PLANE_PIXELS, CoverPixels
from rebar_depth_bench.geometry.cameras import transform
from rebar_depth_bench.scoring.metrics import is_valid_prediction
from rebar_depth_bench.scoring.protocol import interior

MAX_OFF_PLANE_M = 0.001
"""Largest distance of the true point of a plane pixel, and of its 5 x 5 neighbours, from the plane."""

MAX_FROM_BAR_M = 0.5
"""Largest distance of a plane pixel's true point from the middle of the visible part of the bar."""

MIN_COVER_M = 0.010
"""Least true cover that is judged. Steel that lies on the ground has no cover."""

PLANE_STEPS, MAX_LAST_STEP_M = 12, 1e-4
"""Gauss-Newton steps of a plane, and how far the last of them may move it in depth, at any of its pixels."""

MIN_PLANE_SIGMA_M = 1e-4
"""Lower bound of the noise scale of a plane."""


def camera_planes(planes: Sequence[FormPlane], cam_from_world: Float64[ndarray, "4 4"]) -> Float64[ndarray, "p 3"]:
    """Return each plane n x = d as n / d, NaN where the camera is not on the side of the steel."""
    points_m = transform(cam_from_world, np.array([plane.point_m for plane in planes]).reshape(-1, 3))
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3) @ cam_from_world[:3, :3].T
    offset_m = np.einsum("pi,pi->p", normals, points_m)
    return np.asarray(normals / np.where(offset_m < -MAX_OFF_PLANE_M, offset_m, np.nan)[:, None])


def plane_distances_m(
    plane: Float64[ndarray, "*r 3"], points_m: Float64[ndarray, "*n 3"]
) -> Float64[ndarray, " *n"]:
    """Return the distances of points from planes n / d, > 0 on the side of the camera."""
    return np.asarray((1 - (plane * points_m).sum(axis=-1)) / np.linalg.norm(plane, axis=-1))


def judged_covers(
    depth_m: Float32[ndarray, "h w"],
    rays: Float64[ndarray, "hw 2"],
    visible: VisibleSegments,
    planes: Float64[ndarray, "p 3"],
) -> tuple[Int64[ndarray, " r"], Int64[ndarray, " r"], Int64[ndarray, "r k"]]:
    """Return the segment, the plane and the plane pixels of each visible bar whose cover is judged.

    ``depth_m`` is true planar depth and ``rays`` are x/z and y/z of all pixels, ``planes`` are ``camera_planes``.
    A bar is judged by the nearest plane from which its cover is ``MIN_COVER_M`` or more and that has
    ``PLANE_PIXELS`` within ``MAX_FROM_BAR_M`` of it, of which that number is taken, evenly spread.
    """
    z_m = depth_m.ravel().astype(np.float64)
    nearest_m = np.full(len(visible.segment), np.inf)
    plane_of = np.full(len(visible.segment), -1)
    pixels = np.zeros((len(visible.segment), PLANE_PIXELS), np.int64)
    for place, plane in enumerate(planes):
        if np.isnan(plane).any():
            continue
        off_m = (1 - z_m * (rays @ plane[:2] + plane[2])) / np.linalg.norm(plane)
        is_flat = (z_m > 0) & (np.abs(off_m) <= MAX_OFF_PLANE_M)
        on_plane = np.flatnonzero(interior(interior(is_flat.reshape(depth_m.shape))))
        points_m = z_m[on_plane, None] * np.column_stack([rays[on_plane], np.ones(len(on_plane))])
        cover_m = plane_distances_m(plane, visible.middle_m) - visible.diameter_m / 2
        for row in np.flatnonzero((cover_m >= MIN_COVER_M) & (cover_m < nearest_m)):
            near = on_plane[np.linalg.norm(points_m - visible.middle_m[row], axis=1) <= MAX_FROM_BAR_M]
            if len(near) >= PLANE_PIXELS:
                nearest_m[row], plane_of[row] = cover_m[row], place
                pixels[row] = near[spread(len(near), PLANE_PIXELS)]
    judged = plane_of >= 0
    return visible.segment[judged], plane_of[judged], pixels[judged]


def fit_planes(p_m: Float64[ndarray, "r k"], covers: CoverPixels) -> Float64[ndarray, "r 3"]:
    """Return the planes n / d fitted to predicted planar depth ``p_m`` of the plane pixels.

    Each fit starts at the true plane, scaled to the median ratio of true and predicted depth. The plane is NaN
    with predictions on less than ``MIN_PREDICTED_SHARE`` of the pixels, and where the last step moves it by more
    than ``MAX_LAST_STEP_M`` at any of them.
    """
    predicted = is_valid_prediction(p_m)
    chosen = np.flatnonzero(predicted.sum(axis=1) >= MIN_PREDICTED_SHARE * PLANE_PIXELS)
    planes = np.full((len(p_m), 3), np.nan)
    if not len(chosen):
        return planes
    used, rays = predicted[chosen], covers.rays[chosen]
    directions = np.concatenate([rays, np.ones((*used.shape, 1))], axis=2)
    z_m = np.where(used, np.minimum(p_m[chosen], MAX_DEPTH_M), 1.0)
    with np.errstate(all="ignore"):
        scale = _medians(covers.depth_m[chosen] / z_m, used)
        plane = covers.plane[chosen] * scale[:, None]
        for _ in range(PLANE_STEPS):
            fitted_m = 1 / np.einsum("rki,ri->rk", directions, plane)
            residual_m = z_m - fitted_m
            sigma_m = np.maximum(SIGMA_PER_MAD * _medians(np.abs(residual_m), used), MIN_PLANE_SIGMA_M)
            weight = np.maximum(1 - (residual_m / (TUKEY_CONSTANT * sigma_m[:, None])) ** 2, 0.0) ** 2
            weight = np.where(used & (fitted_m > 0), weight, 0.0)
            jacobian = -(fitted_m**2)[..., None] * directions
            weighted = weight[..., None] * jacobian
            normal = np.einsum("rki,rkj->rij", weighted, jacobian)
            normal += PRIOR_WEIGHT**2 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            right_side = np.einsum("rki,rk->ri", weighted, residual_m)
            is_sound = np.isfinite(normal).all(axis=(1, 2)) & (np.trace(normal, axis1=1, axis2=2) > 0)
            step = np.linalg.solve(np.where(is_sound[:, None, None], normal, np.eye(3)), right_side[..., None])
            plane = np.where(is_sound[:, None], plane + step[..., 0], np.nan)
        moved_m = np.where(used, np.abs(1 / np.einsum("rki,ri->rk", directions, plane) - fitted_m), 0.0)
        is_settled = moved_m.max(axis=1) <= MAX_LAST_STEP_M  # NaN is not.
    planes[chosen[is_settled]] = plane[is_settled]
    return planes


def _medians(values: Float64[ndarray, "r k"], used: Bool[ndarray, "r k"]) -> Float64[ndarray, " r"]:
    """Return the median of the used values of each row; for an even count, the upper of the two middle ones."""
    ordered = np.sort(np.where(used, values, np.inf), axis=1)
    return np.take_along_axis(ordered, used.sum(axis=1)[:, None] // 2, axis=1)[:, 0]
