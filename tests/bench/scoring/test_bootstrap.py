"""Tests of bootstrap confidence intervals: independent formulas, correlated views and undefined intervals."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest

from rebar_depth_bench.base.names import view_id
from rebar_depth_bench.scoring.bootstrap import (
    MIN_BLOCKS,
    RESAMPLES,
    Blocks,
    half_width,
    interval,
    resample,
    resample_scenes,
    resample_views,
    trajectory_indices,
)


def mean_interval(values: np.ndarray, indices: range) -> tuple[float, float] | None:
    resampling = resample(indices)
    return interval(resampling.means(values[:, None])[:, 0], resampling.blocks(np.flatnonzero(~np.isnan(values))))


def test_resamples_have_equal_size_and_draw_whole_blocks() -> None:
    counts = resample(range(504)).counts
    assert counts.shape == (RESAMPLES, 504)
    assert (counts.sum(axis=1) == 504).all()
    assert abs(counts.mean(axis=0) - 1.0).max() < 0.2
    # Neighbouring views are drawn together 11 times in 12; independent draws would be uncorrelated.
    assert np.corrcoef(counts[:, 100], counts[:, 101])[0, 1] == pytest.approx(11 / 12, abs=0.03)
    assert abs(np.corrcoef(counts[:, 100], counts[:, 113])[0, 1]) < 0.1


@pytest.mark.parametrize(
    ("indices", "length"),
    [
        (range(504), 12),
        (range(100), 12),
        (range(6, 504, 12), 1),  # one view of each ring: no two views are neighbours
        (range(2, 504, 4), 3),
        (range(20), 12),
        (range(1), 1),
        (range(0), 1),
    ],
)
def test_block_length_is_one_ring_of_full_protocol(indices: range, length: int) -> None:
    assert resample(indices).length == length


@pytest.mark.parametrize("first", [0, 9_990, 99_990])
def test_blocks_do_not_depend_on_the_digits_of_view_ids(first: int) -> None:
    view_ids = [view_id("dome", index) for index in range(first, first + 60, 3)]
    assert trajectory_indices(view_ids) == list(range(first, first + 60, 3))
    expected = resample(range(0, 60, 3))
    np.testing.assert_array_equal(resample_views(view_ids, by_scene=False).counts, expected.counts)


@pytest.mark.parametrize(
    ("blocks", "t"),
    [
        (Blocks(8), 2.364624),
        (Blocks(10), 2.262157),
        (Blocks(24), 2.068658),
        (Blocks(61), 2.000298),
        (Blocks(14, 4), 2.228139),
        (Blocks(48, 4), 2.015368),
    ],
)
def test_ends_are_those_of_students_interval(blocks: Blocks, t: float) -> None:
    """Resamples of normal means give the interval mean +- t s / sqrt(n); t is from printed tables."""
    ratio = math.sqrt(blocks.number / (blocks.number - blocks.distances))
    assert half_width(blocks) == pytest.approx(ratio * t, rel=1e-6)
    draws = np.array([NormalDist(3.0, 0.5).inv_cdf((k + 0.5) / 100_000) for k in range(100_000)])
    error = t * 0.5 * ratio
    assert interval(draws, blocks) == pytest.approx((3 - error, 3 + error), abs=1e-3)


def test_blocks_and_scenes_with_values_are_counted() -> None:
    assert [resample(range(n)).blocks() for n in (504, 100, 20)] == [(42, 1), (9, 1), (2, 1)]
    assert resample(range(0, 504, 21)).blocks() == (24, 1)
    assert resample(range(504)).blocks(np.array([0, 11, 12, 503, 12])) == (3, 1)
    scenes = resample_scenes(["a", "b", "a", "c"])
    assert (scenes.blocks(), scenes.blocks(np.array([0, 2, 3]))) == ((3, 1), (2, 1))


@pytest.mark.slow
def test_intervals_of_few_views_contain_the_mean() -> None:
    """Plain percentiles of eight normal values contain their mean in 88 of 100 cases."""
    values = np.random.default_rng(12).normal(size=(8, 2000))
    draws = resample(range(0, 96, 12)).means(values)
    intervals = [interval(draws[:, k], Blocks(8)) for k in range(2000)]
    contain = [bounds is not None and bounds[0] <= 0 <= bounds[1] for bounds in intervals]
    assert 0.92 <= np.mean(contain) <= 0.96


@pytest.mark.slow
def test_block_interval_covers_mean_of_correlated_views() -> None:
    """Check that, if neighbours share errors, blocks cover the true mean and single draws miss it too often."""
    rng = np.random.default_rng(8)
    covered_by_blocks = covered_by_views = 0
    for _ in range(100):
        shocks = rng.normal(0, 1, 504 + 5)
        values = np.convolve(shocks, np.ones(6) / 6, mode="valid")
        blocks, views = mean_interval(values, range(504)), mean_interval(values, range(0, 504 * 12, 12))
        assert blocks is not None
        assert views is not None
        covered_by_blocks += blocks[0] <= 0 <= blocks[1]
        covered_by_views += views[0] <= 0 <= views[1]
    assert covered_by_blocks >= 85
    assert covered_by_views <= 75


def test_resampled_median_equals_numpy() -> None:
    values = np.random.default_rng(4).normal(size=11)
    resampling = resample(range(11))
    by_hand = [np.median(np.repeat(values, counts.astype(int))) for counts in resampling.counts]
    assert resampling.percentile(values, np.arange(11), 50) == pytest.approx(by_hand)


def test_few_infinite_or_nan_views_have_no_interval() -> None:
    few, enough = (range(0, 12 * count, 12) for count in (MIN_BLOCKS - 1, MIN_BLOCKS))
    assert mean_interval(np.ones(MIN_BLOCKS - 1), few) is None
    assert mean_interval(np.ones(MIN_BLOCKS), enough) == (1.0, 1.0)
    assert mean_interval(np.r_[np.ones(9), np.inf], range(0, 120, 12)) is None
    assert mean_interval(np.full(10, np.nan), range(0, 120, 12)) is None
    assert mean_interval(np.ones(84), range(84)) is None  # seven blocks
    values = np.array([np.nan, *np.ones(8), np.nan])
    assert mean_interval(values, range(0, 120, 12)) == (1.0, 1.0)
    values[3] = np.nan
    assert mean_interval(values, range(0, 120, 12)) is None  # seven values
    assert np.isnan(resample([]).percentile(np.empty(0), np.empty(0, np.int64), 50)).all()


SCENES = np.repeat(np.arange(7), [3, 1, 4, 2, 2, 5, 1])
"""Scene of each view."""


def test_whole_scenes_are_drawn() -> None:
    resampling = resample_scenes([f"cages/test-{scene}-" for scene in SCENES])
    assert resampling.counts.shape == (RESAMPLES, 7)
    assert (resampling.counts.sum(axis=1) == 7).all()
    assert abs(resampling.counts.mean(axis=0) - 1.0).max() < 0.1
    # Draws with replacement: two scenes have the covariance -1/7 of a multinomial distribution.
    assert np.cov(resampling.counts.T)[0, 1] == pytest.approx(-1 / 7, abs=0.05)


def test_statistics_of_drawn_scenes_equal_numpy() -> None:
    rng = np.random.default_rng(6)
    values = rng.normal(size=len(SCENES))
    values[[0, 4, 5]] = np.nan
    resampling = resample_scenes([str(scene) for scene in SCENES])
    view = np.repeat(np.arange(len(SCENES)), rng.integers(0, 4, len(SCENES)))
    samples = rng.normal(size=len(view))
    means, medians = resampling.means(values[:, None])[:, 0], resampling.medians(values)
    pooled, upper = resampling.pooled_means(samples, view), resampling.percentile(samples, view, 95)
    for draw in range(0, RESAMPLES, 97):
        drawn = np.repeat(np.arange(7), resampling.counts[draw].astype(int))
        views = np.concatenate([np.flatnonzero(scene == SCENES) for scene in drawn])
        assert means[draw] == pytest.approx(np.nanmean(values[views]))
        assert medians[draw] == pytest.approx(np.nanmedian(values[views]))
        pool = np.sort(np.concatenate([samples[view == one] for one in views]))
        assert pooled[draw] == pytest.approx(pool.mean())
        assert upper[draw] == pool[math.ceil(0.95 * len(pool)) - 1]


def test_few_scenes_have_no_interval_however_many_views() -> None:
    values, view = np.random.default_rng(2).normal(size=100), np.arange(100)
    few, enough = (resample_scenes([str(n % count) for n in view]) for count in (MIN_BLOCKS - 1, MIN_BLOCKS))
    for scenes, has_interval in ((few, False), (enough, True)):
        means, medians = scenes.means(values[:, None])[:, 0], scenes.medians(values)
        for estimates in (means, medians, scenes.pooled_means(values, view)):
            assert (interval(estimates, scenes.blocks()) is not None) == has_interval
    assert interval(resample_scenes([]).medians(np.empty(0)), Blocks(0)) is None


def test_view_counts_repeat_those_of_the_scenes_of_the_views() -> None:
    scenes = ["c", "a", "a", "b", "c", "d", "e"]
    resampling = resample_scenes(scenes)
    counts = resampling.view_counts
    assert counts.shape == (len(resampling.counts), len(scenes))
    np.testing.assert_array_equal(counts[:, 0], counts[:, 4])
    np.testing.assert_array_equal(counts[:, 1], counts[:, 2])
    assert (counts[:, [0, 1, 3, 5, 6]].sum(axis=1) == 5).all()
    np.testing.assert_array_equal(resample(range(8)).view_counts, resample(range(8)).counts)
