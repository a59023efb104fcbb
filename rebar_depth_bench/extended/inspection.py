"""Per-bar inspection: detection of each bar and the errors of its position, spacing and diameter.

For each straight bar segment that a view shows, a cylinder of the nominal diameter is fitted to the predicted
points of its interior pixels, and the fitted axis is compared with the true one. Frame: the camera's, metres.
Whether a segment or a pair is judged depends on the ground truth alone, so a missing prediction counts as a
failure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import Rows
from rebar_depth_bench.extended.axes import MAX_MATCH_RADIUS_M, CageTruth
from rebar_depth_bench.extended.fits import MIN_PREDICTED_SHARE, MISS_MM, FittedAxes, fit_axes, with_misses
from rebar_depth_bench.extended.judged import (
    FLANK_RADII_AND_SHARE,
    MIN_DIAMETER_FIT_WIDTH_PX,
    MIN_PIXELS,
    MIN_VISIBLE_DIAMETERS,
    VisibleSegments,
)
from rebar_depth_bench.extended.measures import Measure, Samples, median_and_p95

ErrorKind = Literal["spacing", "layer", "cover"]
"""Kind of error that a tolerance bounds."""


@dataclass(frozen=True)
class Tolerance:
    """One tolerance of a profile: errors of this ``kind`` pass if their absolute value is at most ``limit_mm``."""

    key: str
    kind: ErrorKind
    limit_mm: float
    title: str

    @property
    def pass_name(self) -> str:
        """Name of the pass rate, and of its samples: 1 for errors within the tolerance, else 0."""
        return f"pass_{self.key}"

    @property
    def capability_name(self) -> str:
        """Name of the measure that divides the tolerance by the p95 of its error."""
        return f"capability_{self.key}"


@dataclass(frozen=True)
class ToleranceProfile:
    """Tolerances of one standard; ``source`` is the citation shown beside them."""

    title: str
    source: str
    tolerances: tuple[Tolerance, ...]


def _en_13670(number: int, **limits_mm: float) -> ToleranceProfile:
    """Return the tolerances of cover of one class of EN 13670, by the depth of the section."""
    return ToleranceProfile(
        f"EN 13670, class {number}",
        f"EN 13670 (execution of concrete structures), cover, plus side, tolerance class {number}, growing with "
        "the depth of the section; figures from a secondary source; held against errors of either sign",
        tuple(
            Tolerance(f"en13670_class{number}_cover_{depth}", "cover", limit_mm, f"cover, {depth} sections")
            for depth, limit_mm in limits_mm.items()
        ),
    )


PROFILES = (
    ToleranceProfile(
        "GB 50204",
        "GB 50204 (acceptance of concrete works, China), placing of bars; figures from a secondary source",
        (
            Tolerance("gb50204_spacing", "spacing", 10.0, "bar spacing"),
            Tolerance("gb50204_stirrup_spacing", "spacing", 20.0, "stirrup spacing"),
            Tolerance("gb50204_layers", "layer", 5.0, "distance of layers"),
            Tolerance("gb50204_cover_slab", "cover", 3.0, "cover, slabs and walls"),
            Tolerance("gb50204_cover_beam", "cover", 5.0, "cover, beams and columns"),
        ),
    ),
    _en_13670(1, shallow=10.0, medium=15.0, deep=25.0),
    _en_13670(2, shallow=5.0, medium=10.0, deep=20.0),
)
"""Tolerance profiles of reinforcement standards, in report order."""

TOLERANCES = tuple((profile, tolerance) for profile in PROFILES for tolerance in profile.tolerances)
"""All tolerances with their profiles, in report order."""

MIN_VISIBLE_OVERLAP_DIAMETERS = 2.0
"""Minimum overlap of the visible parts of a judged pair along the axis, in larger diameters."""

JUDGED_NOTE = (
    f"Judged are straight runs of bars with {MIN_PIXELS} interior pixels or more over "
    f"{MIN_VISIBLE_DIAMETERS:g} diameters or more of their length, by the ground truth alone."
)
MISSED_NOTE = f"What was not found counts as {MISS_MM:g} mm."

_SEPARATION = (
    "separation of fitted axes minus that of the true ones, along the true one, in the middle of what is seen of "
    "both; neighbouring parallel runs"
)
_OVERLAP_NOTE = f"seen side by side for {MIN_VISIBLE_OVERLAP_DIAMETERS:g} diameters or more"
_KINDS = {
    "spacing": (
        "bar spacing",
        f"{_SEPARATION} whose separation is less than 45 degrees from the image plane, {_OVERLAP_NOTE}",
    ),
    "layer": (
        "layer distance",
        f"{_SEPARATION} whose separation is 45 degrees or less from the optical axis, {_OVERLAP_NOTE}",
    ),
    "cover": (
        "cover (place in depth)",
        "fitted axis minus true axis along the optical axis, in the middle of what is seen of the run; more "
        "is further from the camera",
    ),
    "diameter": (
        "diameter",
        "diameter of a cylinder fitted with a free radius, minus the nominal one; runs that are "
        f"{MIN_DIAMETER_FIT_WIDTH_PX:g} pixels wide or more and seen on both sides (a tenth of the pixels "
        f"beyond {FLANK_RADII_AND_SHARE[0]:g} radii)",
    ),
}
"""Title and definition of each kind of error."""


def _error_measures(kind: str) -> tuple[Measure, ...]:
    """Return bias, spread, median and p95 of one kind of error.

    Only the last two cover everything judged, so only they have a better direction.
    """
    title, definition = _KINDS[kind]
    found = f"{kind}_error_mm"
    return (
        Measure(f"{kind}_bias_mm", f"{title}: bias", "mm", "", f"Mean over what was found: {definition}.", found),
        Measure(
            f"{kind}_std_mm", f"{title}: spread", "mm", "",
            f"Standard deviation over what was found: {definition}.", found, "std",
        ),
        *median_and_p95(kind, title, "mm", f"absolute value: {definition}. {MISSED_NOTE}", " error"),
    )  # fmt: skip


def capability(limit_mm: float, p95_mm: float) -> float | None:
    """Return limit / p95 of the absolute error, akin to the process capability Cp; inf for a p95 of 0.

    It is 1 or more if 95 % of the errors are within the limit, and None where the p95 is ``MISS_MM`` or more, the
    value of a miss.
    """
    if p95_mm >= MISS_MM:
        return None
    return limit_mm / p95_mm if p95_mm > 0 else math.inf


INSPECTION_MEASURES = (
    Measure(
        "bars_found", "bars found", "%", "higher",
        f"Share of judged runs with predictions on {MIN_PREDICTED_SHARE:.0%} or more of their pixels whose fitted "
        "cylinder converged, its axis everywhere along what is seen nearer to the true one than half way to the "
        f"nearest parallel run, and within {1000 * MAX_MATCH_RADIUS_M:g} mm. {JUDGED_NOTE}",
        "bar_found",
    ),
    Measure(
        "axis_offset_median_mm", "axis offset: median", "mm", "lower",
        f"Median distance of the fitted axis from the middle of what is seen of the true one. {MISSED_NOTE}",
        "axis_offset_judged_mm", "median",
    ),
    Measure(
        "axis_offset_p95_mm", "axis offset: p95", "mm", "lower",
        "95th percentile distance of the fitted axis from the middle of what is seen of the true one. "
        + MISSED_NOTE,
        "axis_offset_judged_mm", "p95",
    ),
    Measure(
        "axis_offset_found_mm", "axis offset of found bars: mean", "mm", "",
        "Mean distance of the fitted axis from the middle of what is seen of the true one, over found runs.",
        "axis_offset_mm",
    ),
    Measure(
        "axis_tilt_deg", "axis tilt of found bars, degrees", "", "",
        "Mean angle between fitted and true axis, over runs that were found.",
    ),
    *(measure for kind in _KINDS for measure in _error_measures(kind)),
    *(
        Measure(
            tolerance.pass_name, f"{profile.title}, {tolerance.title}: within {tolerance.limit_mm:g} mm",
            "%", "higher",
            f"Share of all judged with an error of at most {tolerance.limit_mm:g} mm either way; what was not "
            f"found fails. Error: {_KINDS[tolerance.kind][1]}. Tolerance: {profile.source}.",
        )
        for profile, tolerance in TOLERANCES
    ),
)  # fmt: skip
"""All inspection measures except the capabilities, in table order."""

CAPABILITY_MEASURES = tuple(
    Measure(
        tolerance.capability_name, f"{profile.title}, {tolerance.title}: {tolerance.limit_mm:g} mm / p95",
        "", "higher",
        f"Capability: {tolerance.limit_mm:g} mm / {tolerance.kind}_p95_mm; 1 or more if 95 % of all judged stay "
        f"within the tolerance; undefined if {tolerance.kind}_p95_mm is {MISS_MM:g} mm, which stands for what was "
        "not found.",
        f"{tolerance.kind}_judged_mm", "p95", partial(capability, tolerance.limit_mm),
    )
    for profile, tolerance in TOLERANCES
)  # fmt: skip
"""Capability of each tolerance, in the order of ``TOLERANCES``."""

_MM = 1000.0


@dataclass(frozen=True, eq=False)
class VisiblePairs(Rows):
    """Neighbouring segments that are both visible, side by side: two positions among the visible segments.

    ``middle_m`` and ``normal`` define the plane that is intersected with both axes.
    """

    segments: Int64[ndarray, "m 2"]
    middle_m: Float64[ndarray, "m 3"]
    normal: Float64[ndarray, "m 3"]


def inspection_samples(p_m: Float64[ndarray, " n"], visible: VisibleSegments, pairs: VisiblePairs) -> Samples:
    """Return the inspection samples of one view; ``INSPECTION_MEASURES`` defines what each is.

    ``p_m`` is the predicted planar depth on the pixels of ``SteelTruth`` in metres; values that are not finite and
    > 0 count as missing. ``visible`` and ``pairs`` are the ``visible_segments`` and ``visible_pairs`` of the view.
    The lengths of the samples depend on the ground truth alone, except for the samples of found bars
    (``..._error_mm``, ``axis_offset_mm``, ``axis_tilt_deg``).
    """
    fitted = fit_axes(p_m, visible, diameters=True)
    spacing_m, layer_m = _pair_errors_m(pairs, visible, fitted)
    cover_m = (fitted.point_m - visible.middle_m)[:, 2]
    diameter_m = np.where(fitted.found, fitted.diameter_m - visible.diameter_m, np.nan)
    errors_mm = {
        "spacing": spacing_m * _MM,
        "layer": layer_m * _MM,
        "cover": np.where(fitted.found, cover_m, np.nan) * _MM,
        "diameter": diameter_m[visible.can_fit_diameter] * _MM,
    }
    judged_mm = {kind: with_misses(error_mm) for kind, error_mm in errors_mm.items()}
    return {
        "bar_found": fitted.found.astype(np.float64),
        "axis_offset_mm": fitted.offset_m[fitted.found] * _MM,
        "axis_offset_judged_mm": with_misses(np.where(fitted.found, fitted.offset_m * _MM, np.nan)),
        "axis_tilt_deg": fitted.tilt_deg[fitted.found],
        **{f"{kind}_error_mm": error_mm[~np.isnan(error_mm)] for kind, error_mm in errors_mm.items()},
        **{f"{kind}_judged_mm": of_kind_mm for kind, of_kind_mm in judged_mm.items()},
        **{
            tolerance.pass_name: (judged_mm[tolerance.kind] <= tolerance.limit_mm).astype(np.float64)
            for _, tolerance in TOLERANCES
        },
    }


def visible_pairs(visible: VisibleSegments, cage: CageTruth) -> VisiblePairs:
    """Return the neighbour pairs whose segments are both visible and overlap along the first one's axis."""
    position = np.full(len(cage), -1)
    position[visible.segment] = np.arange(len(visible.segment))
    segments = position[cage.neighbours]
    segments = segments[(segments >= 0).all(axis=1)]
    first, second = segments.T
    normal = visible.frame[first, 2]
    between_m = np.einsum("mi,mi->m", visible.middle_m[second] - visible.middle_m[first], normal)
    low_m = np.maximum(-visible.half_m[first], between_m - visible.half_m[second])
    high_m = np.minimum(visible.half_m[first], between_m + visible.half_m[second])
    overlapping = high_m - low_m >= MIN_VISIBLE_OVERLAP_DIAMETERS * np.maximum(
        visible.diameter_m[first], visible.diameter_m[second]
    )
    middle_m = visible.middle_m[first] + ((low_m + high_m) / 2)[:, None] * normal
    return VisiblePairs(segments, middle_m, normal).of(overlapping)


