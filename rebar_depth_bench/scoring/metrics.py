"""The numbers of protocol ``rebar-1``: pure functions on the scored pixels of one view, in float64 metres.

``z_m`` is ground truth, ``p_m`` the prediction on the same pixels, both of length n >= 1, finite and > 0.
Definitions: Eigen et al., "Depth Map Prediction from a Single Image using a Multi-Scale Deep Network",
NeurIPS 2014, section 4; the median scale follows Zhou et al., CVPR 2017, applied to each view by itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from rebar_depth_bench.scoring.protocol import DELTA1_RATIO

_CHUNK = 8192
_SAMPLE = 4096


@dataclass(frozen=True)
class DepthMetrics:
    """Errors of one view, or their means over views.

    ``abs_rel`` = mean(|p - z| / z); ``rmse_cm`` = 100 sqrt(mean((p - z)^2)); ``mae_cm`` = 100 mean(|p - z|);
    ``delta1`` = share of pixels with max(p/z, z/p) < 1.25.
    """

    abs_rel: float
    rmse_cm: float
    mae_cm: float
    delta1: float


def depth_metrics(p_m: Float[ndarray, " n"], z_m: Float[ndarray, " n"], scale: float = 1.0) -> DepthMetrics:
    """Return the errors of ``scale`` times a prediction; too large to square gives ``inf``, no warning."""
    [metrics], _ = aligned_metrics(p_m, z_m, (scale,))
    return metrics


def aligned_metrics(
    p_m: Float[ndarray, " n"],
    z_m: Float[ndarray, " n"],
    scales: Sequence[float],
    tolerances_mm: Sequence[int] = (),
) -> tuple[list[DepthMetrics], dict[int, int]]:
    """Return ``depth_metrics`` at each scale, and how many pixels of the first are within each tolerance.

    One pass over the pixels for all of it, in parts that stay in the processor's cache: arrays of a whole view
    would be mapped, cleared and given back for every operation, which takes longer than the arithmetic.
    """
    sums = [_Sums(dict.fromkeys(() if place else tolerances_mm, 0)) for place in range(len(scales))]
    scaled, work = np.empty((2, _CHUNK))
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        for start in range(0, len(z_m), _CHUNK):
            part = slice(start, start + _CHUNK)
            p, z = p_m[part].astype(np.float64), z_m[part].astype(np.float64)
            for one, scale in zip(sums, scales, strict=True):
                at_scale = p if scale == 1.0 else np.multiply(p, scale, out=scaled[: len(p)])
                one.add(at_scale, z, work[: len(p)])
    return [one.metrics(len(z_m)) for one in sums], sums[0].within_mm


def median_scale(p_m: Float[ndarray, " n"], z_median_m: float) -> float:
    """Return the oracle scale s = median(z) / median(p); an even count takes the mean of the two middle values.

    ``z_median_m`` is the median of the truth on the very pixels of ``p_m``.
    """
    with np.errstate(over="ignore", divide="ignore"):
        return float(np.float64(z_median_m) / median(p_m))


def median(values: Float[ndarray, " n"]) -> float:
    """Return the exact median of finite values in float64; an even count takes the mean of the two middle values.

    A sample brackets the middle, so that only a twentieth of the values is partitioned: a third of
    ``numpy.median``'s time on a view.
    """
    count = len(values)
    ranks = ((count - 1) // 2, count // 2)
    inside, below = _middle_part(values, *ranks) if count >= 4 * _SAMPLE else (values, 0)
    places = [rank - below for rank in ranks]
    low, high = np.partition(inside, places)[places].astype(np.float64)
    return float(low if low == high else low + (high - low) / 2)


def is_prediction(p_m: Float[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return which values are predictions: finite and > 0."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(p_m) & (p_m > 0))


@dataclass
class _Sums:
    """Sums over the pixels gone through so far, from which ``DepthMetrics`` follow."""

    within_mm: dict[int, int]
    absolute_m: float = 0.0
    square_m2: float = 0.0
    relative: float = 0.0
    inliers: int = 0

    def add(self, p: Float64[ndarray, " m"], z: Float64[ndarray, " m"], work: Float64[ndarray, " m"]) -> None:
        """Take in some pixels; what ``work`` holds is lost."""
        # z has room for the factor in float64: products compare exactly where quotients would round.
        self.inliers += np.count_nonzero(p < np.multiply(z, DELTA1_RATIO, out=work))
        self.inliers -= np.count_nonzero(z >= np.multiply(p, DELTA1_RATIO, out=work))  # of those just counted
        error_m = np.subtract(p, z, out=work)
        np.abs(error_m, out=error_m)
        for tolerance_mm in self.within_mm:
            self.within_mm[tolerance_mm] += int(np.count_nonzero(error_m <= tolerance_mm / 1000.0))
        self.absolute_m += float(np.add.reduce(error_m))
        self.square_m2 += float(error_m @ error_m)
        self.relative += float(np.add.reduce(np.divide(error_m, z, out=error_m)))

    def metrics(self, count: int) -> DepthMetrics:
        """Return the means over ``count`` pixels."""
        return DepthMetrics(
            abs_rel=self.relative / count,
            rmse_cm=100.0 * math.sqrt(self.square_m2 / count),
            mae_cm=100.0 * self.absolute_m / count,
            delta1=self.inliers / count,
        )


def _middle_part(values: Float[ndarray, " n"], low_rank: int, high_rank: int) -> tuple[ndarray, int]:
    """Return some of the values, among them those of both ranks, and how many values lie below all of them."""
    sample = np.sort(values[:: len(values) // _SAMPLE])
    middle, margin = len(sample) // 2, len(sample) // 42  # three standard deviations of a sample's median
    low, high = sample[middle - margin], sample[middle + margin]
    below = int(np.count_nonzero(values < low))
    inside = values[(values >= low) & (values <= high)]
    if below <= low_rank and high_rank < below + len(inside):
        return inside, below
    return values, 0  # the sample misled
