"""Statistics of working ranges: bins, intervals over views, states and runs."""

from __future__ import annotations

import numpy as np
import pytest

from rebar_depth_bench.extended.working_range import (
    RangeRun,
    TaskSamples,
    WorkingRange,
    design_effect,
    share_interval,
    working_range,
)
from rebar_depth_bench.reporting.tasks import range_text

VIEWS, OF_VIEW = 12, 5


def at(
    distance_m: float, error_mm: float = 1.0, *, failed: int = 0, exact: float = 0.0, plane: float = 9.0
) -> dict[str, np.ndarray]:
    """Return samples of all views at one distance; the first of them fail."""
    errors_mm = np.full(VIEWS * OF_VIEW, error_mm)
    errors_mm[:failed] = np.nan
    return {
        "view": np.repeat(np.arange(VIEWS), OF_VIEW),
        "distance_m": np.full(len(errors_mm), distance_m),
        "error_mm": errors_mm,
        "exact_error_mm": np.full(len(errors_mm), exact),
        "plane_error_mm": np.full(len(errors_mm), plane),
    }


def ranges(*parts: dict[str, np.ndarray], limit_mm: float = 5.0) -> WorkingRange:
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return working_range(TaskSamples(limit_mm, **joined))


def test_interval_is_wilsons_for_independent_samples() -> None:
    """Newcombe (Statistics in Medicine 17, 1998), table I: 81 of 263 is 0.2553 to 0.3662, 0 of 20 up to 0.1611."""
    passes = np.arange(263) < 81
    assert share_interval(passes, np.arange(263)) == pytest.approx((0.2553, 0.3662), abs=5e-4)
    assert share_interval(np.zeros(20, bool), np.arange(20)) == pytest.approx((0, 0.1611), abs=1e-4)


def test_interval_of_samples_that_disagree_has_students_quantile_of_the_views() -> None:
    """Its ends p solve |p - share| = t sqrt(p (1 - p) / n)."""
    view, passes = np.repeat(np.arange(10), 10), np.tile(np.arange(10) < 9, 10)
    for end in share_interval(passes, view):
        assert abs(end - 0.9) / np.sqrt(end * (1 - end) / 100) == pytest.approx(2.262157, abs=1e-5)


def test_design_effect_of_views_that_pass_or_fail_as_a_whole_is_their_number_of_samples() -> None:
    view = np.repeat(np.arange(400), 5)
    rng = np.random.default_rng(1)
    whole = (rng.random(400) < 0.8)[view]
    assert design_effect(whole, view) == pytest.approx(5, rel=0.01)
    assert design_effect(rng.random(2000) < 0.8, view) == pytest.approx(1, abs=0.15)
    alike = np.tile([True, True, True, True, False], 400)
    assert design_effect(alike, view) == 1, "views that are more alike than by chance"
    assert design_effect(np.ones(2000, bool), view) == 1


def test_runs_are_of_adjacent_tested_bins_of_one_state() -> None:
    found = ranges(
        at(0.32, failed=5),  # Of one view: the share is 92 %.
        at(0.4),  # The lower edge belongs to a bin.
        at(0.6, -4.9),
        at(0.8, plane=4.0),
        at(1.2),
        at(1.8, failed=3),
    )
    assert [one.state for one in found.bins] == ["not met", "met", "met", "not tested", "met", "likely"]
    assert found.runs == (
        RangeRun(0.3, 0.4, "not met"),
        RangeRun(0.4, 0.7, "met"),
        RangeRun(1.0, 1.5, "met"),
        RangeRun(1.5, 2.0, "likely"),
    )
    assert [one.bias_mm for one in found.bins[:3]] == pytest.approx([1, 1, -4.9])


def test_bins_are_tested_by_counts_exact_depth_and_plane() -> None:
    few = {name: values[: 7 * OF_VIEW] for name, values in at(0.32).items()}
    found = ranges(few, at(0.6, exact=6.0), at(0.8, plane=5.0))
    assert [list(one.reasons) for one in found.bins] == [["samples", "views"], ["exact"], ["plane"]]
    assert not found.runs
    assert not working_range(TaskSamples(5.0, np.empty(0, np.int64), *[np.empty(0)] * 4)).bins


def test_samples_nearer_or_farther_than_the_bins_are_counted() -> None:
    outside = "60 samples{} nearer than 0.1 m or from 20 m on"
    assert range_text(ranges(at(20.0))) == f"not tested ({outside.format(', all of them')})"
    assert range_text(ranges(at(0.6), at(0.09))) == f"met in 0.5-0.7 m (not judged: {outside.format('')})"
    few = {name: values[:5] for name, values in at(0.09).items()}
    assert ranges(few, at(20.0), at(0.1), at(19.9)).unbinned == 65


def test_json_of_failures_has_no_bias() -> None:
    [one] = ranges(at(0.6, np.inf)).to_dict()["bins"]
    assert one == {
        "from_m": 0.5, "to_m": 0.7, "samples": 60, "views": 12, "share": 0.0, "low": 0.0,
        "high": pytest.approx(0.0602, abs=1e-4), "bias_mm": None, "spread_mm": None, "exact": 1.0, "plane": 0.0,
        "state": "not met",
    }  # fmt: skip
