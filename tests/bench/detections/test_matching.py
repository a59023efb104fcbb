"""Tests of matching and average precision: cases by hand, brute force, and independence of order."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench.detections.result import RankedDetections
from rebar_depth_bench.detections.score import excused, greedy_matches, matched_pairs
from rebar_depth_bench.scoring.bootstrap import resample

SEEDS = st.integers(0, 2**32 - 1)


def on_line(*millimetres: float) -> ndarray:
    return np.array([[value / 1000, 0.0, 0.5] for value in millimetres]).reshape(-1, 3)


def test_most_pairs_come_before_least_distance() -> None:
    """Detection 0 is nearest to tie point 0, which is the only one that detection 1 reaches."""
    pairs = matched_pairs(on_line(1.0, -9.0), on_line(0.0, 9.0))
    assert pairs.tolist() == [[0, 1], [1, 0]]
    assert matched_pairs(on_line(1.0), on_line(0.0, 9.0)).tolist() == [[0, 0]]


def test_limit_is_ten_millimetres_inclusive() -> None:
    assert matched_pairs(on_line(10.0), on_line(0.0)).tolist() == [[0, 0]]
    assert matched_pairs(on_line(10.01), on_line(0.0)).tolist() == []
    assert matched_pairs(on_line(), on_line(0.0)).shape == matched_pairs(on_line(0.0), on_line()).shape == (0, 2)


@settings(max_examples=40, deadline=None)
@given(SEEDS)
def test_matching_agrees_with_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    detected, true = (rng.uniform(0, 0.02, (int(rng.integers(1, 6)), 3)) for _ in range(2))
    pairs = matched_pairs(detected, true)
    distance = np.linalg.norm(detected[:, None] - true, axis=2)
    found = (-len(pairs), distance[pairs[:, 0], pairs[:, 1]].sum())
    small, large = sorted((len(detected), len(true)))
    table = distance if len(detected) <= len(true) else distance.T
    best = (0, 0.0)
    for columns in permutations(range(large), small):
        used = [table[row, column] for row, column in enumerate(columns) if table[row, column] <= 0.010]
        best = min(best, (-len(used), sum(used)))
    assert found == pytest.approx(best)
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)


def test_greedy_takes_the_most_confident_first() -> None:
    """The confident detection takes the tie point that the other one needs."""
    detected, true = on_line(4.0, 0.0), on_line(3.0)
    assert greedy_matches(detected, np.array([0.9, 0.8]), true, 0.005).tolist() == [True, False]
    assert greedy_matches(detected, np.array([0.8, 0.9]), true, 0.005).tolist() == [False, True]
    assert greedy_matches(detected, np.ones(2), true, 0.005).tolist() == [True, False]  # Equal: the nearest.


@given(SEEDS)
def test_order_of_rows_has_no_effect(seed: int) -> None:
    rng = np.random.default_rng(seed)
    detected, true = rng.uniform(0, 0.04, (12, 3)), rng.uniform(0, 0.04, (6, 3))
    confidence = rng.integers(0, 3, 12).astype(float)
    order = rng.permutation(12)
    for limit in (0.005, 0.02):
        expected = greedy_matches(detected, confidence, true, limit)[order]
        assert greedy_matches(detected[order], confidence[order], true, limit).tolist() == expected.tolist()


def test_each_unjudged_crossing_excuses_one_detection() -> None:
    """Three detections near an unjudged crossing at 100 mm, one near a judged one, one far from all."""
    all_m, judged = on_line(0.0, 100.0, 130.0), np.array([True, False, False])
    detected = on_line(2.0, 101.0, 99.5, 108.0, 50.0, 125.0)
    left_over = np.ones(6, dtype=bool)
    found = excused(detected, left_over, all_m, judged, np.zeros(6))
    assert found.tolist() == [False, False, True, False, False, True]
    found = excused(detected, left_over, all_m, judged, np.array([0, 0.2, 0.1, 0.9, 0, 0]))
    assert found.tolist() == [False, False, False, True, False, True]
    assert not excused(on_line(), np.empty(0, bool), all_m, judged, np.empty(0)).any()
    assert not excused(detected, left_over, on_line(), np.empty(0, bool), np.zeros(6)).any()


def ranked(
    confidence: list[float], correct: list[bool], positives: list[int], view: list[int]
) -> RankedDetections:
    return RankedDetections(np.array(confidence), np.array(correct), np.array(view, int), np.array(positives))


def test_average_precision_by_hand() -> None:
    """Correct, false, correct of three crossings: precision 1 to recall 1/3, then 2/3 to recall 2/3."""
    found = ranked([0.9, 0.8, 0.7], [True, False, True], [3], [0, 0, 0])
    recall, precision = found.curve()
    assert recall == pytest.approx([1 / 3, 1 / 3, 2 / 3])
    assert precision == pytest.approx([1, 1 / 2, 2 / 3])
    assert found.average() == pytest.approx(1 / 3 + 2 / 9)
    # Equal confidences are one point of the curve: precision 2/3 at recall 2/3, in any order.
    for correct in ([True, False, True], [False, True, True]):
        assert ranked([0.5] * 3, correct, [3], [0] * 3).average() == pytest.approx(4 / 9)


def test_average_precision_without_detections_or_crossings() -> None:
    assert ranked([], [], [3], []).average() == 0
    assert ranked([0.5], [False], [0], [0]).average() is None
    assert ranked([], [], [3], []).drawn_points() == []


def test_interval_of_average_precision_covers_different_views() -> None:
    views = 20
    correct = [view % 2 == 0 for view in range(views)]
    found = ranked([0.5] * views, correct, [1] * views, list(range(views)))
    ends = found.interval(resample(range(0, 100 * views, 100)))
    assert ends is not None
    assert ends[0] < 0.25 < ends[1]
    assert found.average() == pytest.approx(0.25)  # Precision and recall of a half.
    same = ranked([0.5] * views, [True] * views, [1] * views, list(range(views)))
    assert same.interval(resample(range(0, 100 * views, 100))) == (1.0, 1.0)
