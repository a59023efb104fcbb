"""Capabilities: each tolerance of the profiles over the p95 of the error that it bounds."""

from __future__ import annotations

from functools import partial

from rebar_depth_bench.extended.inspection_measures import INSPECTION_MEASURES, MISS_MM
from rebar_depth_bench.extended.measures import Measure
from rebar_depth_bench.extended.tolerances import CAPABILITIES, PROFILES, Tolerance, capability


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
