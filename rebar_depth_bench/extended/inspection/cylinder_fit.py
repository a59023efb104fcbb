"""Cylinders fitted to points of bars seen from one side: many at once, robustly, with or without a free radius.

Frame: each cylinder's own, metres, columns across (the line of sight), away (from the camera), along (the axis).
A line is two offsets and two slopes: at ``t`` along, the axis is at ``offset_m + slope * t`` across and away.

A residual is how far a point is in front of the visible surface, along the surface's normal where the point's
line of sight meets it; beside the bar, also how far it is beside. On the surface that is the distance to the
cylinder to first order. The distance itself would not do: behind the axis it leads to the far side, which no
camera sees, and a cloud of noise wider than the bar would be fitted by a cylinder in its middle.

Weights are Tukey's (Beaton and Tukey, Technometrics 16, 1974) with a scale from the median absolute residual.
Depth says little of where a bar is across the line of sight: that is seen by which pixels show it. So the two
unknowns across are drawn towards their start as if that was known to ``ACROSS`` radii; for depth of a few
hundredths of a radius this moves nothing, where noise is wider than the bar it decides. The other unknowns have a
weight of ``PRIOR`` of the points, so that no system of equations is singular.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

PLACE_STEPS = 6
RADIUS_STEPS = 6
"""Further ones with the radius free: first the place, then the size."""

PRIOR = 1e-6
ACROSS = 0.25
TUKEY = 4.685
"""95 % efficient under Gaussian noise."""

SIGMA_OF_MEDIAN = 1.4826
MIN_SIGMA = 0.02
"""Residuals are never taken for less noisy than this many diameters: ribs are part of a bar, not outliers."""

SETTLED = 0.02
"""A fit has converged if its last step moved nothing by more than this share of radius and noise together."""

FACE = 0.98
"""Points more than this many radii to the side are beside the bar: there its surface runs along the sight."""

MIN_GROWN = 0.1
"""A free radius is held above this many nominal ones."""


@dataclass(frozen=True, eq=False)
class CylinderFits:
    """One cylinder for each of r point sets; see the module for the frame and the meaning of a line.

    ``diameter_m`` is that of a second fit with a free radius, NaN where none was asked for or none converged.
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
    measured: Bool[ndarray, " r"],
) -> CylinderFits:
    """Fit a cylinder of known radius to the ``used`` points of each set, by a fixed number of Gauss-Newton steps.

    The start is an axis along the frame's third direction, ``start_m`` across and away, which should be near the
    points; ``half_m`` is half the length that slopes are weighed over. From there, the sets that are ``measured``
    are fitted on with a free radius, for their diameter. A set without points, or with values that overflow, has
    not converged. All lengths in metres, in each set's own frame.
    """
    cloud = _Cloud.about(points_m, used, start_m, half_m, radius_m)
    with np.errstate(over="ignore", invalid="ignore"):
        line_m, converged = _iterated(cloud, np.zeros((len(points_m), 5)), PLACE_STEPS, free=4)
        slope = line_m[:, 2:4] / half_m[:, None]
        offset_m = start_m + line_m[:, :2]
        converged &= np.isfinite(offset_m).all(axis=1) & np.isfinite(slope).all(axis=1)
        diameter_m = np.full(len(points_m), np.nan)
        if measured.any():
            grown_m, settled = _iterated(cloud.of(measured), line_m[measured], RADIUS_STEPS, free=5)
            diameter_m[measured] = np.where(settled, 2 * (radius_m[measured] + grown_m[:, 4]), np.nan)
    return CylinderFits(offset_m, slope, converged, diameter_m)


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Points, from their set's start: ``across_m``, ``away_m``, and ``along`` in half lengths; 0 where unused.

    Columns by themselves: numpy is several times slower on arrays whose last axis is 2 or 3 long.
    """

    across_m: Float64[ndarray, "r k"]
    away_m: Float64[ndarray, "r k"]
    along: Float64[ndarray, "r k"]
    used: Bool[ndarray, "r k"]
    half_m: Float64[ndarray, "r 1"]
    radius_m: Float64[ndarray, "r 1"]

    @classmethod
    def about(
        cls,
        points_m: Float64[ndarray, "r k 3"],
        used: Bool[ndarray, "r k"],
        start_m: Float64[ndarray, "r 2"],
        half_m: Float64[ndarray, " r"],
        radius_m: Float64[ndarray, " r"],
    ) -> _Cloud:
        across_m, away_m = (
            np.where(used, points_m[..., column] - start_m[:, column, None], 0.0) for column in range(2)
        )
        along = np.where(used, points_m[..., 2] / half_m[:, None], 0.0)
        return cls(across_m, away_m, along, used, half_m[:, None], radius_m[:, None])

    def of(self, sets: Bool[ndarray, " r"]) -> _Cloud:
        """Return some of the sets."""
        return _Cloud(*(getattr(self, field.name)[sets] for field in fields(self)))


def _iterated(
    cloud: _Cloud, unknowns_m: Float64[ndarray, "r 5"], steps: int, *, free: int
) -> tuple[Float64[ndarray, "r 5"], Bool[ndarray, " r"]]:
    """Return the unknowns after ``steps`` steps of the first ``free`` ones, and which sets have settled.

    Unknowns are two shifts, two slopes times ``half_m`` and the growth of the radius: all of them metres.
    """
    radius_m = cloud.radius_m[:, 0]
    largest_m = np.full(len(unknowns_m), np.inf)
    sigma_m = np.zeros(len(unknowns_m))
    for iteration in range(steps):
        residual_m, slopes = _linearised(cloud, unknowns_m)
        if iteration % 2 == 0:
            sigma_m = _sigma_m(residual_m, cloud.used, 2 * radius_m)
        weight = _tukey_weights(residual_m, sigma_m) * cloud.used
        held = (sigma_m / (ACROSS * radius_m)) ** 2
        step_m = _step(residual_m, slopes[:, :free], weight, unknowns_m, held)
        # A step of more than a radius and the noise is beyond what the linearisation knows.
        most_m = radius_m + sigma_m
        largest_m = np.abs(step_m).max(axis=1, initial=0.0)
        step_m *= (most_m / np.maximum(largest_m, most_m))[:, None]
        unknowns_m = unknowns_m + step_m
    return unknowns_m, (largest_m <= SETTLED * most_m) & cloud.used.any(axis=1)


def _linearised(
    cloud: _Cloud, unknowns_m: Float64[ndarray, "r 5"]
) -> tuple[Float64[ndarray, "r k"], Float64[ndarray, "r 5 k"]]:
    """Return the residuals, and how fast each falls with each unknown."""
    shift_across, shift_away, turn_across, turn_away, growth_m = (column[:, None] for column in unknowns_m.T)
    # The section at right angles to a sloping axis is narrower than the one at right angles to the frame's.
    across_m = (cloud.across_m - shift_across - cloud.along * turn_across) / np.hypot(
        1, turn_across / cloud.half_m
    )
    away_m = (cloud.away_m - shift_away - cloud.along * turn_away) / np.hypot(1, turn_away / cloud.half_m)
    radius_m = np.maximum(cloud.radius_m + growth_m, MIN_GROWN * cloud.radius_m)
    sine = across_m / radius_m
    on_face = np.clip(sine, -FACE, FACE)
    cosine = np.sqrt(1 - on_face**2)
    residual_m = (sine - on_face) * on_face * radius_m - (away_m + radius_m * cosine) * cosine
    slopes = np.ones((len(unknowns_m), 5, across_m.shape[1]))
    slopes[:, 0] = on_face
    np.negative(cosine, out=slopes[:, 1])
    np.multiply(slopes[:, :2], cloud.along[:, None], out=slopes[:, 2:4])
    return residual_m, slopes


def _sigma_m(
    residual_m: Float64[ndarray, "r k"], used: Bool[ndarray, "r k"], diameter_m: Float64[ndarray, " r"]
) -> Float64[ndarray, " r"]:
    """Return the noise of each set's residuals, from their median absolute value (the upper one of two)."""
    ordered_m = np.sort(np.where(used, np.abs(residual_m), np.inf), axis=1)
    middle = used.sum(axis=1) // 2
    median_m = np.take_along_axis(ordered_m, np.minimum(middle, used.shape[1] - 1)[:, None], axis=1)[:, 0]
    return np.maximum(SIGMA_OF_MEDIAN * median_m, MIN_SIGMA * diameter_m)


