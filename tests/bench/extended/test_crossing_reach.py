"""Tests of the reach: bins, verdicts and intervals of hand-made crossings, and resampling of scenes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray

from rebar_depth_bench.extended.reach import Reach, reaches
from rebar_depth_bench.scoring.bootstrap import Resampling, resample, resample_scenes

VIEWS = 10


def samples(bins: dict[float, tuple[int, float]], view: int) -> dict[str, ndarray]:
    """Return a view's crossings by depth: their number, and the share of views with 3 mm of error, else 9 mm."""
    z_m = [z for z, (count, _) in bins.items() for _ in range(count)]
    error_mm = [3.0 if view < share * VIEWS else 9.0 for count, share in bins.values() for _ in range(count)]
    return {"crossing_z_m": np.array(z_m), "tie_judged_mm": np.array(error_mm)}


def reach(bins: dict[float, tuple[int, float]], views: int = VIEWS, resampling: Resampling | None = None) -> Reach:
    by_view = [samples(bins, view) for view in range(views)]
    five, two = reaches(by_view, resampling or resample([100 * index for index in range(views)]))
    assert (five.limit_mm, two.limit_mm) == (5, 2)
    assert two.verdict in ("not met", "none tested")  # 3 mm is never within 2 mm.
    return five


def test_reach_ends_before_the_first_bin_that_fails() -> None:
    found = reach({0.22: (6, 1), 0.27: (6, 1), 0.35: (6, 0.9), 0.45: (6, 1)})
    assert (found.verdict, found.distance_m, found.tested_m) == ("up to", 0.3, (0.2, 0.5))
    assert [(one.low_m, one.crossings, one.views) for one in found.bins] == [
        (0.2, 60, 10), (0.25, 60, 10), (0.3, 60, 10), (0.4, 60, 10),
    ]  # fmt: skip
    assert found.bins[2].share == pytest.approx(0.9)
    assert found.interval is not None
    # Views of which a tenth fails in the third bin: some resamples have none of them, and all bins are met.
    assert found.interval == (0.3, 0.5)


def test_reach_of_all_tested_bins_is_a_lower_bound() -> None:
    found = reach({0.22: (6, 1), 0.27: (6, 1), 0.35: (4, 0)})  # 40 crossings: the third bin is not tested.
    assert (found.verdict, found.distance_m, found.interval) == ("at least", 0.3, (0.3, 0.3))
    assert [one.tested for one in found.bins] == [True, True, False]


def test_share_of_exactly_95_percent_fulfils() -> None:
    by_view = [
        {"crossing_z_m": np.full(20, 0.22), "tie_judged_mm": np.r_[np.full(19, 5.0), 5.1]} for _ in range(5)
    ]
    found = reaches(by_view, resample(range(0, 500, 100)))[0]
    assert (found.verdict, found.distance_m) == ("at least", 0.25)


def test_untested_gap_ends_the_reach() -> None:
    found = reach({0.22: (6, 1), 0.45: (6, 1)})
    assert (found.verdict, found.distance_m, found.tested_m) == ("at least", 0.25, (0.2, 0.25))
    found = reach({0.22: (1, 0), 0.27: (6, 1)})  # Ten crossings nearer than the nearest tested bin say nothing.
    assert (found.verdict, found.distance_m, found.tested_m) == ("at least", 0.3, (0.25, 0.3))


def test_not_met_and_none_tested() -> None:
    found = reach({0.22: (6, 0.5), 0.27: (6, 1)})
    assert (found.verdict, found.distance_m, found.interval) == ("not met", None, (0.0, 0.0))
    cases: list[tuple[dict[float, tuple[int, float]], int]] = [({}, 10)]
    for bins, views in (*cases, ({0.22: (20, 1.0)}, 4), ({0.22: (4, 1.0)}, 10), ({30.0: (9, 1.0)}, 10)):
        found = reach(bins, views)
        assert (found.verdict, found.distance_m, found.interval, found.tested_m) == (
            "none tested",
            None,
            None,
            None,
        )


def test_reach_is_in_json_terms() -> None:
    found = reach({0.22: (6, 1), 0.27: (6, 0)}).to_dict()
    assert {name: value for name, value in found.items() if name != "bins"} == {
        "limit_mm": 5, "verdict": "up to", "distance_m": 0.25, "ci95": [0.25, 0.25], "tested_m": [0.2, 0.3],
    }  # fmt: skip
    assert found["bins"][0] == {
        "low_m": 0.2, "high_m": 0.25, "crossings": 60, "views": 10, "share": 1.0, "ci95": [1.0, 1.0],
    }  # fmt: skip


def test_interval_of_few_scenes_is_unknown() -> None:
    few = resample_scenes(["a"] * 5 + ["b"] * 5)
    found = reach({0.22: (6, 1)}, resampling=few)
    assert (found.verdict, found.distance_m, found.interval) == ("at least", 0.25, None)
