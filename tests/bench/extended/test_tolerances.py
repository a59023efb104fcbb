"""Tests of tolerance profiles and process capability."""

from __future__ import annotations

import math

import pytest

from rebar_depth_bench.extended.inspection import (
    INSPECTION_MEASURES,
    PROFILES,
    TOLERANCES,
    pass_sample,
    process_capability,
)


def test_capability_is_tolerance_over_p95() -> None:
    assert process_capability(10.0, 4.0) == 2.5
    assert process_capability(5.0, 20.0) == 0.25
    assert process_capability(5.0, math.inf) == 0.0
    assert process_capability(5.0, 0.0) == math.inf


@pytest.mark.parametrize(
    "values", [(0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (5.0, -1.0), (5.0, math.nan)]
)
def test_invalid_tolerance_or_error_raises_value_error(values: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        process_capability(*values)


def test_tolerances_use_p95_measures_that_count_misses() -> None:
    measures = {measure.name: measure for measure in INSPECTION_MEASURES}
    tolerances = [tolerance for profile in PROFILES for tolerance in profile.tolerances]
    assert [tolerance for _, tolerance in TOLERANCES] == tolerances
    for tolerance in tolerances:
        name = f"{tolerance.kind}_p95_mm"
        assert measures[name].statistic == "p95"
        assert measures[name].sample == f"{tolerance.kind}_judged_mm"
        assert f"{tolerance.limit_mm:g} mm" in measures[pass_sample(tolerance)].title


def test_keys_are_unique_and_sources_are_declared() -> None:
    keys = [tolerance.key for _, tolerance in TOLERANCES]
    assert len(set(keys)) == len(keys)
    assert all("secondary source" in profile.source for profile in PROFILES)
    assert not any("ACI" in profile.source for profile in PROFILES)
