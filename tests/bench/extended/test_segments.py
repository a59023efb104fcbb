from __future__ import annotations

import numpy as np
import pytest

from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.extended.inspection import segments as cage_module
from rebar_depth_bench.extended.inspection.segments import MAX_REACH_M, CageTruth, assign_runs, cage_truth
from tests.bench.extended.cage_scenes import bar


def polyline(points: np.ndarray, bar_id: int = 1, diameter_m: float = 0.01) -> Bar:
    return Bar(bar_id, "bar", diameter_m, tuple(map(tuple, points.tolist())))


def arc(radius_m: float, from_deg: float, to_deg: float, steps: int) -> np.ndarray:
    angle = np.deg2rad(np.linspace(from_deg, to_deg, steps + 1))
    return np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(steps + 1)])


def pairs_of(cage: CageTruth) -> set[tuple[int, int]]:
    ids = cage.bar_id[cage.neighbours]
    return {(int(first), int(second)) for first, second in ids}


# An L: 0.2 m along x, a bend of 25 mm in 5-degree steps, 0.15 m along y.
BEND = arc(0.025, -90, 0, 18) + np.array([0.2, 0.025, 0])
L_BAR = polyline(np.concatenate([[[0, 0, 0]], BEND, [[0.225, 0.175, 0]]]))


def test_a_bent_bar_has_a_run_on_each_side_of_its_bend() -> None:
    runs = cage_truth([L_BAR]).runs
    assert [run.bar_id for run in runs] == [1, 1]
    np.testing.assert_allclose([(*run.start_m, *run.end_m) for run in runs], [
        (0, 0, 0, 0.2, 0, 0), (0.225, 0.025, 0, 0.225, 0.175, 0),
    ], atol=1e-12)  # fmt: skip


def test_collinear_segments_and_repeated_points_make_one_run() -> None:
    points = np.array([[0, 0, 0], [0.1, 0.0005, 0], [0.1, 0.0005, 0], [0.2, 0, 0], [0.5, 0.001, 0]])
    (run,) = cage_truth([polyline(points)]).runs
    assert (run.start_m, run.end_m) == ((0, 0, 0), (0.5, 0.001, 0))


@pytest.mark.parametrize("steps", [72, 720, 7200])
def test_a_hoop_has_no_run_however_finely_it_is_drawn(steps: int) -> None:
    assert cage_truth([polyline(arc(0.4, 0, 300, steps))]).runs == ()


def test_short_straight_pieces_are_no_runs() -> None:
    assert len(cage_truth([bar(1, (0, 0, 0), (0.041, 0, 0), 0.01)]).runs) == 1
    assert cage_truth([bar(1, (0, 0, 0), (0.039, 0, 0), 0.01)]).runs == ()


def test_neighbours_of_a_square_grid_are_its_sides_and_not_its_diagonals() -> None:
    grid = [
        bar(1 + 3 * i + j, (0.02 * i, 0.02 * j, 0), (0.02 * i, 0.02 * j, 1), 0.007)
        for i in range(3)
        for j in range(3)
    ]
    sides = {(n, n + 3) for n in range(1, 7)} | {(n, n + 1) for n in range(1, 10) if n % 3}
    cage = cage_truth(grid)
    assert pairs_of(cage) == sides
    np.testing.assert_allclose(cage.reach_m, 0.01)


def test_a_bar_between_parts_a_pair_only_where_it_stands() -> None:
    left, right = bar(1, (0, 0, 0), (0, 0, 1)), bar(2, (0.2, 0, 0), (0.2, 0, 1))
    assert pairs_of(cage_truth([left, right])) == {(1, 2)}
    assert pairs_of(cage_truth([left, right, bar(3, (0.1, 0, 0), (0.1, 0, 1))])) == {(1, 3), (2, 3)}
    # One that ends below the middle of the two does not come between them there.
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
def test_what_is_no_neighbour(other: Bar, why: str) -> None:
    assert pairs_of(cage_truth([bar(1, (0, 0, 0), (0, 0, 1)), other])) == set(), why


def test_direction_and_order_of_drawing_do_not_matter() -> None:
    forward = [bar(i, (0.1 * i, 0, 0), (0.1 * i, 0, 1)) for i in range(1, 5)]
    backward = [bar(i, (0.1 * i, 0, 1), (0.1 * i, 0, 0)) if i % 2 else forward[i - 1] for i in range(1, 5)]
    unordered = {frozenset(pair) for pair in pairs_of(cage_truth(backward[::-1]))}
    assert unordered == {frozenset(pair) for pair in pairs_of(cage_truth(forward))}


def test_reach_is_half_way_to_the_nearest_parallel_run_and_bounded() -> None:
    bars = [bar(1, (0, 0, 0), (0, 0, 1)), bar(2, (0.06, 0, 0), (0.06, 0, 1)), bar(3, (0.4, 0, 0), (0.4, 0, 1))]
    np.testing.assert_allclose(cage_truth(bars).reach_m, [0.03, 0.03, MAX_REACH_M])
    np.testing.assert_allclose(cage_truth(bars[:1]).reach_m, [MAX_REACH_M])


def test_points_go_to_the_run_they_stand_on_and_bends_and_ends_to_none() -> None:
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
    found = assign_runs(points_m, bar_id, cage)
    assert found.dtype == np.int16
    assert found.tolist() == expected
    order = np.random.default_rng(0).permutation(len(points_m))
    assert assign_runs(points_m[order], bar_id[order], cage).tolist() == np.array(expected)[order].tolist()


def test_points_of_other_bars_and_no_points_are_on_no_run() -> None:
    cage = cage_truth([L_BAR])
    assert assign_runs(np.array([[0.1, 0, 0.005]]), np.array([9], dtype=np.uint16), cage).tolist() == [-1]
    assert assign_runs(np.empty((0, 3)), np.empty(0, dtype=np.uint16), cage).tolist() == []
    assert assign_runs(np.array([[0.1, 0, 0.005]]), np.array([1], dtype=np.uint16), cage_truth([])).tolist() == [
        -1
    ]
    with pytest.raises(ValueError, match=r"points_m has shape \(1, 3\)"):
        assign_runs(np.zeros((1, 3)), np.zeros(2, dtype=np.uint16), cage)


def test_more_runs_than_numbers_is_said_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cage_module, "MAX_RUNS", 1)
    with pytest.raises(DatasetError, match="2 straight runs, expected up to 1"):
        cage_truth([L_BAR])
