"""Block bootstrap of table metrics: 95 % percentile intervals over resampled views.

Neighbouring views show nearly the same steel, so their errors are correlated, and resampling single views would
give intervals that are too narrow. Resampling blocks of consecutive views preserves the correlation: circular
block bootstrap of Politis and Romano ("A circular block-resampling procedure for stationary data", 1992).

The intervals describe the variation with other views of the same scenes from the same camera protocol. They do
not describe the variation with other cages, lights or cameras. Where a number describes a config of many scenes,
whole scenes are resampled (``resample_scenes``), and its interval describes the variation with other scenes of
this kind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

RESAMPLES = 2000
"""Number of bootstrap resamples (draws)."""

CONFIDENCE_LEVEL = 0.95
"""Confidence level of the intervals."""

BLOCK_VIEWS = 12
"""Block length in steps of the full camera protocol: one ring of azimuths of the dome."""

MIN_VIEWS = 5
"""Smallest number of views for which an interval is computed; fewer values do not determine their spread."""

_MIN_BLOCKS = 4
_SEED = 0

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Resampling:
    """Bootstrap resamples of n views in protocol order.

    ``counts[i, j]`` is the number of times that view j occurs in resample i; there are ``RESAMPLES`` resamples.
    """

    counts: Float64[ndarray, "draws n"]

    def means(self, values: Float64[ndarray, "n k"]) -> Float64[ndarray, "draws k"]:
        """Return the mean of each column in each resample; NaN in ``values`` marks a view without a value.

        The result is NaN where a resample has no value, and in columns with fewer than ``MIN_VIEWS`` values or
        with an infinite value.
        """
        present = ~np.isnan(values)
        sums = self.counts @ np.where(np.isfinite(values), values, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums / (self.counts @ present.astype(np.float64))
        usable = (present.sum(axis=0) >= MIN_VIEWS) & ~np.isinf(values).any(axis=0)
        return np.where(usable, means, np.nan)

    def pooled_means(
        self, samples: Float64[ndarray, " m"], view: Int64[ndarray, " m"]
    ) -> Float64[ndarray, " draws"]:
        """Return the mean of samples pooled over views in each resample; ``view`` is each sample's view index.

        The result is NaN where a resample has no sample, and everywhere if fewer than ``MIN_VIEWS`` views have
        samples or a sample is not finite.
        """
        if len(np.unique(view)) < MIN_VIEWS or not np.isfinite(samples).all():
            return np.full(len(self.counts), np.nan)
        views = self.counts.shape[1]
        totals = np.stack([np.bincount(view, weights, views) for weights in (samples, np.ones(len(samples)))], 1)
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

        The result is NaN where a resample has no sample, and everywhere if fewer than ``MIN_VIEWS`` views have
        samples or a sample is not finite.
        """
        if len(np.unique(view)) < MIN_VIEWS or not np.isfinite(samples).all():
            return np.full(len(self.counts), np.nan)
        order = np.argsort(samples, kind="stable")
        ordered, ranks = samples[order], _Ranks.of(self.counts, view[order])
        threshold = ranks.totals * percent / 100
        values = ordered[ranks.below(threshold, inclusive=False)]
        if percent == 50:
            values = (values + ordered[ranks.below(threshold, inclusive=True)]) / 2
        return np.where(ranks.totals > 0, values, np.nan)


def interval(estimates: Float64[ndarray, " draws"]) -> Interval | None:
    """Return the percentile interval of the finite estimates over resamples, or None if no estimate is finite."""
    finite = estimates[np.isfinite(estimates)]
    if not len(finite):
        return None
    low, high = np.percentile(finite, [50 * (1 - CONFIDENCE_LEVEL), 50 * (1 + CONFIDENCE_LEVEL)])
    return float(low), float(high)


