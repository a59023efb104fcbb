"""Axes of visible bars: robust cylinder fits to bar points seen from one side, with a fixed or a free radius.

Frame: each cylinder's own, metres, columns across (perpendicular to the line of sight and the axis), away (from
the camera), along (the axis). A line has two offsets and two slopes: at position ``t`` along, the axis is at
``offset_m + slope * t`` across and away.

The residual of a point is its distance in front of the visible surface, measured along the surface normal where
the point's line of sight meets the surface; for points beside the bar it also includes their lateral distance. On
the surface this equals the distance to the cylinder to first order. The plain distance to the cylinder is
unsuitable: behind the axis it measures to the far side, which no camera sees, and a noisy cloud wider than the
bar would be fitted by a cylinder in its middle.

Weights are Tukey's biweight (Beaton and Tukey, Technometrics 16, 1974) with a scale from the median absolute
residual. Depth constrains the lateral position of a bar only weakly; the pixels that show the bar determine it.
So the two lateral unknowns have a prior at their start with a standard deviation of ``LATERAL_PRIOR_RADII``
radii: for depth noise of a few hundredths of a radius it has no effect, for noise wider than the bar it
dominates. The other unknowns have a prior of weight ``PRIOR_WEIGHT`` times that of the points, so that no system
of equations is singular.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import Rows
from rebar_depth_bench.extended.judged import VisibleSegments
from rebar_depth_bench.scoring.metrics import is_valid_prediction

POSITION_STEPS = 6
"""Gauss-Newton steps on the axis with the radius fixed."""

RADIUS_STEPS = 6
"""Further Gauss-Newton steps with the radius free, after the axis is fitted."""

PRIOR_WEIGHT = 1e-6
"""Weight of the prior on every unknown, relative to the weight of the points."""

LATERAL_PRIOR_RADII = 0.25
"""Standard deviation of the prior on the lateral unknowns, in radii."""

TUKEY_CONSTANT = 4.685
"""Tuning constant of Tukey's biweight: 95 % efficiency under Gaussian noise."""

SIGMA_PER_MAD = 1.4826
"""Standard deviation per median absolute deviation of Gaussian noise."""

MIN_SIGMA_DIAMETERS = 0.02
"""Lower bound of the noise scale, in diameters: ribs belong to a bar and are not outliers."""

CONVERGENCE_TOLERANCE = 0.02
"""A fit has converged if its last step changed no unknown by more than this share of radius plus noise."""

MAX_FACE_RADII = 0.98
"""Points at more than this many radii to the side are beside the bar.

The surface there is nearly parallel to the line of sight.
"""

MIN_RADIUS_FACTOR = 0.1
"""Lower bound of a free radius, in nominal radii."""


@dataclass(frozen=True, eq=False)
class CylinderFits:
    """Cylinders fitted to r point sets; see the module docstring for the frame and the line parameters.

    ``diameter_m`` comes from a second fit with a free radius, NaN where it was not requested or did not converge.
    """

    offset_m: Float64[ndarray, "r 2"]
    slope: Float64[ndarray, "r 2"]
    converged: Bool[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]


def fit_cylinders(
    points_m: Float64[ndarray, "r k 3"],
    used: Bool[ndarray, "r k"],
    start_m: Float64[ndarray, "r 2"],
    half_m: Float64[ndarray, " r"],
    radius_m: Float64[ndarray, " r"],
    fit_radius: Bool[ndarray, " r"],
) -> CylinderFits:
    """Fit a cylinder of known radius to the ``used`` points of each set, by a fixed number of Gauss-Newton steps.

    The initial axis is parallel to the frame's third direction at ``start_m`` (across, away), which should be
    near the points. ``half_m`` is half the length of the set along the axis; it scales the slopes. Sets with
    ``fit_radius`` are then fitted further with a free radius, for their diameter. A set without points, or whose
    values overflow, does not converge. All lengths are in metres, in each set's own frame.
    """
    across_m, away_m = (
        np.where(used, points_m[..., column] - start_m[:, column, None], 0.0) for column in range(2)
    )
    along = np.where(used, points_m[..., 2] / half_m[:, None], 0.0)
    point_sets = _PointSets(across_m, away_m, along, used, half_m[:, None], radius_m[:, None])
    with np.errstate(over="ignore", invalid="ignore"):
        line_m, converged = _iterate(point_sets, np.zeros((len(points_m), 5)), POSITION_STEPS, free=4)
        slope = line_m[:, 2:4] / half_m[:, None]
        offset_m = start_m + line_m[:, :2]
        converged &= np.isfinite(offset_m).all(axis=1) & np.isfinite(slope).all(axis=1)
        diameter_m = np.full(len(points_m), np.nan)
        if fit_radius.any():
            refined_m, radius_converged = _iterate(
                point_sets.of(fit_radius), line_m[fit_radius], RADIUS_STEPS, free=5
            )
            diameter_m[fit_radius] = np.where(
                radius_converged, 2 * (radius_m[fit_radius] + refined_m[:, 4]), np.nan
            )
    return CylinderFits(offset_m, slope, converged, diameter_m)


