"""Axes of visible bars, fitted to predicted depth and compared with the true ones. Frame: the camera's, metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.extended.inspection.cylinder_fit import CylinderFits, fit_cylinders
from rebar_depth_bench.extended.inspection.measures import MIN_PREDICTED_SHARE, MISS_MM
from rebar_depth_bench.extended.inspection.visible_segments import VisibleSegments

MAX_DEPTH_M = 1e6
"""Upper bound applied to predicted depth, metres, so that its squares do not overflow."""


@dataclass(frozen=True, eq=False)
class FittedAxes:
    """Fitted axis of each visible segment and its deviation from the true axis.

    ``found`` marks the segments whose axis was accepted. An axis is a point and a unit direction in the camera
    frame. ``offset_m`` is the distance of the fitted axis from the middle of the visible part of the true one.
    ``diameter_m`` is NaN where it was not fitted.
    """

    found: Bool[ndarray, " r"]
    point_m: Float64[ndarray, "r 3"]
    direction: Float64[ndarray, "r 3"]
    offset_m: Float64[ndarray, " r"]
    tilt_deg: Float64[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]


def fit_axes(
    p_m: Float64[ndarray, " n"], visible: VisibleSegments, fit_diameter: Bool[ndarray, " r"]
) -> FittedAxes:
    """Return the axis of each visible segment, a cylinder of its nominal diameter fitted to predicted depth.

    ``p_m`` is planar depth at the pixels of ``SteelTruth``, metres; values that are not finite and > 0 are
    missing. Where ``fit_diameter`` is set, a cylinder with a free radius is fitted as well, for its diameter.
    """
    points_m, predicted = _predicted_points_m(p_m, visible)
    start_m = _initial_offset_m(points_m, predicted, visible)
    fits = fit_cylinders(points_m, predicted, start_m, visible.half_m, visible.diameter_m / 2, fit_diameter)
    return _compare_with_truth(fits, predicted, visible)


def with_misses(error: Float64[ndarray, " n"], miss: float = MISS_MM) -> Float64[ndarray, " n"]:
    """Return absolute errors, capped at ``miss``, and ``miss`` for what was not found (NaN)."""
    return np.where(np.isnan(error), miss, np.minimum(np.abs(error), miss))


def _predicted_points_m(
    p_m: Float64[ndarray, " n"], visible: VisibleSegments
) -> tuple[Float64[ndarray, "r k 3"], Bool[ndarray, "r k"]]:
    """Return the predicted points of each visible segment in its own frame, and which of them exist.

    A point's position along the axis is taken from the true point of its pixel, not from the predicted depth:
    where a bar runs away from the camera, depth noise would shift points along and away from the camera together
    and tilt the fitted axis.
    """
    depth_m = p_m.take(visible.pixels)
    with np.errstate(invalid="ignore"):
        predicted = visible.used & np.isfinite(depth_m) & (depth_m > 0)
        known_m = np.where(predicted, np.minimum(depth_m, MAX_DEPTH_M), 0.0)
    points_m = visible.local_points_m(known_m)
    points_m[..., 2] = visible.truth_m[..., 2]
    return points_m, predicted


def _initial_offset_m(
    points_m: Float64[ndarray, "r k 3"], predicted: Bool[ndarray, "r k"], visible: VisibleSegments
) -> Float64[ndarray, "r 2"]:
    """Return the start of each fit: the median displacement (across, away) of predicted from true points."""
    displacement_m = np.where(predicted[..., None], (points_m - visible.truth_m)[..., :2], np.inf)
    ordered_m = np.sort(displacement_m, axis=1)
    count = predicted.sum(axis=1)
    lower, upper = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, np.maximum(count - 1, 0))
    row = np.arange(len(count))
    median_m = (ordered_m[row, lower] + ordered_m[row, upper]) / 2
    return np.where((count > 0)[:, None], median_m, 0.0)


def _compare_with_truth(
    fits: CylinderFits, predicted: Bool[ndarray, "r k"], visible: VisibleSegments
) -> FittedAxes:
    """Return the fitted axes in the camera frame and their deviations from the true ones."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared_slope = (fits.slope**2).sum(axis=1)
        lean_m = (fits.offset_m * fits.slope).sum(axis=1)
        offset_m = np.sqrt(np.maximum((fits.offset_m**2).sum(axis=1) - lean_m**2 / (1 + squared_slope), 0.0))
        enough = predicted.sum(axis=1) >= MIN_PREDICTED_SHARE * visible.used.sum(axis=1)
        to_end_m = fits.slope * visible.half_m[:, None]
        ends_m = (np.linalg.norm(fits.offset_m + side * to_end_m, axis=1) for side in (-1, 1))
        farthest_m = np.maximum(offset_m, np.maximum(*ends_m))
        found = enough & fits.converged & (farthest_m < visible.match_radius_m)
        local = np.column_stack([fits.slope, np.ones(len(fits.slope))]) / np.sqrt(1 + squared_slope)[:, None]
        return FittedAxes(
            found=found,
            point_m=visible.middle_m + np.einsum("rc,rci->ri", fits.offset_m, visible.frame[:, :2]),
            direction=np.einsum("rc,rci->ri", local, visible.frame),
            offset_m=offset_m,
            tilt_deg=np.rad2deg(np.arctan(np.sqrt(squared_slope))),
            diameter_m=fits.diameter_m,
        )
