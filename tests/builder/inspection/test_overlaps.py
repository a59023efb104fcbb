"""Pairs of bars that penetrate each other, compared with all pairs of sampled points."""

from __future__ import annotations

import numpy as np
import pytest

from dataset_builder.inspection import summary as module
from dataset_builder.inspection.summary import MIN_OVERLAP_M, overlaps
from dataset_builder.scene.model import axis_of
from rebar_depth_bench.bar_crossings.axis_segments import TooManyNeighboursError
from rebar_depth_bench.data.bars import Bar


def rod(bar_id: int, start: tuple[float, ...], end: tuple[float, ...], diameter_m: float = 0.012) -> Bar:
    return Bar(bar_id, "bar", diameter_m, axis_of(np.array([start, end], dtype=np.float64)))


def test_pairs_are_those_of_brute_force() -> None:
    random = np.random.default_rng(3)
    bars = [
        Bar(number, "bar", float(random.uniform(0.01, 0.04)), axis_of(random.uniform(0, 1, (4, 3))))
        for number in range(1, 31)
    ]
    expected = {}
    for index, a in enumerate(bars):
        for b in bars[index + 1 :]:
            depth_m = (a.diameter_m + b.diameter_m) / 2 - sampled_distance_m(a, b)
            if depth_m > MIN_OVERLAP_M:
                expected[a.bar_id, b.bar_id] = depth_m
    found = {(pair.bar_a, pair.bar_b): pair.depth_m for pair in overlaps(bars)}
    assert len(expected) > 20
    assert expected.keys() <= found.keys()
    for pair, depth_m in found.items():
        sampled_m = expected.get(pair, MIN_OVERLAP_M)
        assert sampled_m - 1e-9 <= depth_m <= sampled_m + 1e-3  # Samples are up to 1.3 mm apart.
    assert list(found.values()) == sorted(found.values(), reverse=True)


def sampled_distance_m(a: Bar, b: Bar) -> float:
    from scipy.spatial import cKDTree

    sampled = []
    for bar in (a, b):
        axis_m = np.array(bar.axis_m)
        at = np.linspace(0, len(axis_m) - 1, 4000)
        sampled.append(np.stack([np.interp(at, np.arange(len(axis_m)), column) for column in axis_m.T], axis=-1))
    return float(cKDTree(sampled[0]).query(sampled[1])[0].min())


def test_bars_that_touch_do_not_overlap() -> None:
    long, across = rod(1, (-2, 0, 0), (2, 0, 0)), rod(2, (0, -2, 0.012), (0, 2, 0.012))
    assert overlaps([long, across]) == []
    (pair,) = overlaps([long, rod(2, (0, -2, 0.011), (0, 2, 0.011))])
    assert (pair.bar_a, pair.bar_b, round(pair.depth_m, 9)) == (1, 2, 0.001)
    np.testing.assert_allclose(pair.point_m, (0, 0, 0.0055), atol=1e-9)


def test_bars_without_axis_and_single_bars_have_no_overlaps() -> None:
    assert overlaps([rod(1, (0, 0, 0), (1, 0, 0)), Bar.without_axis(2, "imported")]) == []


def test_too_many_neighbours_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_PAIRS", 1000)
    crowd = [rod(number, (0, 0, 0), (0.05, 0, 0)) for number in range(1, 100)]
    with pytest.raises(TooManyNeighboursError):
        overlaps(crowd)