@dataclass(frozen=True, eq=False)
class _PointSets(Rows):
    """Points relative to the start of their set: ``across_m``, ``away_m``, and ``along`` in half lengths.

    Unused points are 0. The columns are separate arrays because numpy is several times slower on arrays whose
    last axis has length 2 or 3.
    """

    across_m: Float64[ndarray, "r k"]
    away_m: Float64[ndarray, "r k"]
    along: Float64[ndarray, "r k"]
    used: Bool[ndarray, "r k"]
    half_m: Float64[ndarray, "r 1"]
    radius_m: Float64[ndarray, "r 1"]


def _iterate(
    point_sets: _PointSets, unknowns_m: Float64[ndarray, "r 5"], steps: int, *, free: int
) -> tuple[Float64[ndarray, "r 5"], Bool[ndarray, " r"]]:
    """Return the unknowns after ``steps`` Gauss-Newton steps on the first ``free`` ones, and which sets converged.

    The unknowns are two shifts, two slopes times ``half_m`` and the change of the radius, all in metres.
    """
    radius_m = point_sets.radius_m[:, 0]
    largest_m = np.full(len(unknowns_m), np.inf)
    sigma_m = np.zeros(len(unknowns_m))
    for iteration in range(steps):
        residual_m, jacobian = _linearise(point_sets, unknowns_m)
        if iteration % 2 == 0:
            sigma_m = _sigma_m(residual_m, point_sets.used, 2 * radius_m)
        scaled = residual_m / (TUKEY_CONSTANT * sigma_m)[:, None]
        weight = np.maximum(1 - scaled**2, 0.0) ** 2 * point_sets.used
        lateral_prior = (sigma_m / (LATERAL_PRIOR_RADII * radius_m)) ** 2
        step_m = _gauss_newton_step(residual_m, jacobian[:, :free], weight, unknowns_m, lateral_prior)
        # The linearisation does not hold for a step longer than the radius plus the noise.
        max_step_m = radius_m + sigma_m
        largest_m = np.abs(step_m).max(axis=1, initial=0.0)
        step_m *= (max_step_m / np.maximum(largest_m, max_step_m))[:, None]
        unknowns_m = unknowns_m + step_m
    return unknowns_m, (largest_m <= CONVERGENCE_TOLERANCE * max_step_m) & point_sets.used.any(axis=1)


def _linearise(
    point_sets: _PointSets, unknowns_m: Float64[ndarray, "r 5"]
) -> tuple[Float64[ndarray, "r k"], Float64[ndarray, "r 5 k"]]:
    """Return the residuals and their negative derivatives with respect to each unknown."""
    shift_across, shift_away, turn_across, turn_away, growth_m = (column[:, None] for column in unknowns_m.T)
    # The section perpendicular to a sloping axis is narrower than the one perpendicular to the frame's axis.
    across_m = (point_sets.across_m - shift_across - point_sets.along * turn_across) / np.hypot(
        1, turn_across / point_sets.half_m
    )
    away_m = (point_sets.away_m - shift_away - point_sets.along * turn_away) / np.hypot(
        1, turn_away / point_sets.half_m
    )
    radius_m = np.maximum(point_sets.radius_m + growth_m, MIN_RADIUS_FACTOR * point_sets.radius_m)
    sine = across_m / radius_m
    on_face = np.clip(sine, -MAX_FACE_RADII, MAX_FACE_RADII)
    cosine = np.sqrt(1 - on_face**2)
    residual_m = (sine - on_face) * on_face * radius_m - (away_m + radius_m * cosine) * cosine
    jacobian = np.ones((len(unknowns_m), 5, across_m.shape[1]))
    jacobian[:, 0] = on_face
    np.negative(cosine, out=jacobian[:, 1])
    np.multiply(jacobian[:, :2], point_sets.along[:, None], out=jacobian[:, 2:4])
    return residual_m, jacobian


def _sigma_m(
    residual_m: Float64[ndarray, "r k"], used: Bool[ndarray, "r k"], diameter_m: Float64[ndarray, " r"]
) -> Float64[ndarray, " r"]:
    """Return the noise scale of each set's residuals, from their median absolute value.

    For an even count the upper of the two middle values is the median.
    """
    ordered_m = np.sort(np.where(used, np.abs(residual_m), np.inf), axis=1)
    middle = used.sum(axis=1) // 2
    median_m = np.take_along_axis(ordered_m, np.minimum(middle, used.shape[1] - 1)[:, None], axis=1)[:, 0]
    return np.maximum(SIGMA_PER_MAD * median_m, MIN_SIGMA_DIAMETERS * diameter_m)


