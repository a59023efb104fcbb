"""Inspection measures: names, units and definitions of the table entries.

The capability measures divide each tolerance of the profiles by the p95 of the error that it bounds.
"""

from __future__ import annotations

from functools import partial

from rebar_depth_bench.extended.inspection.segments import MAX_MATCH_RADIUS_M
from rebar_depth_bench.extended.inspection.tolerances import (
    TOLERANCES,
    Tolerance,
    ToleranceProfile,
    pass_sample,
    process_capability,
)
from rebar_depth_bench.extended.inspection.visible_segments import (
    FLANK_RADII_AND_SHARE,
    MIN_DIAMETER_FIT_WIDTH_PX,
    MIN_PIXELS,
    MIN_VISIBLE_DIAMETERS,
)
from rebar_depth_bench.extended.measures import Measure

MIN_PREDICTED_SHARE = 0.5
"""Minimum share of a segment's sampled pixels that must have a prediction for it to be found."""

MISS_MM = 100.0
"""Error assigned to a bar or pair that was not found in ``..._judged_mm``, and the cap of all errors there.

The position and spacing errors of bars and pairs that were found are smaller.
"""

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

_DEFINITIONS: dict[str, str] = {
    "spacing": f"{_SEPARATION} whose separation is less than 45 degrees from the image plane, {_OVERLAP_NOTE}",
    "layer": f"{_SEPARATION} whose separation is 45 degrees or less from the optical axis, {_OVERLAP_NOTE}",
    "cover": "fitted axis minus true axis along the optical axis, in the middle of what is seen of the run; more "
    "is further from the camera",
    "diameter": "diameter of a cylinder fitted with a free radius, minus the nominal one; runs that are "
    f"{MIN_DIAMETER_FIT_WIDTH_PX:g} pixels wide or more and seen on both sides (a tenth of the pixels "
    f"beyond {FLANK_RADII_AND_SHARE[0]:g} radii)",
}
"""Definition of each kind of error."""

_TITLES: dict[str, str] = {
    "spacing": "bar spacing",
    "layer": "layer distance",
    "cover": "cover (place in depth)",
    "diameter": "diameter",
}
"""Title of each kind of error."""


def _error_measures(kind: str) -> tuple[Measure, ...]:
    """Return bias, spread, median and p95 of one kind of error.

    Only the last two cover everything judged, so only they have a better direction.
    """
    title, definition = _TITLES[kind], _DEFINITIONS[kind]
    found_sample, judged_sample = f"{kind}_error_mm", f"{kind}_judged_mm"
    return (
        Measure(
            f"{kind}_bias_mm", found_sample, "mean", f"{title}: bias", "mm", "",
            f"Mean over what was found: {definition}.",
        ),
        Measure(
            f"{kind}_std_mm", found_sample, "std", f"{title}: spread", "mm", "",
            f"Standard deviation over what was found: {definition}.",
        ),
        Measure(
            f"{kind}_median_mm", judged_sample, "median", f"{title}: median error", "mm", "lower",
            f"Median of the absolute value: {definition}. {MISSED_NOTE}",
        ),
        Measure(
            f"{kind}_p95_mm", judged_sample, "p95", f"{title}: p95 error", "mm", "lower",
            f"95th percentile of the absolute value: {definition}. {MISSED_NOTE}",
        ),
    )  # fmt: skip


_POSITION_MEASURES: tuple[Measure, ...] = (
    Measure(
        "bars_found", "bar_found", "mean", "bars found", "%", "higher",
        f"Share of judged runs with predictions on {MIN_PREDICTED_SHARE:.0%} or more of their pixels whose fitted "
        "cylinder converged, its axis everywhere along what is seen nearer to the true one than half way to the "
        f"nearest parallel run, and within {1000 * MAX_MATCH_RADIUS_M:g} mm. {JUDGED_NOTE}",
    ),
    Measure(
        "axis_offset_median_mm", "axis_offset_judged_mm", "median", "axis offset: median", "mm", "lower",
        f"Median distance of the fitted axis from the middle of what is seen of the true one. {MISSED_NOTE}",
    ),
    Measure(
        "axis_offset_p95_mm", "axis_offset_judged_mm", "p95", "axis offset: p95", "mm", "lower",
        "95th percentile of the distance of the fitted axis from the middle of what is seen of the true one. "
        + MISSED_NOTE,
    ),
    Measure(
        "axis_offset_found_mm", "axis_offset_mm", "mean", "axis offset of found bars: mean", "mm", "",
        "Mean distance of the fitted axis from the middle of what is seen of the true one, over found runs.",
    ),
    Measure(
        "axis_tilt_deg", "axis_tilt_deg", "mean", "axis tilt of found bars, degrees", "", "",
        "Mean angle between fitted and true axis, over runs that were found.",
    ),
)  # fmt: skip
"""Detection rate, axis offset and axis tilt."""


def _pass_measures() -> tuple[Measure, ...]:
    """Return the pass rate of each tolerance."""
    return tuple(
        Measure(
            pass_sample(tolerance), pass_sample(tolerance), "mean",
            f"{profile.title}, {tolerance.title}: within {tolerance.limit_mm:g} mm", "%", "higher",
            f"Share of all judged with an error of at most {tolerance.limit_mm:g} mm either way; what was not "
            f"found fails. Error: {_DEFINITIONS[tolerance.kind]}. Tolerance: {profile.source}.",
        )
        for profile, tolerance in TOLERANCES
    )  # fmt: skip


INSPECTION_MEASURES: tuple[Measure, ...] = (
    *_POSITION_MEASURES,
    *(measure for kind in _DEFINITIONS for measure in _error_measures(kind)),
    *_pass_measures(),
)
"""All inspection measures except the capabilities, in table order."""


def capability_name(tolerance: Tolerance) -> str:
    """Return the name of the measure that divides a tolerance by the p95 of its error."""
    return f"capability_{tolerance.key}"


def defined_capability(limit_mm: float, p95_mm: float) -> float | None:
    """Return ``process_capability``; None where the p95 is ``MISS_MM`` or more, the value of a miss.

    Raises ``ValueError`` as ``process_capability`` does.
    """
    return None if p95_mm >= MISS_MM else process_capability(limit_mm, p95_mm)


def _capability_measure(profile: ToleranceProfile, tolerance: Tolerance) -> Measure:
    """Return the measure that divides ``tolerance`` by the p95 of the error that it bounds."""
    [p95] = (measure for measure in INSPECTION_MEASURES if measure.name == f"{tolerance.kind}_p95_mm")
    return Measure(
        name=capability_name(tolerance),
        sample=p95.sample,
        statistic=p95.statistic,
        title=f"{profile.title}, {tolerance.title}: {tolerance.limit_mm:g} mm / p95",
        unit="",
        better="higher",
        definition=f"Capability: {tolerance.limit_mm:g} mm / {p95.name}; 1 or more if 95 % of all judged stay "
        f"within the tolerance; undefined if {p95.name} is {MISS_MM:g} mm, which stands for what was not found.",
        convert=partial(defined_capability, tolerance.limit_mm),
    )


CAPABILITY_MEASURES: tuple[Measure, ...] = tuple(_capability_measure(*entry) for entry in TOLERANCES)
"""Capability of each tolerance, in the order of ``TOLERANCES``."""
