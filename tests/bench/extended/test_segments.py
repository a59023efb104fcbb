"""Tests of straight bar segments, their neighbour pairs, and the assignment of points to segments."""

from __future__ import annotations

import numpy as np
import pytest

from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.extended import axes
from rebar_depth_bench.extended.axes import MAX_MATCH_RADIUS_M, CageTruth, assign_segments, cage_truth
from tests.bench.extended.cage_scenes import bar


def polyline(points: np.ndarray, bar_id: int = 1, diameter_m: float = 0.01) -> Bar:
    return Bar(bar_id, "bar", diameter_m, tuple(map(tuple, points.tolist())))


def arc(radius_m: float, from_deg: float, to_deg: float, steps: int) -> np.ndarray:
    angle = np.deg2rad(np.linspace(from_deg, to_deg, steps + 1))
    return np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(steps + 1)])


def pairs_of(cage: CageTruth) -> set[tuple[int, int]]:
    ids = cage.bar_id[cage.neighbours]
    return {(int(first), int(second)) for first, second in ids}


# L-shaped: 0.2 m along x, a bend of 25 mm radius in 5-degree steps, 0.15 m along y.
BEND = arc(0.025, -90, 0, 18) + np.array([0.2, 0.025, 0])
L_BAR = polyline(np.concatenate([[[0, 0, 0]], BEND, [[0.225, 0.175, 0]]]))


def test_bent_bar_has_a_segment_on_each_side_of_bend() -> None:
    cage = cage_truth([L_BAR])
    assert cage.bar_id.tolist() == [1, 1]
    np.testing.assert_allclose(np.column_stack([cage.start_m, cage.end_m]), [
        (0, 0, 0, 0.2, 0, 0), (0.225, 0.025, 0, 0.225, 0.175, 0),
    ], atol=1e-12)  # fmt: skip


def test_collinear_pieces_and_repeated_points_are_merged() -> None:
    points = np.array([[0, 0, 0], [0.1, 0.0005, 0], [0.1, 0.0005, 0], [0.2, 0, 0], [0.5, 0.001, 0]])
    cage = cage_truth([polyline(points)])
    assert (cage.start_m.tolist(), cage.end_m.tolist()) == ([[0, 0, 0]], [[0.5, 0.001, 0]])


@pytest.mark.parametrize("steps", [72, 720, 7200])
def test_hoop_has_no_segment_at_any_resolution(steps: int) -> None:
    assert len(cage_truth([polyline(arc(0.4, 0, 300, steps))])) == 0


def test_short_straight_pieces_are_no_segments() -> None:
    assert len(cage_truth([bar(1, (0, 0, 0), (0.041, 0, 0), 0.01)])) == 1
    assert len(cage_truth([bar(1, (0, 0, 0), (0.039, 0, 0), 0.01)])) == 0


def test_grid_neighbours_exclude_diagonals() -> None:
    grid = [
        bar(1 + 3 * i + j, (0.02 * i, 0.02 * j, 0), (0.02 * i, 0.02 * j, 1), 0.007)
        for i in range(3)
        for j in range(3)
    ]
    sides = {(n, n + 3) for n in range(1, 7)} | {(n, n + 1) for n in range(1, 10) if n % 3}
    cage = cage_truth(grid)
    assert pairs_of(cage) == sides
    np.testing.assert_allclose(cage.match_radius_m, 0.01)


