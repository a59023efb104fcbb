from __future__ import annotations

import math

import pytest

from rebar_depth_bench.extended.inspection.evaluate import MEASURES
from rebar_depth_bench.extended.inspection.tolerances import CAPABILITIES, PROFILES, capability, pass_sample


def test_capability_is_tolerance_over_p95() -> None:
    assert capability(10.0, 4.0) == 2.5
    assert capability(5.0, 20.0) == 0.25
    assert capability(5.0, math.inf) == 0.0
    assert capability(5.0, 0.0) == math.inf


@pytest.mark.parametrize(
    "values", [(0.0, 1.0), (-1.0, 1.0), (math.nan, 1.0), (math.inf, 1.0), (5.0, -1.0), (5.0, math.nan)]
)
def test_what_is_no_tolerance_or_no_error_is_refused(values: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        capability(*values)


def test_every_tolerance_is_compared_with_a_measure_that_counts_misses() -> None:
    measures = {measure.name: measure for measure in MEASURES}
    tolerances = [tolerance for profile in PROFILES for tolerance in profile.tolerances]
    assert [tolerance for tolerance, _ in CAPABILITIES] == tolerances
    for tolerance, name in CAPABILITIES:
        assert measures[name].statistic == "p95"
        assert measures[name].sample == f"{tolerance.kind}_judged_mm"
        assert f"{tolerance.limit_mm:g} mm" in measures[pass_sample(tolerance)].title


def test_names_are_taken_once_and_sources_say_what_they_are() -> None:
    keys = [tolerance.key for tolerance, _ in CAPABILITIES]
    assert len(set(keys)) == len(keys)
    assert all("secondary source" in profile.source for profile in PROFILES)
    assert not any("ACI" in profile.source for profile in PROFILES)