def _gauss_newton_step(
    residual_m: Float64[ndarray, "r k"],
    jacobian: Float64[ndarray, "r u k"],
    weight: Float64[ndarray, "r k"],
    unknowns_m: Float64[ndarray, "r 5"],
    lateral_prior: Float64[ndarray, " r"],
) -> Float64[ndarray, "r 5"]:
    """Return one Gauss-Newton step of the first u unknowns, 0 for the others.

    ``lateral_prior`` is the weight of the prior on the two lateral unknowns.
    """
    size = jacobian.shape[1]
    weighted_jacobian = jacobian * weight[:, None]
    # The maximum keeps the system regular if all weights are 0: only the prior remains.
    prior = np.repeat(PRIOR_WEIGHT * np.maximum(weight.sum(axis=1), 1.0)[:, None], size, axis=1)
    prior[:, [0, 2]] += lateral_prior[:, None]
    normal = weighted_jacobian @ jacobian.transpose(0, 2, 1)
    diagonal = np.arange(size)
    normal[:, diagonal, diagonal] += prior
    with np.errstate(invalid="ignore"):  # The prior of a set whose values overflow is inf.
        right_side = (weighted_jacobian @ residual_m[..., None])[..., 0] - prior * unknowns_m[:, :size]
    step_m = np.zeros_like(unknowns_m)
    step_m[:, :size] = np.linalg.solve(normal, right_side[..., None])[..., 0]
    return step_m


# Fits of the segments of a view.

MIN_PREDICTED_SHARE = 0.5
"""Minimum share of a segment's sampled pixels that must have a prediction for it to be found."""

MISS_MM = 100.0
"""Error assigned to a bar or pair that was not found in ``..._judged_mm``, and the cap of all errors there.

The position and spacing errors of bars and pairs that were found are smaller.
"""

MAX_DEPTH_M = 1e6
"""Upper bound applied to predicted depth, metres, so that its squares do not overflow."""


@dataclass(frozen=True, eq=False)
class FittedAxes:
    """Fitted axis of each visible segment and its deviation from the true axis.

    ``found`` marks the segments whose axis was accepted. An axis is a point and a unit direction in the camera
    frame. ``offset_m`` is the distance of the fitted axis from the middle of the visible part of the true one.
    ``diameter_m`` is NaN where it was not fitted. ``pixels`` is the number of pixels used, with a prediction.
    """

    found: Bool[ndarray, " r"]
    point_m: Float64[ndarray, "r 3"]
    direction: Float64[ndarray, "r 3"]
    offset_m: Float64[ndarray, " r"]
    tilt_deg: Float64[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]
    pixels: Int64[ndarray, " r"]


def fit_axes(p_m: Float64[ndarray, " n"], visible: VisibleSegments, *, diameters: bool = False) -> FittedAxes:
    """Return the axis of each visible segment, a cylinder of its nominal diameter fitted to predicted depth.

    ``p_m`` is planar depth at the pixels of ``SteelTruth``, metres; values that are not finite and > 0 are
    missing. With ``diameters``, where ``can_fit_diameter`` is set, a cylinder with a free radius is fitted as
    well, for its diameter.
    """
    points_m, predicted = _predicted_points_m(p_m, visible)
    start_m = _initial_offset_m(points_m, predicted, visible)
    fit_radius = visible.can_fit_diameter & diameters
    fits = fit_cylinders(points_m, predicted, start_m, visible.half_m, visible.diameter_m / 2, fit_radius)
    with np.errstate(over="ignore", invalid="ignore"):
        squared_slope = (fits.slope**2).sum(axis=1)
        lean_m = (fits.offset_m * fits.slope).sum(axis=1)
        offset_m = np.sqrt(np.maximum((fits.offset_m**2).sum(axis=1) - lean_m**2 / (1 + squared_slope), 0.0))
        enough = predicted.sum(axis=1) >= MIN_PREDICTED_SHARE * visible.used.sum(axis=1)
        to_end_m = fits.slope * visible.half_m[:, None]
        ends_m = (np.linalg.norm(fits.offset_m + side * to_end_m, axis=1) for side in (-1, 1))
        farthest_m = np.maximum(offset_m, np.maximum(*ends_m))
        local = np.column_stack([fits.slope, np.ones(len(fits.slope))]) / np.sqrt(1 + squared_slope)[:, None]
        return FittedAxes(
            found=enough & fits.converged & (farthest_m < visible.match_radius_m),
            point_m=visible.middle_m + np.einsum("rc,rci->ri", fits.offset_m, visible.frame[:, :2]),
            direction=np.einsum("rc,rci->ri", local, visible.frame),
            offset_m=offset_m,
            tilt_deg=np.rad2deg(np.arctan(np.sqrt(squared_slope))),
            diameter_m=fits.diameter_m,
            pixels=predicted.sum(axis=1),
        )


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
    predicted = visible.used & is_valid_prediction(depth_m)
    points_m = visible.local_points_m(np.where(predicted, np.minimum(depth_m, MAX_DEPTH_M), 0.0))
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
