"""Block bootstrap of table metrics: 95 % intervals over resampled views or scenes.

Neighbouring views show nearly the same steel, so their errors are correlated, and resampling single views would
give intervals that are too narrow. Resampling blocks of consecutive views preserves the correlation: circular
block bootstrap of Politis and Romano ("A circular block-resampling procedure for stationary data", 1992). These
intervals describe the variation with other views of the same scene from the same trajectory, not with other
cages, lights or cameras.

The views of a survey are spread over the steel, and views at one distance are exchangeable. They are resampled one
by one within each distance: stratified bootstrap (Davison and Hinkley, "Bootstrap Methods and their Application",
1997, section 3.2).

In a config of several scenes, which are drawn independently of each other, whole scenes with all of their views
are resampled: cluster bootstrap of Field and Welsh ("Bootstrapping clustered data", Journal of the Royal
Statistical Society B 69, 2007). These intervals describe the variation with other scenes of the same generator.

The ends of an interval are expanded percentiles (Hesterberg, "What teachers should know about the bootstrap", The
American Statistician 69, 2015), because plain percentiles of few blocks are too narrow. ``benchmarks.intervals``
simulates how often intervals contain the true mean.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.base.names import scene_of

RESAMPLES = 2000
"""Number of bootstrap resamples (draws)."""

CONFIDENCE_LEVEL = 0.95
"""Confidence level of the intervals."""

BLOCK_VIEWS = 12
"""Block length in steps of the full trajectory: one ring of azimuths of the dome."""

MIN_BLOCKS = 8
"""Smallest number of blocks of views, or of scenes, with values for which an interval is computed.

A survey needs one view more for each distance after the first.
"""

INTERVALS: Mapping[str, Any] = {"method": "expanded-percentile-2", "draws": RESAMPLES, "level": CONFIDENCE_LEVEL}
"""Entry ``intervals`` of the JSON of results: how all of their intervals were computed.

