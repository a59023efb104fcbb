"""Scale against shape: the spread of the median scale, and the error that no scale removes.

p is the prediction and z the ground truth on a view's n scored pixels that have a prediction, in metres. None of
these measures ranks.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, finite_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction, median, median_scale


def scale_invariant_log(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> float:
    """Return the standard deviation of d = log z/p over pixels: sqrt(mean d^2 - (mean d)^2).

    Eigen et al. 2014, eq. 2.
    """
    return float(np.std(np.log(z_m) - np.log(p_m)))


def alignment_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's alignment samples.

    ``p_m`` is the native planar depth on ``truth.index`` in metres, NaN where there is no prediction. The
    logarithm of the median scale s and ``silog`` have one value each, or none where the view has no prediction or
    the number overflows.
    """
    pixels = truth.interior & is_valid_prediction(p_m)
    p, z = p_m[pixels], truth.depth_m[pixels].astype(np.float64)
    if not len(p):
        return {}
    with np.errstate(over="ignore"):
        s = median_scale(p, median(z))
    return {
        "log_of_scale": finite_sample(math.log(s) if 0 < s < math.inf else None),
        "silog": finite_sample(scale_invariant_log(p, z)),
    }


MEASURES = (
    Measure(
        "scale_spread", "Scale s, spread", "%", "",
        "standard deviation of log s over views: a constant s can be corrected on site, a varying one cannot",
        "log_of_scale", "std",
    ),
    Measure(
        "silog", "Scale-invariant log error", "%", "",
        "standard deviation of log p - log z over a view's pixels",
    ),
)  # fmt: skip
"""Alignment measures in table order."""
