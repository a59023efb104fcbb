"""Scale against shape: other alignments beside the median scale, and what a correction on site could mend.

p is the prediction and z the truth on a view's n scored pixels with a prediction, in metres. The alignments are
oracles: they know the truth. None of them ranks.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import depth_metrics, is_prediction, median, median_scale

_NUMBERS = (("abs_rel", "AbsRel", ""), ("rmse_cm", "RMSE", "cm"), ("mae_cm", "MAE", "cm"), ("delta1", "δ1", ""))


def log_scale(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> float:
    """Return the scale that is least squares in log depth: exp(mean(log z/p)), Eigen et al. 2014, eq. 1."""
    return float(np.exp(np.mean(np.log(z_m / p_m))))


def scale_and_shift(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> tuple[float, float]:
    """Return (a, b), b in metres, that minimise sum (a p + b - z)^2; a prediction without relief is only shifted.

    MiDaS (Ranftl et al. 2020, eq. 3) does the same to disparity; this is depth.
    """
    unit_m = float(np.max(p_m))  # predictions near float64's limits could not be squared
    q, z_mean_m = p_m / unit_m, float(np.mean(z_m))
    from_mean = q - np.mean(q)
    spread = float(from_mean @ from_mean)
    flat = spread <= len(q) * 1e-24
    a = 1.0 if flat else float(from_mean @ (z_m - z_mean_m)) / spread / unit_m
    return a, z_mean_m - a * unit_m * float(np.mean(q))


def scale_invariant_log(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"]) -> float:
    """Return the spread of d = log z/p over pixels: sqrt(mean d^2 - (mean d)^2), Eigen et al. 2014, eq. 2."""
    return float(np.std(np.log(z_m / p_m)))


def alignment_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth) -> Samples:
    """Return a view's alignments; ``p_m`` is native planar depth on ``truth.index``, metres, NaN for none.

    One value each, none where the view has no prediction or a number overflows: the median scale s; how much of
    AbsRel it takes away (``scale_explains``); ``log_scaled_*`` after the least-squares scale in log depth;
    ``shifted_*`` after least-squares scale and shift; ``silog``.
    """
    pixels = truth.interior & is_prediction(p_m)
    p, z = p_m[pixels], truth.depth_m[pixels].astype(np.float64)
    samples: dict[str, float] = {}
    if len(p):
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            samples = _scale_numbers(p, z) | _log_numbers(p, z) | _shift_numbers(p, z)
    return {name: _known(samples.get(name)) for name in _SAMPLES}


def _scale_numbers(p: Float64[ndarray, " n"], z: Float64[ndarray, " n"]) -> dict[str, float]:
    s = median_scale(p, median(z))
    native, scaled = depth_metrics(p, z).abs_rel, depth_metrics(p, z, s).abs_rel
    numbers = {"scale": s, "log_of_scale": math.log(s) if 0 < s < math.inf else math.nan}
    if native > 0:
        numbers["scale_explains"] = 1 - scaled / native
    return numbers


def _log_numbers(p: Float64[ndarray, " n"], z: Float64[ndarray, " n"]) -> dict[str, float]:
    metrics = depth_metrics(p, z, log_scale(p, z))
    numbers = {f"log_scaled_{name}": getattr(metrics, name) for name, *_ in _NUMBERS}
    return {"silog": scale_invariant_log(p, z), **numbers}


def _shift_numbers(p: Float64[ndarray, " n"], z: Float64[ndarray, " n"]) -> dict[str, float]:
    a, b_m = scale_and_shift(p, z)
    metrics = depth_metrics(a * p + b_m, z)
    return {"shift_cm": 100 * b_m} | {f"shifted_{name}": getattr(metrics, name) for name, *_ in _NUMBERS}


def _known(value: float | None) -> Float64[ndarray, " one"]:
    return np.array([value] if value is not None and math.isfinite(value) else [], dtype=np.float64)


_SAMPLES = (
    *("scale", "log_of_scale", "scale_explains", "silog", "shift_cm"),
    *(f"{alignment}_{name}" for alignment in ("log_scaled", "shifted") for name, *_ in _NUMBERS),
)


def _aligned_measures(prefix: str, title: str, how: str) -> list[Measure]:
    names = [(f"{prefix}_{key}", head, unit) for key, head, unit in _NUMBERS]
    return [
        Measure(name, name, "mean", f"{head}, {title}", unit, "", f"{head} after {how}, an oracle per view")
        for name, head, unit in names
    ]


MEASURES: tuple[Measure, ...] = (
    Measure("scale_mean", "scale", "mean", "Scale s, mean", "", "", "mean over views of s = median(z)/median(p)"),
    Measure(
        "scale_spread",
        "log_of_scale",
        "std",
        "Scale s, spread",
        "%",
        "",
        "standard deviation of log s over views: a constant s can be corrected on site, a varying one cannot",
    ),
    Measure(
        "scale_explains",
        "scale_explains",
        "median",
        "Native error that scale explains",
        "%",
        "",
        "1 - scaled AbsRel / native AbsRel, median over views; negative where the median scale makes it worse",
    ),
    *_aligned_measures(
        "log_scaled", "log scale", "the least-squares scale in log depth, exp(mean(log z - log p))"
    ),
    *_aligned_measures(
        "shifted", "scale and shift", "least-squares scale and shift in depth, min sum (a p + b - z)^2"
    ),
    Measure("shift_cm", "shift_cm", "mean", "Shift b", "cm", "", "mean over views of the least-squares shift b"),
    Measure(
        "silog",
        "silog",
        "mean",
        "Scale-invariant log error",
        "%",
        "",
        "standard deviation of log p - log z over a view's pixels",
    ),
)
