"""95 % intervals of a config's numbers: a bootstrap that resamples blocks of neighbouring views.

Views next to each other see nearly the same steel, so their errors are alike; drawing single views would make
the intervals too narrow. Blocks of consecutive views keep that likeness: the circular block bootstrap of Politis
and Romano ("A circular block-resampling procedure for stationary data", 1992), percentile intervals.

The intervals say how far a number would move with other views of the same scenes from the same protocol. They say
nothing about other cages, lights or cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

DRAWS = 2000
LEVEL = 0.95
RING_VIEWS = 12
"""Block length in steps of the full protocol: a dome's ring of azimuths."""

MIN_VIEWS = 5
"""With fewer views there is no interval: a handful of values says too little of their own spread."""

_MIN_BLOCKS = 4
_SEED = 0
_NUMBERS_AT_ONCE = 4_000_000

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Resampling:
    """How often each of n views, in protocol order, is in each of ``DRAWS`` resamples of n views."""

    counts: Float64[ndarray, "draws n"]

    def means(self, values: Float64[ndarray, "n k"]) -> Float64[ndarray, "draws k"]:
        """Return the mean of each column in each resample; NaN marks a view without a value.

        NaN where a resample has no value, and in a column with too few values (``MIN_VIEWS``) or an infinity.
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
        """Return in each resample the mean of samples pooled over views; ``view`` says whose each sample is.

        NaN where a resample has no sample, and everywhere with too few views (``MIN_VIEWS``) or an infinity.
        """
        if len(np.unique(view)) < MIN_VIEWS or not np.isfinite(samples).all():
            return np.full(len(self.counts), np.nan)
        views = self.counts.shape[1]
        totals = np.stack([np.bincount(view, weights, views) for weights in (samples, np.ones(len(samples)))], 1)
        sums = self.counts @ totals
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums[:, 0] / sums[:, 1]
        return np.asarray(means)

    def percentile(
        self, samples: Float64[ndarray, " m"], view: Int64[ndarray, " m"], percent: float
    ) -> Float64[ndarray, " draws"]:
        """Return in each resample a percentile of samples pooled over views; ``view`` says whose each sample is.

        That is the smallest sample with at least that share of samples at or below it; of a median where the share
        is met exactly, the mean of it and the next.
        NaN where a resample has no sample, and everywhere with too few views (``MIN_VIEWS``) or an infinity.
        """
        if len(np.unique(view)) < MIN_VIEWS or not np.isfinite(samples).all():
            return np.full(len(self.counts), np.nan)
        order = np.argsort(samples, kind="stable")
        ordered, owner = samples[order], view[order]
        step = max(1, _NUMBERS_AT_ONCE // len(samples))
        parts = [
            _weighted_percentile(ordered, self.counts[start : start + step, owner], percent)
            for start in range(0, len(self.counts), step)
        ]
        return np.concatenate(parts)


def interval(estimates: Float64[ndarray, " draws"]) -> Interval | None:
    """Return the percentile interval of a number's estimates over resamples, None of none; NaN does not count."""
    known = estimates[np.isfinite(estimates)]
    if not len(known):
        return None
    low, high = np.percentile(known, [50 * (1 - LEVEL), 50 * (1 + LEVEL)])
    return float(low), float(high)


def resample(indices: Sequence[int]) -> Resampling:
    """Return the resamples of views, given their indices in the full protocol, ascending.

    The same indices give the same resamples, on any machine: raw PCG64 numbers do not change between versions.
    """
    n = len(indices)
    length = block_length(indices)
    blocks = -(-n // length)
    starts = (np.random.PCG64(_SEED).random_raw(DRAWS * blocks) % max(n, 1)).astype(np.int64)
    views = (starts.reshape(DRAWS, blocks, 1) + np.arange(length)).reshape(DRAWS, -1)[:, :n] % max(n, 1)
    flat = views + n * np.arange(DRAWS)[:, None]
    counts = np.bincount(flat.ravel(), minlength=DRAWS * n).reshape(DRAWS, n)
    return Resampling(counts.astype(np.float64))


def block_length(indices: Sequence[int]) -> int:
    """Return how many views make a block: as many as lie on ``RING_VIEWS`` steps of the full protocol, at least 1.

    A sparse subset, whose views are farther apart than that, is drawn view by view.
    """
    n = len(indices)
    if n < 2:
        return 1
    stride = max(1.0, (indices[-1] - indices[0]) / (n - 1))
    return max(1, min(round(RING_VIEWS / stride), n // _MIN_BLOCKS))


def _weighted_percentile(
    ordered: Float64[ndarray, " m"], weights: Float64[ndarray, "draws m"], percent: float
) -> Float64[ndarray, " draws"]:
    below = np.cumsum(weights, axis=1)
    wanted = below[:, -1] * percent / 100
    lower = ordered[np.minimum((below < wanted[:, None]).sum(axis=1), len(ordered) - 1)]
    if percent != 50:
        return np.where(below[:, -1] > 0, lower, np.nan)
    upper = ordered[np.minimum((below <= wanted[:, None]).sum(axis=1), len(ordered) - 1)]
    return np.where(below[:, -1] > 0, (lower + upper) / 2, np.nan)
