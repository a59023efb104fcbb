"""Ranges of ranks: agreement with the paired comparison of the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from leaderboard.db import view_errors as view_errors_module
from leaderboard.db.view_errors import rank_ranges, view_errors
from rebar_depth_bench.scoring.bootstrap import interval, resample
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.score import tabulate
from tests.bench.reporting.results import result, scored_view

VIEWS = 40


def random_results(count: int, spread: float, seed: int) -> list[Result]:
    """Return results whose errors vary in common with the view and on their own."""
    rng = np.random.default_rng(seed)
    difficulty = rng.uniform(0.1, 0.3, VIEWS)
    results = []
    for number in range(count):
        errors = np.clip(difficulty + spread * number + rng.normal(0, 0.05, VIEWS), 0.01, 0.9)
        views = [scored_view(f"lattice/{12 * index:04d}", float(error)) for index, error in enumerate(errors)]
        results.append(result(*views, method=f"m{number}"))
    return results


@pytest.mark.parametrize("spread", [0.0, 0.01, 0.05])
def test_ranges_agree_with_the_paired_comparison(spread: float) -> None:
    results = random_results(8, spread, seed=3)
    ranges = rank_ranges([view_errors(one.to_dict(), "lattice") for one in results])
    for index, one in enumerate(results):
        verdicts = [
            next(row for row in compare(one, other).configs["lattice"] if row.column.path == "rank_error").verdict
            for number, other in enumerate(results)
            if number != index
        ]
        assert ranges[index] == (1 + verdicts.count("better"), len(results) - verdicts.count("worse"))


def test_pairs_on_few_skewed_views_are_those_of_the_interval() -> None:
    """Pairs that are decided without draws are those whose interval excludes zero, also for eight blocks."""
    resampling = resample(range(0, 96, 12))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        spread = np.where(np.arange(12) % 2, 0.1, 0.03)[:, None]
        errors = rng.exponential(0.1, 8) + 0.03 * np.arange(12)[:, None] + spread * rng.exponential(size=(12, 8))
        means = resampling.means(errors.T).T
        better = view_errors_module._is_better(means, resampling.blocks())
        intervals = [[interval(a - b, resampling.blocks()) for b in means] for a in means]
        assert better.tolist() == [[bounds is not None and bounds[1] < 0 for bounds in row] for row in intervals]


def test_range_contains_the_rank() -> None:
    results = random_results(60, 0.002, seed=5)
    errors = [one.tables["lattice"].rank_error or 0.0 for one in results]
    ranges = rank_ranges([view_errors(one.to_dict(), "lattice") for one in results])
    for error, rank_range in zip(errors, ranges, strict=True):
        assert rank_range is not None
        assert rank_range[0] <= 1 + sum(other < error for other in errors) <= rank_range[1]


def test_scenes_are_resampled_in_a_config_with_splits() -> None:
    """Views of a scene share their error: two submissions that differ in few scenes are not told apart."""
    rng = np.random.default_rng(4)
    scenes, results = 10, []
    for number in range(3):
        of_scene = rng.uniform(0.1, 0.3, scenes) + 0.03 * number
        ids = [f"cages/test-s{scene}-{index:04d}" for scene in range(scenes) for index in range(8)]
        views = [scored_view(view_id, float(of_scene[n // 8])) for n, view_id in enumerate(ids)]
        results.append(replace(result(), tables={"cages": tabulate(views, split="test")}, views=views))
    ranges = rank_ranges([view_errors(one.to_dict(), "cages") for one in results])
    for index, one in enumerate(results):
        verdicts = [
            next(row for row in compare(one, other).configs["cages"] if row.column.path == "rank_error").verdict
            for number, other in enumerate(results)
            if number != index
        ]
        assert ranges[index] == (1 + verdicts.count("better"), len(results) - verdicts.count("worse"))
    assert "undecided" in verdicts


def test_too_few_views_allow_every_rank() -> None:
    results = [result(scored_view("lattice/0000", error)) for error in (0.1, 0.5)]
    assert rank_ranges([view_errors(one.to_dict(), "lattice") for one in results]) == [(1, 2), (1, 2)]


def test_rows_without_view_errors_or_with_other_views_have_no_range() -> None:
    full, part = random_results(1, 0, 1)[0], result(scored_view("lattice/0000"))
    packed = [view_errors(one.to_dict(), "lattice") for one in (full, full, part)]
    assert rank_ranges([*packed, None])[2:] == [None, None]
    assert rank_ranges(packed)[:2] == [(1, 2), (1, 2)]
    assert rank_ranges(packed[:1]) == [None]
    assert json.loads(packed[2] or "") == [["lattice/0000"], [part.to_dict()["views"][0]["rank_error"]]]
