"""The numbers of protocol ``rebar-1``: pure functions on the scored pixels of one view, in float64 metres.

``z_m`` is ground truth, ``p_m`` the prediction on the same pixels, both of length n >= 1, finite and > 0.
Definitions: Eigen et al., "Depth Map Prediction from a Single Image using a Multi-Scale Deep Network",
NeurIPS 2014, section 4; the median scale follows Zhou et al., CVPR 2017, applied to each view by itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from rebar_depth_bench.protocol import DELTA1_RATIO


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


def depth_metrics(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> DepthMetrics:
    """Return the errors of a prediction as it stands. Values too large to square give ``inf``, never a warning."""
    count = len(z_m)
    with np.errstate(over="ignore", under="ignore", divide="ignore", invalid="ignore"):
        ratio = np.maximum(p_m / z_m, z_m / p_m)
        error_m = p_m - z_m
        np.abs(error_m, out=error_m)  # in place: fresh arrays of this size cost more than the arithmetic
        mae_m = float(np.mean(error_m))
        rmse_m = float(np.sqrt(np.einsum("i,i->", error_m, error_m) / count))
        relative = np.divide(error_m, z_m, out=error_m)
        return DepthMetrics(
            abs_rel=float(np.mean(relative)),
            rmse_cm=100.0 * rmse_m,
            mae_cm=100.0 * mae_m,
            delta1=float(np.count_nonzero(ratio < DELTA1_RATIO) / count),
        )


def median_scale(p_m: Float64[ndarray, " n"], z_median_m: float) -> float:
    """Return the oracle scale s = median(z) / median(p); an even count takes the mean of the two middle values.

    ``z_median_m`` is the median of the truth on the very pixels of ``p_m``.
    """
    with np.errstate(over="ignore"):
        return float(z_median_m / np.median(p_m))


def is_prediction(p_m: Float[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return which values are predictions: finite and > 0."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(p_m) & (p_m > 0))


def shares_within(
    error_m: Float64[ndarray, " n"], scored_px: int, tolerances_mm: Iterable[int]
) -> dict[int, float]:
    """Return for each tolerance the share of ALL ``scored_px`` pixels with an absolute error no larger.

    ``error_m`` holds the pixels that have a prediction; the others are failures.
    """
    return {t: float(np.count_nonzero(error_m <= t / 1000.0)) / scored_px for t in tolerances_mm}