def test_bar_between_two_bars_separates_them() -> None:
    left, right = bar(1, (0, 0, 0), (0, 0, 1)), bar(2, (0.2, 0, 0), (0.2, 0, 1))
    assert pairs_of(cage_truth([left, right])) == {(1, 2)}
    assert pairs_of(cage_truth([left, right, bar(3, (0.1, 0, 0), (0.1, 0, 1))])) == {(1, 3), (2, 3)}
    # A bar that ends below the middle of the two does not separate them there.
    assert (1, 2) in pairs_of(cage_truth([left, right, bar(3, (0.1, 0, 0), (0.1, 0, 0.4))]))


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (bar(2, (0.1, 0, 0), (0.2, 0, 1)), "5.7 degrees off"),
        (bar(2, (0.1, 0, 0.95), (0.1, 0, 2)), "50 mm of overlap"),
        (bar(2, (0.0202, 0, 0), (0.0202, 0, 1)), "lapped"),
        (bar(2, (0.51, 0, 0), (0.51, 0, 1)), "too far"),
        (bar(1, (0.1, 0, 0), (0.1, 0, 1)), "the same bar"),
    ],
)
def test_bars_that_are_no_neighbours(other: Bar, why: str) -> None:
    assert pairs_of(cage_truth([bar(1, (0, 0, 0), (0, 0, 1)), other])) == set(), why


def test_pairs_are_independent_of_direction_and_order() -> None:
    forward = [bar(i, (0.1 * i, 0, 0), (0.1 * i, 0, 1)) for i in range(1, 5)]
    backward = [bar(i, (0.1 * i, 0, 1), (0.1 * i, 0, 0)) if i % 2 else forward[i - 1] for i in range(1, 5)]
    unordered = {frozenset(pair) for pair in pairs_of(cage_truth(backward[::-1]))}
    assert unordered == {frozenset(pair) for pair in pairs_of(cage_truth(forward))}


def test_match_radius_is_half_the_spacing_and_bounded() -> None:
    bars = [bar(1, (0, 0, 0), (0, 0, 1)), bar(2, (0.06, 0, 0), (0.06, 0, 1)), bar(3, (0.4, 0, 0), (0.4, 0, 1))]
    np.testing.assert_allclose(cage_truth(bars).match_radius_m, [0.03, 0.03, MAX_MATCH_RADIUS_M])
    np.testing.assert_allclose(cage_truth(bars[:1]).match_radius_m, [MAX_MATCH_RADIUS_M])


def test_points_on_bends_and_ends_belong_to_no_segment() -> None:
    cage = cage_truth([L_BAR, bar(2, (0, 0, 0.1), (0.2, 0, 0.1), 0.01)])
    on_bend_m = arc(0.025, -85, -5, 8) + np.array([0.2, 0.025, 0.005])
    points_m = np.concatenate([
        [[0.1, 0, 0.005], [0.225, 0.1, 0.005], [0.2305, 0.1, 0]],  # both legs, and a rib's top
        [[-0.001, 0, 0.005], [0, 0, 0.002], [0.1, 0, 0.03]],  # past the end, on the flat end, far off
        [[0.1, 0, 0.095]],  # on bar 2
        on_bend_m,
    ])  # fmt: skip
    bar_id = np.ones(len(points_m), dtype=np.uint16)
    bar_id[6] = 2
    expected = [0, 1, 1, -1, -1, -1, 2] + [-1] * len(on_bend_m)
    segment_index = assign_segments(points_m, bar_id, cage)
    assert segment_index.dtype == np.int16
    assert segment_index.tolist() == expected
    order = np.random.default_rng(0).permutation(len(points_m))
    assert assign_segments(points_m[order], bar_id[order], cage).tolist() == np.array(expected)[order].tolist()


def test_points_of_other_bars_belong_to_no_segment() -> None:
    cage = cage_truth([L_BAR])
    assert assign_segments(np.array([[0.1, 0, 0.005]]), np.array([9], dtype=np.uint16), cage).tolist() == [-1]
    assert assign_segments(np.empty((0, 3)), np.empty(0, dtype=np.uint16), cage).tolist() == []
    assert assign_segments(
        np.array([[0.1, 0, 0.005]]), np.array([1], dtype=np.uint16), cage_truth([])
    ).tolist() == [-1]


def test_too_many_segments_raise_dataset_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(axes, "MAX_SEGMENTS", 1)
    with pytest.raises(DatasetError, match="2 straight runs, expected up to 1"):
        cage_truth([L_BAR])
