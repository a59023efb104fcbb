"""Tests of tolerance profiles and process capability."""

from __future__ import annotations

import math

from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import (
    INSPECTION_MEASURES,
    PROFILES,
    TOLERANCES,
    capability,
)


def test_capability_is_tolerance_over_p95() -> None:
    assert capability(10.0, 4.0) == 2.5
    assert capability(5.0, 20.0) == 0.25
    assert capability(5.0, 0.0) == math.inf
    assert capability(5.0, MISS_MM) is None


def test_tolerances_use_p95_measures_that_count_misses() -> None:
    measures = {measure.name: measure for measure in INSPECTION_MEASURES}
    tolerances = [tolerance for profile in PROFILES for tolerance in profile.tolerances]
    assert [tolerance for _, tolerance in TOLERANCES] == tolerances
    for tolerance in tolerances:
        name = f"{tolerance.kind}_p95_mm"
        assert measures[name].statistic == "p95"
        assert measures[name].sample == f"{tolerance.kind}_judged_mm"
        assert f"{tolerance.limit_mm:g} mm" in measures[tolerance.pass_name].title


def test_keys_are_unique_and_sources_are_declared() -> None:
    keys = [tolerance.key for _, tolerance in TOLERANCES]
    assert len(set(keys)) == len(keys)
    assert all("secondary source" in profile.source for profile in PROFILES)
    assert not any("ACI" in profile.source for profile in PROFILES)
