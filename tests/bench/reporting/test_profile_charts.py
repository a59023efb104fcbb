"""Charts of error and scale against distance: mark positions, label spacing and extreme values."""

from __future__ import annotations

import math
import re
from itertools import pairwise

import pytest

from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M
from rebar_depth_bench.extended.result import MeasureEstimate
from rebar_depth_bench.reporting.axes import Axis, select_spaced
from rebar_depth_bench.reporting.charts import ProfileBin, profile_chart


def make_estimate(value: float) -> MeasureEstimate:
    return MeasureEstimate(value, (0.9 * value, 1.1 * value), 9)


def test_axis_labels_do_not_overlap() -> None:
    edges = DISTANCE_EDGES_M
    bins = [
        ProfileBin(low, high, make_estimate(0.1), make_estimate(0.01), make_estimate(0.9))
        for low, high in pairwise(edges)
    ]
    chart = profile_chart("distance", "m", bins)
    labels = re.findall(r'<text class="middle" x="([\d.]+)" y="287">([\d.]+)</text>', chart)
    assert labels[0][1] == "0.2"
    ends = [(float(x) - 3.7 * len(text), float(x) + 3.7 * len(text)) for x, text in labels]
    assert all(left[1] <= right[0] for left, right in pairwise(ends))
    assert len(labels) >= 6


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-30, 1e300, math.inf])
def test_charts_handle_extreme_values(value: float) -> None:
    estimate = MeasureEstimate(value, None, 9)
    chart = profile_chart(
        "distance", "m", [ProfileBin(0.3, 0.4, estimate, MeasureEstimate(None, None, 0), estimate)]
    )
    assert "nan" not in chart
    assert chart.count("<circle") == 2
    for number in re.findall(r'c[xy]="([^"]*)"', chart):
        assert 0 <= float(number) <= 460


def test_no_chart_without_values() -> None:
    none = MeasureEstimate(None, None, 0)
    assert profile_chart("distance", "m", [ProfileBin(0.3, 0.4, none, none, none)]) == ""


def test_select_spaced_keeps_first_label_and_min_distance() -> None:
    axis = Axis(1.0, 100.0, 0.0, 100.0)
    assert select_spaced([10.0, 1.0, 11.0, 100.0], axis, 40.0) == [10.0, 1.0, 100.0]


def test_marks_are_placed_by_axes() -> None:
    bins = [
        ProfileBin(0.3, 0.4, make_estimate(0.2), make_estimate(0.02), make_estimate(0.9)),
        ProfileBin(0.4, 0.5, make_estimate(0.1), make_estimate(0.01), make_estimate(1.1)),
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
    unit_scale_y = float(re.search(r'class="one" d="M52.0 ([\d.]+)H', chart)[1])  # type: ignore[index]
    assert far_scale[1] < unit_scale_y < near_scale[1], "s above 1 is above the line"
    assert chart.count("V") >= 6, "an interval each"