Method 2 resamples the views of a survey one by one.
"""

_SEED = 0
_VIEW_INDEX = re.compile("[0-9]{4,9}")

Interval = tuple[float, float]


class Blocks(NamedTuple):
    """Number of blocks of views, or of scenes, and of the distances of a survey within which they are drawn."""

    number: int
    distances: int = 1

    @property
    def degrees_of_freedom(self) -> int:
        """Number of independent deviations of blocks from the mean of their distance."""
        return self.number - self.distances

    @property
    def are_enough(self) -> bool:
        """Whether an interval is computed from so many."""
        return self.degrees_of_freedom >= MIN_BLOCKS - 1


@dataclass(frozen=True, eq=False)
class Resampling:
    """Bootstrap resamples of n views, in which units are drawn: single views, or scenes with all of their views.

    ``counts[i, j]`` is the number of times that unit j occurs in resample i; there are ``RESAMPLES`` resamples.
    ``unit`` holds the unit of each view; ``length`` is the number of consecutive views that are drawn together.
    ``distance`` is the number of the distance of each view of a survey, within which it is drawn.
    """

    counts: Float64[ndarray, "draws units"]
    unit: Int64[ndarray, " n"]
    length: int = 1
    distance: Int64[ndarray, " n"] | None = None

    @property
    def view_counts(self) -> Float64[ndarray, "draws n"]:
        """Number of times that each view occurs in each resample."""
        return self.counts[:, self.unit]

    def blocks(self, view: Int64[ndarray, " m"] | None = None) -> Blocks:
        """Return the number of blocks of ``length`` views, or of scenes, that have any of some views.

        ``view`` holds positions of views, in any order and any number of times; all views by default.
        """
        chosen = slice(None) if view is None else view
        distances = 1 if self.distance is None else len(np.unique(self.distance[chosen]))
        return Blocks(len(np.unique(self.unit[chosen] // self.length)), distances)

    def means(self, values: Float64[ndarray, "n k"]) -> Float64[ndarray, "draws k"]:
        """Return the mean of each column in each resample; NaN in ``values`` marks a view without a value.

        The result is NaN where a resample has no value, and in columns with an infinite value.
        """
        present = self.sums((~np.isnan(values)).astype(np.float64))
        sums = self.counts @ self.sums(np.where(np.isfinite(values), values, 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums / (self.counts @ present)
        return np.where(np.isinf(values).any(axis=0), np.nan, means)

    def sums(self, values: Float64[ndarray, "n k"]) -> Float64[ndarray, "units k"]:
        """Return the sums of each column over the views of each unit."""
        sums = np.zeros((self.counts.shape[1], values.shape[1]))
        np.add.at(sums, self.unit, values)
        return sums

    def pooled_means(
        self, samples: Float64[ndarray, " m"], view: Int64[ndarray, " m"]
    ) -> Float64[ndarray, " draws"]:
        """Return the mean of samples pooled over views in each resample; ``view`` is each sample's view index.

        The result is NaN where a resample has no sample, and everywhere if a sample is not finite.
        """
        if not np.isfinite(samples).all():
            return np.full(len(self.counts), np.nan)
        unit, units = self.unit[view], self.counts.shape[1]
        totals = np.stack([np.bincount(unit, weights, units) for weights in (samples, np.ones(len(samples)))], 1)
        sums = self.counts @ totals
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums[:, 0] / sums[:, 1]
        return np.asarray(means)

    def medians(self, values: Float64[ndarray, " n"]) -> Float64[ndarray, " draws"]:
        """Return the median over views in each resample; NaN in ``values`` marks a view without a value.

        The result is NaN in the cases of ``percentile``.
        """
        present = np.flatnonzero(~np.isnan(values))
        return self.percentile(values[present], present, 50)

    def percentile(
        self, samples: Float64[ndarray, " m"], view: Int64[ndarray, " m"], percent: float
    ) -> Float64[ndarray, " draws"]:
        """Return a percentile of samples pooled over views in each resample; ``view`` is each sample's view index.

        The percentile is the smallest sample with at least ``percent`` of the samples at or below it. For the
        median (``percent`` = 50), if exactly half of the samples are at or below it, the mean of this sample and
        the next one is returned.

        The result is NaN where a resample has no sample, and everywhere if a sample is not finite.
        """
        if not len(samples) or not np.isfinite(samples).all():
            return np.full(len(self.counts), np.nan)
        order = np.argsort(samples, kind="stable")
        ordered, unit = samples[order], self.unit[view[order]]
        # Weights are added by blocks of samples, about the square root of their number, which makes a percentile
        # hundreds of times faster. They are whole numbers: no sum is rounded, and the order has no effect.
        size, units = math.isqrt(len(unit)), self.counts.shape[1]
        blocks = -(-len(unit) // size)
        samples_by_block = np.bincount(unit * blocks + np.arange(len(unit)) // size, minlength=units * blocks)
        ends = np.cumsum(self.counts @ samples_by_block.reshape(units, blocks).astype(np.float64), axis=1)
        totals = ends[:, -1]
        places = partial(_first_places, self.counts, unit, ends, totals * percent / 100)
        values = ordered[places(np.less)]
        if percent == 50:
            values = (values + ordered[places(np.less_equal)]) / 2
        return np.where(totals > 0, values, np.nan)


def half_width(blocks: Blocks) -> float:
    """Return half the width of the interval of a normal mean of two or more blocks, in standard deviations.

    The deviation is taken over the means of resamples. The half width is sqrt(u / (u - d)) t for u blocks at d
    distances: variance in resamples is (u - d) / u of that in samples, if each distance has as many blocks, and t
    is Student's quantile for u - d degrees of freedom.
    """
    from scipy.special import stdtrit  # A tenth of a second to import.

    degrees = blocks.degrees_of_freedom
    return math.sqrt(blocks.number / degrees) * float(stdtrit(degrees, (1 + CONFIDENCE_LEVEL) / 2))


def end_percents(blocks: Blocks) -> tuple[float, float]:
    """Return the percentiles of the estimates over resamples that are the ends of the interval."""
    low = 100 * NormalDist().cdf(-half_width(blocks))
    return low, 100 - low


def interval(estimates: Float64[ndarray, " draws"], blocks: Blocks) -> Interval | None:
    """Return the interval of the finite estimates over resamples; None if there are none, or too few blocks.

    ``blocks`` are the ``Resampling.blocks`` with a value.
    """
    finite = estimates[np.isfinite(estimates)]
    if not blocks.are_enough or not len(finite):
        return None
    low, high = np.percentile(finite, end_percents(blocks))
    return float(low), float(high)


def resample(indices: Sequence[int]) -> Resampling:
    """Return the resamples of views, given their ascending indices in the full trajectory.

    Blocks have the views on ``BLOCK_VIEWS`` steps of the full trajectory; the views of a sparse subset, which are
    farther apart than that, are resampled one by one.

    The same indices give the same resamples on every machine, since the raw PCG64 stream does not change between
    NumPy versions.
    """
    n = len(indices)
    stride = max(1.0, (indices[-1] - indices[0]) / (n - 1)) if n > 1 else BLOCK_VIEWS
    length = max(1, round(BLOCK_VIEWS / stride))
    blocks = -(-n // length)
    starts = (np.random.PCG64(_SEED).random_raw(RESAMPLES * blocks) % max(n, 1)).astype(np.int64)
    views = (starts.reshape(RESAMPLES, blocks, 1) + np.arange(length)).reshape(RESAMPLES, -1)[:, :n] % max(n, 1)
    return Resampling(_counts(views, n), np.arange(n), length)


def resample_scenes(scenes: Sequence[str]) -> Resampling:
    """Return the resamples of whole scenes, given the scene of each view.

    Each resample draws as many scenes as there are, with replacement. The same order of the scenes gives the same
    resamples on every machine.
    """
    number = {scene: index for index, scene in enumerate(dict.fromkeys(scenes))}
    n = len(number)
    drawn = (np.random.PCG64(_SEED).random_raw(RESAMPLES * n) % max(n, 1)).astype(np.int64).reshape(RESAMPLES, n)
    return Resampling(_counts(drawn, n), np.array([number[scene] for scene in scenes], np.int64))


def resample_survey(indices: Sequence[int], views_per_distance: int) -> Resampling:
    """Return the resamples of the views of a survey, given their ascending indices in the full trajectory.

    The full trajectory has ``views_per_distance`` views at each distance, one distance after the other. Each
    resample has as many views of a distance as there are, drawn with replacement. The same indices give the same
    resamples on every machine.
    """
    n, distance = len(indices), np.array(indices, np.int64) // views_per_distance
    _, first, views = np.unique(distance, return_index=True, return_counts=True)
    numbers = np.random.PCG64(_SEED).random_raw(RESAMPLES * n).reshape(RESAMPLES, n)
    places = (numbers % np.repeat(views, views).astype(np.uint64)).astype(np.int64)
    return Resampling(_counts(np.repeat(first, views) + places, n), np.arange(n), distance=distance)


def resample_views(
    view_ids: Sequence[str], *, by_scene: bool, views_per_distance: int | None = None
) -> Resampling:
    """Return the resamples of views: of whole scenes if ``by_scene``, otherwise of blocks of consecutive views.

    Scenes are resampled in configs of several scenes, which are those with splits. The views of a survey, which
    has ``views_per_distance``, are resampled one by one.
    """
    if by_scene:
        return resample_scenes([scene_of(view_id) for view_id in view_ids])
    indices = trajectory_indices(view_ids)
    return resample(indices) if views_per_distance is None else resample_survey(indices, views_per_distance)


def trajectory_indices(view_ids: Sequence[str]) -> list[int]:
    """Return each view's index in its full trajectory: the four or more digits at the end of its view_id.

    If the ids do not all end with such an index, or are not in its ascending order, return the positions in the
    sequence.
    """
    suffixes = [view_id.rpartition("/")[2] for view_id in view_ids]
    if all(map(_VIEW_INDEX.fullmatch, suffixes)):
        indices = list(map(int, suffixes))
        if indices == sorted(indices):
            return indices
    return list(range(len(suffixes)))


def _counts(drawn: Int64[ndarray, "draws n"], units: int) -> Float64[ndarray, "draws units"]:
    """Return how often each of the units occurs in each row of ``drawn``."""
    flat = drawn + units * np.arange(RESAMPLES)[:, None]
    return np.bincount(flat.ravel(), minlength=RESAMPLES * units).reshape(RESAMPLES, units).astype(np.float64)


def _first_places(
    counts: Float64[ndarray, "draws units"],
    unit: Int64[ndarray, " m"],
    ends: Float64[ndarray, "draws blocks"],
    threshold: Float64[ndarray, " draws"],
    is_below: np.ufunc,
) -> Int64[ndarray, " draws"]:
    """Return the first of ordered samples whose cumulative weight is not ``is_below`` the threshold.

    ``unit`` is that of each sample, and ``ends`` are the cumulative weights at the ends of blocks of them.
    """
    draw, blocks = np.arange(len(counts)), ends.shape[1]
    block = np.minimum(is_below(ends, threshold[:, None]).sum(axis=1), blocks - 1)
    before = np.where(block > 0, ends[draw, block - 1], 0.0)
    # Places behind the last sample have a unit of weight 0.
    size = math.isqrt(len(unit))
    padded = np.full(blocks * size, counts.shape[1])
    padded[: len(unit)] = unit
    weights = np.pad(counts, ((0, 0), (0, 1)))[draw[:, None], padded.reshape(blocks, size)[block]]
    inside = is_below(before[:, None] + np.cumsum(weights, axis=1), threshold[:, None]).sum(axis=1)
    return np.asarray(np.minimum(block * size + inside, len(unit) - 1))
