"""The numbers of protocol ``rebar-1``: pure functions on the scored pixels of one view, in float64 metres.

``z_m`` is ground truth, ``p_m`` the prediction on the same pixels, both of length n >= 1, finite and > 0.
Definitions: Eigen et al., "Depth Map Prediction from a Single Image using a Multi-Scale Deep Network",
NeurIPS 2014, section 4; the median scale follows Zhou et al., CVPR 2017, applied to each view by itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from rebar_depth_bench.protocol import DELTA1_RATIO

_CHUNK = 8192
_SAMPLE = 512


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
    absolute_m = square_m2 = relative = 0.0
    inliers = 0
    with np.errstate(over="ignore", under="ignore", divide="ignore", invalid="ignore"):
        for p, z in _chunks(p_m, z_m):
            if scale != 1.0:
                p *= scale
            # z has room for the factor in float64, so the comparison is exact where a division would round.
            inliers += np.count_nonzero((p < DELTA1_RATIO * z) & (z < DELTA1_RATIO * p))
            error_m = np.abs(np.subtract(p, z, out=p), out=p)
            absolute_m += float(error_m.sum())
            square_m2 += float(error_m @ error_m)
            relative += float(np.divide(error_m, z, out=error_m).sum())
    count = len(z_m)
    return DepthMetrics(
        abs_rel=relative / count,
        rmse_cm=100.0 * math.sqrt(square_m2 / count),
        mae_cm=100.0 * absolute_m / count,
        delta1=inliers / count,
    )


def median_scale(p_m: Float[ndarray, " n"], z_median_m: float) -> float:
    """Return the oracle scale s = median(z) / median(p); an even count takes the mean of the two middle values.

    ``z_median_m`` is the median of the truth on the very pixels of ``p_m``.
    """
    with np.errstate(over="ignore", divide="ignore"):
        return float(np.float64(z_median_m) / median(p_m))


def median(values: Float[ndarray, " n"]) -> float:
    """Return the exact median of finite values in float64; an even count takes the mean of the two middle values.

    A sample brackets the middle, so that only a tenth of the values is partitioned: a third of ``numpy.median``'s
    time on a view.
    """
    count = len(values)
    ranks = ((count - 1) // 2, count // 2)
    inside, below = _middle_part(values, *ranks) if count >= 16 * _SAMPLE else (values, 0)
    places = [rank - below for rank in ranks]
    low, high = np.partition(inside, places)[places].astype(np.float64)
    return float(low + (high - low) / 2)


def is_prediction(p_m: Float[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return which values are predictions: finite and > 0."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(p_m) & (p_m > 0))


def shares_within(
    p_m: Float[ndarray, " n"], z_m: Float[ndarray, " n"], scored_px: int, tolerances_mm: Sequence[int]
) -> dict[int, float]:
    """Return for each tolerance the share of ALL ``scored_px`` pixels with |p - z| no larger.

    The arrays hold the pixels that have a prediction; the others are failures.
    """
    counts = dict.fromkeys(tolerances_mm, 0)
    for p, z in _chunks(p_m, z_m):
        error_m = np.abs(np.subtract(p, z, out=p), out=p)
        for tolerance_mm in tolerances_mm:
            counts[tolerance_mm] += int(np.count_nonzero(error_m <= tolerance_mm / 1000.0))
    return {tolerance_mm: count / scored_px for tolerance_mm, count in counts.items()}


def _chunks(
    p_m: Float[ndarray, " n"], z_m: Float[ndarray, " n"]
) -> Iterator[tuple[Float64[ndarray, " m"], Float64[ndarray, " m"]]]:
    """Yield float64 copies of both arrays, part by part.

    Parts stay in the processor's cache; whole views would be mapped, cleared and given back for every operation,
    which takes longer than the arithmetic.
    """
    for start in range(0, len(z_m), _CHUNK):
        part = slice(start, start + _CHUNK)
        yield p_m[part].astype(np.float64), z_m[part].astype(np.float64)


def _middle_part(values: Float[ndarray, " n"], low_rank: int, high_rank: int) -> tuple[ndarray, int]:
    """Return some of the values, among them those of both ranks, and how many values lie below all of them."""
    sample = np.sort(values[:: len(values) // _SAMPLE])
    middle, margin = len(sample) // 2, len(sample) // 16  # three standard deviations of a sample's median
    low, high = sample[middle - margin], sample[middle + margin]
    below = int(np.count_nonzero(values < low))
    inside = values[(values >= low) & (values <= high)]
    if below <= low_rank and high_rank < below + len(inside):
        return inside, below
    return values, 0  # the sample misled
