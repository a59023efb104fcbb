"""Measures of bars: their detection, errors of position, spacing, cover and diameter, deviation from design.

They are statistics of the samples of native depth (``frames``). Whether a bar or a pair is judged depends on the
ground truth alone, so a missing prediction counts as a failure.
"""

from __future__ import annotations

import numpy as np

from rebar_depth_bench.extended.axes import MAX_MATCH_RADIUS_M
from rebar_depth_bench.extended.cover import MAX_FROM_BAR_M, MAX_OFF_PLANE_M, MIN_COVER_M
from rebar_depth_bench.extended.fits import MIN_PREDICTED_SHARE, MISS_MM, with_misses
from rebar_depth_bench.extended.frames import BarSamples, SpacingSamples
from rebar_depth_bench.extended.judged import (
    FLANK_RADII_AND_SHARE,
    MIN_DIAMETER_FIT_WIDTH_PX,
    MIN_PIXELS,
    MIN_VISIBLE_DIAMETERS,
    MIN_VISIBLE_OVERLAP_DIAMETERS,
)
from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel import PLANE_PIXELS

OFF_MM = 10.0
"""Deviation above which a bar is off; our choice."""

MISSED_NOTE = f"What was not found counts as {MISS_MM:g} mm."

_KINDS = {
    "spacing": (
        "bar spacing",
        "separation of the fitted axes of neighbouring parallel runs minus that of the true ones, along the true "
        "one, in the middle of what is seen of both; seen side by side for "
        f"{MIN_VISIBLE_OVERLAP_DIAMETERS:g} diameters or more",
    ),
    "depth_offset": (
        "place in depth",
        "fitted axis minus true axis along the optical axis, in the middle of what is seen of the run; more "
        "is further from the camera",
    ),
    "cover": (
        "cover",
        f"distance of the fitted bar's surface from the plane fitted to the predicted depth of {PLANE_PIXELS} "
        f"pixels of the form (true points within {1000 * MAX_OFF_PLANE_M:g} mm of it, and at most "
        f"{MAX_FROM_BAR_M:g} m from the middle of what is seen of the run), along its normal there, minus the "
        f"true cover; runs with {1000 * MIN_COVER_M:g} mm of cover or more",
    ),
    "diameter": (
        "diameter",
        "diameter of a cylinder fitted with a free radius, minus the nominal one; runs that are "
        f"{MIN_DIAMETER_FIT_WIDTH_PX:g} pixels wide or more and seen on both sides (a tenth of the pixels "
        f"beyond {FLANK_RADII_AND_SHARE[0]:g} radii)",
    ),
}
"""Title and definition of each kind of error."""


def inspection_samples(bars: BarSamples, spacings: SpacingSamples) -> Samples:
    """Return the samples of ``MEASURES``, which define what each is.

    The lengths of the samples depend on the ground truth alone, except for those of what was found
    (``..._error_mm``, ``axis_tilt_deg``).
    """
    diameter_mm = (bars.diameter_mm - bars.true_diameter_mm)[bars.diameter_judged]
    errors_mm = {
        "spacing": spacings.spacing_mm - spacings.true_spacing_mm,
        "depth_offset": bars.depth_offset_mm,
        "cover": (bars.cover_mm - bars.true_cover_mm)[~np.isnan(bars.true_cover_mm)],
        "diameter": diameter_mm,
    }
    return {
        "bar_found": bars.found.astype(np.float64),
        "axis_offset_judged_mm": with_misses(bars.offset_mm),
        "axis_tilt_deg": bars.tilt_deg[bars.found],
        **{f"{kind}_error_mm": error_mm[~np.isnan(error_mm)] for kind, error_mm in errors_mm.items()},
        **{f"{kind}_judged_mm": with_misses(error_mm) for kind, error_mm in errors_mm.items()},
    }


