"""Charts of error and scale against distance: what they mark, and that their labels can be read."""

from __future__ import annotations

import math
import re
from itertools import pairwise

import pytest

from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M
from rebar_depth_bench.extended.result import Estimate
from rebar_depth_bench.reporting.charts.axes import LogAxis
from rebar_depth_bench.reporting.charts.profile import ProfileBin, profile_chart, spaced


def known(value: float) -> Estimate:
    return Estimate(value, (0.9 * value, 1.1 * value), 9)


def test_a_chart_of_all_bins_has_labels_that_do_not_touch() -> None:
    edges = DISTANCE_EDGES_M
    bins = [ProfileBin(low, high, known(0.1), known(0.01), known(0.9)) for low, high in pairwise(edges)]
    chart = profile_chart("distance", "m", bins)
    labels = re.findall(r'<text class="middle" x="([\d.]+)" y="287">([\d.]+)</text>', chart)
    assert labels[0][1] == "0.2"
    ends = [(float(x) - 3.7 * len(text), float(x) + 3.7 * len(text)) for x, text in labels]
    assert all(left[1] <= right[0] for left, right in pairwise(ends))
    assert len(labels) >= 6


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-30, 1e300, math.inf])
def test_charts_stand_extreme_values(value: float) -> None:
    one = Estimate(value, None, 9)
    chart = profile_chart("distance", "m", [ProfileBin(0.3, 0.4, one, Estimate(None, None, 0), one)])
    assert "nan" not in chart
    assert chart.count("<circle") == 2
    for number in re.findall(r'c[xy]="([^"]*)"', chart):
        assert 0 <= float(number) <= 460


def test_no_bin_no_chart() -> None:
    none = Estimate(None, None, 0)
    assert profile_chart("distance", "m", [ProfileBin(0.3, 0.4, none, none, none)]) == ""


def test_labels_keep_their_distance_and_the_first_one_stays() -> None:
    axis = LogAxis(1.0, 100.0, 0.0, 100.0)
    assert spaced([10.0, 1.0, 11.0, 100.0], axis, 40.0) == [10.0, 1.0, 100.0]


def test_marks_stand_where_the_axes_say() -> None:
    bins = [
        ProfileBin(0.3, 0.4, known(0.2), known(0.02), known(0.9)),
        ProfileBin(0.4, 0.5, known(0.1), known(0.01), known(1.1)),
    ]
    chart = profile_chart("distance", "m", bins)
    marks = {
        kind: [(float(x), float(y)) for x, y in re.findall(rf'class="{kind}" cx="([^"]+)" cy="([^"]+)"', chart)]
        for kind in ("native fill", "scaled ring")
    }
    (near, far, near_scale, far_scale), rings = marks["native fill"], marks["scaled ring"]
    assert near[1] < far[1], "a larger error is higher"
    assert all(native[1] < ring[1] for native, ring in zip((near, far), rings, strict=True))
    assert (near[1] - far[1]) == pytest.approx(rings[0][1] - rings[1][1], abs=0.2), "logarithmic"
    one = float(re.search(r'class="one" d="M52 ([\d.]+)H', chart)[1])  # type: ignore[index]
    assert far_scale[1] < one < near_scale[1], "s above 1 is above the line"
    assert chart.count("V") >= 6, "an interval each"