def _tukey_weights(
    residual_m: Float64[ndarray, "r k"], sigma_m: Float64[ndarray, " r"]
) -> Float64[ndarray, "r k"]:
    scaled = residual_m / (TUKEY * sigma_m)[:, None]
    return np.asarray(np.maximum(1 - scaled**2, 0.0) ** 2)


def _step(
    residual_m: Float64[ndarray, "r k"],
    slopes: Float64[ndarray, "r u k"],
    weight: Float64[ndarray, "r k"],
    unknowns_m: Float64[ndarray, "r 5"],
    held: Float64[ndarray, " r"],
) -> Float64[ndarray, "r 5"]:
    """Return one Gauss-Newton step of the first u unknowns, 0 for the others; ``held`` weighs those across."""
    size = slopes.shape[1]
    weighted = slopes * weight[:, None]
    # Never singular: without any weight only the prior is left.
    prior = np.repeat(PRIOR * np.maximum(weight.sum(axis=1), 1.0)[:, None], size, axis=1)
    prior[:, [0, 2]] += held[:, None]
    normal = weighted @ slopes.transpose(0, 2, 1)
    diagonal = np.arange(size)
    normal[:, diagonal, diagonal] += prior
    right = (weighted @ residual_m[..., None])[..., 0] - prior * unknowns_m[:, :size]
    step_m = np.zeros_like(unknowns_m)
    step_m[:, :size] = np.linalg.solve(normal, right[..., None])[..., 0]
    return step_m