def _pair_errors_m(
    pairs: VisiblePairs, visible: VisibleSegments, fitted: FittedAxes
) -> tuple[Float64[ndarray, " s"], Float64[ndarray, " l"]]:
    """Return the separation errors of pairs across the line of sight, and of pairs along the optical axis.

    Both axes are intersected with the plane perpendicular to the first one in the middle of the part where both
    are visible. The error is the fitted separation of the two intersections, projected on the true direction
    between them, minus the true one. NaN where either segment was not found.
    """
    true_m = _separation_m(pairs, visible.middle_m, visible.frame[:, 2])
    distance_m = np.linalg.norm(true_m, axis=1)
    true_direction = true_m / distance_m[:, None]
    with np.errstate(all="ignore"):
        fitted_m = np.einsum("mi,mi->m", _separation_m(pairs, fitted.point_m, fitted.direction), true_direction)
        error_m = np.where(fitted.found[pairs.segments].all(axis=1), fitted_m - distance_m, np.nan)
    is_layer = np.abs(true_direction[:, 2]) >= np.sqrt(0.5)
    return error_m[~is_layer], error_m[is_layer]


def _separation_m(
    pairs: VisiblePairs, point_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]
) -> Float64[ndarray, "m 3"]:
    """Return the vector from the first line's intersection with each pair's plane to the second line's."""
    intersections_m = []
    for segment in pairs.segments.T:
        to_plane_m = np.einsum("mi,mi->m", pairs.middle_m - point_m[segment], pairs.normal)
        rate = np.einsum("mi,mi->m", direction[segment], pairs.normal)
        intersections_m.append(point_m[segment] + (to_plane_m / rate)[:, None] * direction[segment])
    return np.asarray(intersections_m[1] - intersections_m[0])


MEASURES = (*INSPECTION_MEASURES, *CAPABILITY_MEASURES)
