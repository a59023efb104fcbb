"""Intervals and verdicts of surveys, whose views are resampled one by one within each distance."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import t as student

from rebar_depth_bench import SubmissionWriter, score
from rebar_depth_bench.detections.crossing_scorer import score_crossings
from rebar_depth_bench.scoring import bootstrap
from rebar_depth_bench.scoring.bootstrap import MIN_BLOCKS, RESAMPLES, Resampling, interval, resample_survey
from rebar_depth_bench.scoring.comparison import Difference, compare
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.results import result, scored_view, table_of
from tests.damage import change_manifest
from tests.mat_dataset import CONFIG, VIEWS, write_mat_dataset

PER_DISTANCE = 12
UNEQUAL = (12, 7, 12, 5)
"""Numbers of views with a value at four distances."""


def indices(views: tuple[int, ...]) -> list[int]:
    """Return the indices of the first views of each distance."""
    return [PER_DISTANCE * distance + view for distance, count in enumerate(views) for view in range(count)]


def resampling_of(views: tuple[int, ...]) -> Resampling:
    return resample_survey(indices(views), PER_DISTANCE)


def test_views_are_drawn_singly_within_their_distance() -> None:
    resampling, distance = resampling_of(UNEQUAL), np.repeat(range(4), UNEQUAL)
    assert resampling.counts.shape == (RESAMPLES, len(distance))
    for number, views in enumerate(UNEQUAL):
        drawn = resampling.counts[:, distance == number]
        assert (drawn.sum(axis=1) == views).all()
        assert drawn.mean(axis=0) == pytest.approx(1, abs=0.1)
        # Draws with replacement: two views have the covariance -1/n of a multinomial distribution.
        assert np.cov(drawn.T)[0, 1] == pytest.approx(-1 / views, abs=0.06)
    assert abs(np.corrcoef(resampling.counts[:, distance == 0][:, -1], resampling.counts[:, 12])[0, 1]) < 0.06
    assert resampling.blocks() == (sum(UNEQUAL), 4)
    assert resampling.blocks(np.flatnonzero(distance < 2)) == (UNEQUAL[0] + UNEQUAL[1], 2)


def test_each_further_distance_needs_a_view_more() -> None:
    for distances in (1, 2, 4):
        for views in (MIN_BLOCKS + distances - 2, MIN_BLOCKS + distances - 1):
            counts = (*[1] * (distances - 1), views - distances + 1)
            resampling = resampling_of(counts)
            found = interval(resampling.means(np.ones((views, 1)))[:, 0], resampling.blocks())
            assert (found is not None) == (views - distances >= MIN_BLOCKS - 1)


@pytest.mark.slow
@pytest.mark.parametrize("views", [(12,) * 4, UNEQUAL, (4, 4, 4), (11,)])
def test_interval_contains_the_mean_as_often_as_stated(views: tuple[int, ...]) -> None:
    """The distances differ far more than their views: their means are 0, 3, 6 and 9 standard deviations."""
    resampling, simulated = resampling_of(views), 2000
    means = 3.0 * np.repeat(range(len(views)), views)
    values = means[:, None] + np.random.default_rng(3).normal(size=(len(means), simulated))
    draws, blocks = resampling.means(values), resampling.blocks()
    ends = np.array([interval(draws[:, k], blocks) for k in range(simulated)])
    contained = np.mean((ends[:, 0] <= means.mean()) & (means.mean() <= ends[:, 1]))
    assert contained == pytest.approx(0.95, abs=0.02)


def of_survey(rank_errors: np.ndarray, method: str) -> Result:
    """Return the result of a survey of four distances, all views predicted too far."""
    views = [
        scored_view(f"column/{index:04d}", float(error / (1 - error))) for index, error in enumerate(rank_errors)
    ]
    table = table_of(views, views_per_distance=len(views) // 4)
    return replace(result(*views, method=method), tables={"column": table})


def rank_row(first: Result, other: Result) -> Difference:
    return next(row for row in compare(first, other).configs["column"] if row.column.place == "rank_error")


def test_difference_of_48_views_is_decided_by_students_interval() -> None:
    rng = np.random.default_rng(1)
    of_distance = np.repeat([0.05, 0.1, 0.15, 0.2], 12)
    errors = of_distance + rng.uniform(0, 0.05, 48)
    others = errors + 2 * of_distance + rng.uniform(0, 0.1, 48)
    row = rank_row(of_survey(errors, "a"), of_survey(others, "b"))
    assert row.verdict == "worse"
    changes = (others - errors).reshape(4, 12)
    error = math.sqrt(changes.var(axis=1, ddof=1).mean() / 48) * student.ppf(0.975, 44)
    assert row.interval == pytest.approx((changes.mean() - error, changes.mean() + error), abs=0.1 * error)


def test_few_views_of_a_survey_are_named() -> None:
    errors = np.linspace(0.1, 0.2, 8)
    row = rank_row(of_survey(errors, "a"), of_survey(errors + 0.5, "b"))
    assert (row.interval, row.verdict) == (None, "too few views")


def test_few_scenes_are_named() -> None:
    results = []
    for error in (0.1, 0.8):
        views = [scored_view(f"column/test-s{index % 3}-{index:04d}", error) for index in range(60)]
        results.append(replace(result(*views), tables={"column": table_of(views, split="test")}))
    assert rank_row(*results).verdict == "too few scenes"


def as_survey(root: Path, config: str, distances: int, views: int) -> None:
    """Change the cameras of a config with ``views`` views to those of a survey."""
    protocol: dict[str, Any] = {"kind": "survey", "distances_m": [1.0] * distances}
    protocol["views_per_distance"] = views // distances
    change_manifest(root, lambda _, entry: entry["scenes"][0].update(protocol=protocol), config)


def test_all_results_of_a_survey_have_its_intervals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six consecutive views of a ring are one block, and six views of a survey are six."""
    monkeypatch.setattr(bootstrap, "MIN_BLOCKS", VIEWS)
    depths = write_mat_dataset(tmp_path / "mat")
    archive, detected = tmp_path / "a.zip", tmp_path / "a.csv"
    with SubmissionWriter(archive, "a") as writer:
        for view_id, depth_m in depths.items():
            if view_id.startswith(f"{CONFIG}/"):
                writer.add(view_id, 1.01 * depth_m)
    detected.write_text("view_id,x,y,z\n" + f"{CONFIG}/0000,0,0,0.4\n")
    for is_survey in (False, True):
        if is_survey:
            as_survey(tmp_path / "mat", CONFIG, 1, VIEWS)
        scored = score(archive, tmp_path / "mat", extended=True)
        assert scored.extended is not None
        estimates = scored.extended.tables[CONFIG].numbers["native"].values()
        written = read_result(scored.to_json(), "result.json")
        assert written.tables[CONFIG].views_per_distance == (VIEWS if is_survey else None)
        found = score_crossings(detected, tmp_path / "mat").to_dict()
        assert (scored.tables[CONFIG].intervals["rank_error"] is not None) == is_survey
        assert any(estimate.interval is not None for estimate in estimates) == is_survey
        assert (found["ci95"]["recall"] is not None) == is_survey