def resample(indices: Sequence[int]) -> Resampling:
    """Return the resamples of views, given their ascending indices in the full camera protocol.

    The same indices give the same resamples on every machine, since the raw PCG64 stream does not change between
    NumPy versions.
    """
    n = len(indices)
    length = block_length(indices)
    blocks = -(-n // length)
    starts = (np.random.PCG64(_SEED).random_raw(RESAMPLES * blocks) % max(n, 1)).astype(np.int64)
    views = (starts.reshape(RESAMPLES, blocks, 1) + np.arange(length)).reshape(RESAMPLES, -1)[:, :n] % max(n, 1)
    flat = views + n * np.arange(RESAMPLES)[:, None]
    counts = np.bincount(flat.ravel(), minlength=RESAMPLES * n).reshape(RESAMPLES, n)
    return Resampling(counts.astype(np.float64))


def resample_scenes(scenes: Sequence[str]) -> Resampling:
    """Return resamples of views of which all views of a scene are drawn together; ``scenes`` has one name per
    view.

    Fewer than ``MIN_VIEWS`` scenes do not determine a spread; then there is no resample.
    """
    names, scene = np.unique(np.array(scenes, dtype=np.str_), return_inverse=True)
    draws = RESAMPLES if len(names) >= MIN_VIEWS else 0
    chosen = (np.random.PCG64(_SEED).random_raw(draws * len(names)) % max(len(names), 1)).astype(np.int64)
    flat = chosen + len(names) * np.repeat(np.arange(draws), len(names))
    counts = np.bincount(flat, minlength=draws * len(names)).reshape(draws, len(names))
    return Resampling(counts[:, scene].astype(np.float64))


def block_length(indices: Sequence[int]) -> int:
    """Return the number of views per block: those on ``BLOCK_VIEWS`` steps of the full camera protocol, at least
    1.

    The views of a sparse subset, which are farther apart than that, are resampled one by one.
    """
    n = len(indices)
    if n < 2:
        return 1
    stride = max(1.0, (indices[-1] - indices[0]) / (n - 1))
    return max(1, min(round(BLOCK_VIEWS / stride), n // _MIN_BLOCKS))


@dataclass(frozen=True, eq=False)
class _Ranks:
    """Cumulative weights of ordered samples in each resample, by blocks of about the square root of their number.

    The blocks make a percentile hundreds of times faster than adding up all samples. Weights are whole numbers, so
    that no sum is rounded and the order of additions has no effect. ``view`` has the view of each place of the
    blocks; places behind the last sample have a view of weight 0.
    """

    counts: Float64[ndarray, "draws v"]
    view: Int64[ndarray, "blocks size"]
    ends: Float64[ndarray, "draws blocks"]
    samples: int

    @classmethod
    def of(cls, counts: Float64[ndarray, "draws n"], view: Int64[ndarray, " m"]) -> _Ranks:
        """Return the weights of ordered samples, given the view of each."""
        size = max(1, math.isqrt(len(view)))
        blocks, views = -(-len(view) // size), counts.shape[1]
        places = np.full(blocks * size, views)
        places[: len(view)] = view
        block = np.arange(len(view)) // size
        samples_by_view = np.bincount(view * blocks + block, minlength=views * blocks).reshape(views, blocks)
        ends = np.cumsum(counts @ samples_by_view.astype(np.float64), axis=1)
        return cls(np.pad(counts, ((0, 0), (0, 1))), places.reshape(blocks, size), ends, len(view))

    @property
    def totals(self) -> Float64[ndarray, " draws"]:
        """Weight of all samples in each resample."""
        return self.ends[:, -1]

    def below(self, threshold: Float64[ndarray, " draws"], *, inclusive: bool) -> Int64[ndarray, " draws"]:
        """Return the first place with a cumulative weight of ``threshold`` or more; of more, if ``inclusive``."""
        compare = np.less_equal if inclusive else np.less
        draw = np.arange(len(self.counts))
        block = np.minimum(compare(self.ends, threshold[:, None]).sum(axis=1), len(self.view) - 1)
        before = np.where(block > 0, self.ends[draw, block - 1], 0.0)
        weights = self.counts[draw[:, None], self.view[block]]
        inside = compare(before[:, None] + np.cumsum(weights, axis=1), threshold[:, None]).sum(axis=1)
        return np.asarray(np.minimum(block * self.view.shape[1] + inside, self.samples - 1))