def as_built_samples(bars: BarSamples) -> Samples:
    """Return the samples of ``AS_BUILT_MEASURES``; there are none without bars that have a nominal axis."""
    designed = bars.of(~np.isnan(bars.true_deviation_mm))
    if not len(designed):
        return {}
    true_mm, measured_mm = designed.true_deviation_mm, designed.deviation_mm
    is_off, is_reported = true_mm > OFF_MM, measured_mm > OFF_MM
    return {
        "deviation_judged_mm": with_misses(designed.deviation_error_mm),
        "deviation_excess_mm": (measured_mm - true_mm)[designed.found],
        "deviation_true_mm": true_mm,
        "off_reported": is_reported[is_off].astype(np.float64),
        "off_confirmed": is_off[is_reported].astype(np.float64),
    }


def _error_measures(kind: str) -> tuple[Measure, ...]:
    """Return bias, spread and 95th percentile of one kind of error.

    Only the last covers everything judged, so only it has a better direction.
    """
    title, definition = _KINDS[kind]
    found = f"{kind}_error_mm"
    return (
        Measure(f"{kind}_bias_mm", f"{title}: bias", "mm", "", f"Mean over what was found: {definition}.", found),
        Measure(
            f"{kind}_std_mm", f"{title}: spread", "mm", "",
            f"Standard deviation over what was found: {definition}.", found, "std",
        ),
        Measure(
            f"{kind}_p95_mm", f"{title}: p95 error", "mm", "lower",
            f"95th percentile of the absolute value: {definition}. {MISSED_NOTE}", f"{kind}_judged_mm", "p95",
        ),
    )  # fmt: skip


MEASURES = (
    Measure(
        "bars_found", "bars found", "%", "higher",
        f"Share of judged runs with predictions on {MIN_PREDICTED_SHARE:.0%} or more of their pixels whose fitted "
        "cylinder converged, its axis everywhere along what is seen nearer to the true one than half way to the "
        f"nearest parallel run, and within {1000 * MAX_MATCH_RADIUS_M:g} mm. Judged are straight runs of bars "
        f"with {MIN_PIXELS} interior pixels or more over {MIN_VISIBLE_DIAMETERS:g} diameters or more of their "
        "length, by the ground truth alone.",
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
        "axis_tilt_deg", "axis tilt of found bars, degrees", "", "",
        "Mean angle between fitted and true axis, over runs that were found.",
    ),
    *(measure for kind in _KINDS for measure in _error_measures(kind)),
)  # fmt: skip
"""Measures of bars in table order."""

_DEVIATION = (
    "vector from the nominal axis to the axis of the bar, across the nominal one, in the middle of what is seen "
    "of a run; bars with a nominal axis"
)
_ERROR = "length of the difference of the deviations by the fitted axis and by the axis as built"

AS_BUILT_MEASURES = (
    Measure(
        "deviation_median_mm", "deviation from the design: median error", "mm", "lower",
        f"Median {_ERROR}. Deviation: {_DEVIATION}. {MISSED_NOTE}", "deviation_judged_mm", "median",
    ),
    Measure(
        "deviation_p95_mm", "deviation from the design: p95 error", "mm", "lower",
        f"95th percentile of the {_ERROR}. {MISSED_NOTE}", "deviation_judged_mm", "p95",
    ),
    Measure(
        "deviation_bias_mm", "deviation from the design: bias", "mm", "",
        "Mean length of the deviation by the fitted axis minus that by the axis as built, over found runs.",
        "deviation_excess_mm",
    ),
    Measure(
        "deviation_true_median_mm", "deviation as built: median", "mm", "",
        "Median length of the deviation by the axis as built, from the ground truth alone: the error of a report "
        "that all bars are as designed.", "deviation_true_mm", "median",
    ),
    Measure(
        "off_recall", f"bars off by more than {OFF_MM:g} mm: recall", "%", "higher",
        f"Share of the runs as built more than {OFF_MM:g} mm off the nominal axis whose fitted axis is, too; what "
        "was not found counts as a failure. The samples are the runs that are off.", "off_reported",
    ),
    Measure(
        "off_precision", f"bars off by more than {OFF_MM:g} mm: precision", "%", "",
        f"Share of the runs with a fitted axis more than {OFF_MM:g} mm off the nominal one that are as built, "
        "too. The samples are the runs that are reported as off.", "off_confirmed",
    ),
)  # fmt: skip
"""Measures of deviations from the design in table order."""
