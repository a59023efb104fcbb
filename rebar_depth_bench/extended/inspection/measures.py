"""The numbers that a table of inspection shows, and what each of them says in words.

Capabilities: each tolerance of the profiles over the p95 of the error that it bounds.
"""

from __future__ import annotations

from functools import partial

from rebar_depth_bench.extended.inspection.segments import MAX_REACH_M
from rebar_depth_bench.extended.inspection.tolerances import (
    CAPABILITIES,
    PROFILES,
    Tolerance,
    capability,
    pass_sample,
)
from rebar_depth_bench.extended.inspection.visible_segments import AROUND, MIN_PIXELS, MIN_VISIBLE, WIDE_PX
from rebar_depth_bench.extended.measures import Measure

MIN_PREDICTED = 0.5
"""A run is found only if at least this share of the pixels it is judged on has a prediction."""

MISS_MM = 100.0
"""What a bar or pair that was not found counts as in ``..._judged_mm``: more than any found one can be off."""

SIDE_BY_SIDE = 2.0
"""A pair is judged where the visible parts of both pass each other for this many of the larger diameter."""

_JUDGED = (
    f"Judged are straight runs of bars with {MIN_PIXELS} interior pixels or more over {MIN_VISIBLE:g} diameters "
    "or more of their length, by the ground truth alone."
)
_MISSED = f"What was not found counts as {MISS_MM:g} mm."

_SEPARATION = (
    "separation of fitted axes minus that of the true ones, along the true one, in the middle of what is seen of "
    "both; neighbouring parallel runs"
)
_BESIDE = f"seen side by side for {SIDE_BY_SIDE:g} diameters or more"

_WHAT: dict[str, str] = {
    "spacing": f"{_SEPARATION} whose separation is less than 45 degrees from the image plane, {_BESIDE}",
    "layer": f"{_SEPARATION} whose separation is 45 degrees or less from the optical axis, {_BESIDE}",
    "cover": "fitted axis minus true axis along the optical axis, in the middle of what is seen of the run; more "
    "is further from the camera",
    "diameter": "diameter of a cylinder fitted with a free radius, minus the nominal one; runs that are "
    f"{WIDE_PX:g} pixels wide or more and seen on both sides (a tenth of the pixels beyond {AROUND[0]:g} radii)",
}
_TITLES: dict[str, str] = {
    "spacing": "bar spacing",
    "layer": "layer distance",
    "cover": "cover (place in depth)",
    "diameter": "diameter",
}


def _error_measures(kind: str) -> tuple[Measure, ...]:
    """Return bias, spread and size of one kind of error; only what counts all judged can be better or worse."""
    title, what = _TITLES[kind], _WHAT[kind]
    found, judged = f"{kind}_error_mm", f"{kind}_judged_mm"
    return (
        Measure(
            f"{kind}_bias_mm", found, "mean", f"{title}: bias", "mm", "",
            f"Mean over what was found: {what}.",
        ),
        Measure(
            f"{kind}_std_mm", found, "std", f"{title}: spread", "mm", "",
            f"Standard deviation over what was found: {what}.",
        ),
        Measure(
            f"{kind}_median_mm", judged, "median", f"{title}: median error", "mm", "lower",
            f"Median of the absolute value: {what}. {_MISSED}",
        ),
        Measure(
            f"{kind}_p95_mm", judged, "p95", f"{title}: p95 error", "mm", "lower",
            f"95th percentile of the absolute value: {what}. {_MISSED}",
        ),
    )  # fmt: skip


_PLACE_MEASURES: tuple[Measure, ...] = (
    Measure(
        "bars_found", "bar_found", "mean", "bars found", "%", "higher",
        f"Share of judged runs with predictions on {MIN_PREDICTED:.0%} or more of their pixels whose fitted "
        "cylinder converged, its axis everywhere along what is seen nearer to the true one than half way to the "
        f"nearest parallel run, and within {1000 * MAX_REACH_M:g} mm. {_JUDGED}",
    ),
    Measure(
        "axis_offset_median_mm", "axis_offset_judged_mm", "median", "axis offset: median", "mm", "lower",
        f"Median distance of the fitted axis from the middle of what is seen of the true one. {_MISSED}",
    ),
    Measure(
        "axis_offset_p95_mm", "axis_offset_judged_mm", "p95", "axis offset: p95", "mm", "lower",
        "95th percentile of the distance of the fitted axis from the middle of what is seen of the true one. "
        + _MISSED,
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


def _pass_measures() -> tuple[Measure, ...]:
    return tuple(
        Measure(
            pass_sample(tolerance), pass_sample(tolerance), "mean",
            f"{profile.title}, {tolerance.title}: within {tolerance.limit_mm:g} mm", "%", "higher",
            f"Share of all judged with an error of at most {tolerance.limit_mm:g} mm either way; what was not "
            f"found fails. Error: {_WHAT[tolerance.kind]}. Tolerance: {profile.source}.",
        )
        for profile in PROFILES
        for tolerance in profile.tolerances
    )  # fmt: skip


INSPECTION_MEASURES: tuple[Measure, ...] = (
    *_PLACE_MEASURES,
    *(measure for kind in _WHAT for measure in _error_measures(kind)),
    *_pass_measures(),
)
"""Every number of inspection, in a table's order."""


def capability_name(tolerance: Tolerance) -> str:
    """Return the name of the measure that says how a tolerance compares with the p95 of its error."""
    return f"capability_{tolerance.key}"


def told_capability(limit_mm: float, p95_mm: float) -> float | None:
    """Return ``capability``, None where the p95 is ``MISS_MM``: it is then of what was not found.

    Raises ``ValueError`` as ``capability`` does.
    """
    return None if p95_mm >= MISS_MM else capability(limit_mm, p95_mm)


def _measures() -> tuple[Measure, ...]:
    p95 = {measure.name: measure for measure in INSPECTION_MEASURES}
    profile_of = {tolerance.key: profile for profile in PROFILES for tolerance in profile.tolerances}
    return tuple(
        _measure(f"{profile_of[one.key].title}, {one.title}", one, p95[name]) for one, name in CAPABILITIES
    )


def _measure(title: str, tolerance: Tolerance, p95: Measure) -> Measure:
    return Measure(
        name=capability_name(tolerance),
        sample=p95.sample,
        statistic=p95.statistic,
        title=f"{title}: {tolerance.limit_mm:g} mm / p95",
        unit="",
        better="higher",
        definition=f"Capability: {tolerance.limit_mm:g} mm / {p95.name}; 1 or more where 95 % of all judged stay "
        f"within the tolerance, not told where that p95 is {MISS_MM:g} mm, of what was not found.",
        convert=partial(told_capability, tolerance.limit_mm),
    )


MEASURES: tuple[Measure, ...] = _measures()
"""A capability for each tolerance, in the order of ``PROFILES``."""
