"""Alignment measures: depth errors after alignments other than the median scale, and the spread of that scale.

p is the prediction and z the ground truth on a view's n scored pixels that have a prediction, in metres. Every
alignment is an oracle: it is computed from the ground truth. None of these measures ranks.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, finite_sample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.columns import METRICS
from rebar_depth_bench.scoring.metrics import depth_metrics, is_valid_prediction, median, median_scale


def log_scale(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> float:
    """Return the least-squares scale in log depth: exp(mean(log z/p)) (Eigen et al. 2014, eq. 1)."""
    return float(np.exp(np.mean(np.log(z_m / p_m))))


def scale_and_shift(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> tuple[float, float]:
    """Return (a, b), b in metres, that minimise sum (a p + b - z)^2.

    A constant prediction is only shifted (a = 1). MiDaS (Ranftl et al. 2020, eq. 3) applies the same fit to
    disparity; this one applies it to depth.
    """
    unit_m = float(np.max(p_m))  # normalised: squares of predictions near the limits of float64 would overflow
    q, z_mean_m = p_m / unit_m, float(np.mean(z_m))
    deviation = q - np.mean(q)
    sum_of_squares = float(deviation @ deviation)
    is_constant = sum_of_squares <= len(q) * 1e-24
    a = 1.0 if is_constant else float(deviation @ (z_m - z_mean_m)) / sum_of_squares / unit_m
    return a, z_mean_m - a * unit_m * float(np.mean(q))


def scale_invariant_log(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> float:
    """Return the standard deviation of d = log z/p over pixels: sqrt(mean d^2 - (mean d)^2).

    Eigen et al. 2014, eq. 2.
    """
    return float(np.std(np.log(z_m / p_m)))


def alignment_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's alignment samples.

    ``p_m`` is the native planar depth on ``truth.index`` in metres, NaN where there is no prediction. Each sample
    has one value, or none where the view has no prediction or the number overflows: ``scale`` (the median scale
    s) and its logarithm, ``scale_explains`` (the share of AbsRel that s removes, where AbsRel is above 0),
    ``log_scaled_*`` (metrics after the least-squares scale in log depth), ``shifted_*`` (metrics after
    least-squares scale and shift), ``shift_cm`` and ``silog``.
    """
    pixels = truth.interior & is_valid_prediction(p_m)
    p, z = p_m[pixels], truth.depth_m[pixels].astype(np.float64)
    if not len(p):
        return {}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        s = median_scale(p, median(z))
        a, b_m = scale_and_shift(p, z)
        native, scaled = depth_metrics(p, z).abs_rel, depth_metrics(p, z, s).abs_rel
        aligned = {"log_scaled": depth_metrics(p, z, log_scale(p, z)), "shifted": depth_metrics(a * p + b_m, z)}
        numbers = {
            "scale": s,
            "log_of_scale": math.log(s) if 0 < s < math.inf else None,
            "scale_explains": 1 - scaled / native if native > 0 else None,
            "shift_cm": 100 * b_m,
            "silog": scale_invariant_log(p, z),
            **{f"{key}_{name}": getattr(of_key, name) for key, of_key in aligned.items() for name in METRICS},
        }
    return {name: finite_sample(value) for name, value in numbers.items()}


_ALIGNMENTS = {
    "log_scaled": ("log scale", "the least-squares scale in log depth, exp(mean(log z - log p))"),
    "shifted": ("scale and shift", "least-squares scale and shift in depth, min sum (a p + b - z)^2"),
}
"""Title and description of the alignments whose metrics are measures."""

MEASURES = (
    Measure("scale_mean", "Scale s, mean", "", "", "mean over views of s = median(z)/median(p)", "scale"),
    Measure(
        "scale_spread", "Scale s, spread", "%", "",
        "standard deviation of log s over views: a constant s can be corrected on site, a varying one cannot",
        "log_of_scale", "std",
    ),
    Measure(
        "scale_explains", "Native error that scale explains", "%", "",
        "1 - scaled AbsRel / native AbsRel, median over views; negative where the median scale makes it worse",
        statistic="median",
    ),
    *(
        Measure(
            f"{key}_{name}", f"{info.title}, {title}", info.unit, "",
            f"{info.title} after {alignment}, an oracle per view",
        )
        for key, (title, alignment) in _ALIGNMENTS.items()
        for name, info in METRICS.items()
    ),
    Measure("shift_cm", "Shift b", "cm", "", "mean over views of the least-squares shift b"),
    Measure(
        "silog", "Scale-invariant log error", "%", "",
        "standard deviation of log p - log z over a view's pixels",
    ),
)  # fmt: skip
"""Alignment measures in table order."""
