"""Errors of relative depth by protocol ``rebar-relative-1``: predictions are aligned with the truth of each view.

x is the prediction and z the true planar depth in metres, both float64, on V, the scored pixels of a view where x
has a value. Every pixel has the same weight and every view its own fit:

================  ==========================  ===============================================================
kind              V                           aligned depth p
================  ==========================  ===============================================================
scale             x is finite and above 0     x median(z) / median(x), the scaled numbers of ``rebar-2``
affine-depth      x is finite                 a x + b, which minimises the sum of (a x + b - z)^2
affine-disparity  x is finite                 1 / max(a x + b, 1 / max(z)); a and b minimise the sum of
                                              (a x + b - 1/z)^2
================  ==========================  ===============================================================

A fit with a slope a <= 0, of fewer than two pixels or of a constant x is replaced by a = 0 and b = mean of the
target. The robust variant of the affine kinds has a = mean|y - median(y)| / mean|x - median(x)| and
b = median(y) - a median(x) for the target y (MiDaS: Ranftl et al., TPAMI 2022, equation 5), and the same bound of
the disparity.

Every alignment uses the truth, so that none ranks. Beside each stands the constant of the same fit (a = 0):
median(z) for scale, else the mean of the target. The error counts 1 outside V and where p <= 0 or overflows; the
other metrics take p as it is, over V, and a p <= 0 is not counted in delta1.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Float64, Integer
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import (
    is_valid_prediction,
    median,
    median_scale,
    metrics_at_scales,
    rank_error,
)
from rebar_depth_bench.scoring.protocol import WITHIN_MM

ALIGNMENT_BY_KIND: Mapping[str, str] = {
    "scale": "depth up to a scale, p = x median(z) / median(x) in each view",
    "affine-depth": "depth up to scale and shift, p = a x + b fitted to z in each view",
    "affine-disparity": "disparity up to scale and shift, 1 / p = a x + b fitted to 1 / z in each view",
}
"""Kinds of predictions that are not metric, and how they are aligned."""


def has_value(x: Float[ndarray, " n"], kind: str) -> Bool[ndarray, " n"]:
    """Return where a prediction of this kind has a value."""
    return np.isfinite(x) if kind.startswith("affine") else is_valid_prediction(x)


def aligned_numbers(x: Float[ndarray, " n"], z_m: Float[ndarray, " n"], kind: str) -> dict[str, float]:
    """Return the numbers of a view's prediction ``x`` and true depth ``z_m``, metres, on all its scored pixels.

    ``coverage`` is the share of these in V; ``is_flat`` is whether the fit has no positive slope.
    """
    valid = has_value(x, kind)
    values, z = x[valid].astype(np.float64), z_m[valid].astype(np.float64)
    alignments = ("aligned", "constant") if kind == "scale" else ("aligned", "aligned_robust", "constant")
    numbers = {"scored_px": len(z_m), "coverage": len(z) / len(z_m), "is_flat": float(kind != "scale")}
    if not len(z):
        for alignment in alignments:
            numbers[f"{alignment}.error"] = 1.0
            numbers |= {f"{alignment}.within_mm.{tolerance_mm}": 0.0 for tolerance_mm in WITHIN_MM}
        return numbers
    if kind == "scale":
        with np.errstate(over="ignore"):
            depths = [values * median_scale(values, median(z)), np.full(len(z), median(z))]
    else:
        target = 1.0 / z if kind == "affine-disparity" else z
        values = _within_range(values, values)
        least_squares, robust = _least_squares(values, target), _robust_fit(values, target)
        fits = (least_squares, robust, (0.0, float(target.mean())))
        depths = [_fitted_depth(fit, values, z, kind) for fit in fits]
        numbers["is_flat"] = float(least_squares[0] == 0.0)
    for alignment, p_m in zip(alignments, depths, strict=True):
        everywhere = np.zeros(len(z_m))
        everywhere[valid] = p_m
        numbers[f"{alignment}.error"] = rank_error(everywhere, z_m, np.isfinite(everywhere) & (everywhere > 0))
        [metrics], within = metrics_at_scales(p_m, z, (1.0,), WITHIN_MM)
        numbers |= {f"{alignment}.{name}": value for name, value in vars(metrics).items()}
        numbers |= {f"{alignment}.within_mm.{limit_mm}": count / len(z_m) for limit_mm, count in within.items()}
    return numbers


def metric_as(depth_m: Float[ndarray, "h w"], kind: str) -> Float64[ndarray, "h w"]:
    """Return metric predictions as values of another kind: disparity is 1 / depth; NaN where there are none."""
    values = np.where(is_valid_prediction(depth_m), depth_m, np.nan).astype(np.float64)
    with np.errstate(over="ignore"):
        return 1.0 / values if kind == "affine-disparity" else values


def aligned_depth(
    x: Float[ndarray, "h w"], truth_m: Float[ndarray, "h w"], scored: Integer[ndarray, " n"], kind: str
) -> Float64[ndarray, "h w"]:
    """Return the aligned depth of a whole view, metres, by the fit on the flat indices ``scored``.

    It is NaN where the prediction ``x`` has no value, and everywhere if no scored pixel has one.
    """
    everywhere = np.where(has_value(x, kind), x, np.nan).astype(np.float64)
    at = scored[np.isfinite(everywhere.ravel()[scored])]
    if not len(at):
        return np.full(x.shape, np.nan)
    z = truth_m.ravel()[at].astype(np.float64)
    with np.errstate(over="ignore"):
        if kind == "scale":
            return everywhere * median_scale(everywhere.ravel()[at], median(z))
        everywhere = _within_range(everywhere, everywhere.ravel()[at])
        target = 1.0 / z if kind == "affine-disparity" else z
        return _fitted_depth(_least_squares(everywhere.ravel()[at], target), everywhere, z, kind)


def _within_range(x: Float64[ndarray, "*n"], fitted: Float64[ndarray, " v"]) -> Float64[ndarray, "*n"]:
    """Return x times the power of two that brings the values ``fitted`` to at most 1.

    It changes no digit of the fit; squares of values near the limits of float64 would overflow.
    """
    return np.ldexp(x, -int(np.frexp(np.abs(fitted).max())[1]))


def _fitted_depth(
    fit: tuple[float, float], x: Float64[ndarray, "*n"], z_m: Float64[ndarray, " v"], kind: str
) -> Float64[ndarray, "*n"]:
    """Return the depth of x, metres, by a fit (a, b) to the target of a kind on pixels of true depth ``z_m``."""
    line = fit[0] * x + fit[1]
    return 1.0 / np.maximum(line, 1.0 / z_m.max()) if kind == "affine-disparity" else line


def _least_squares(x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]) -> tuple[float, float]:
    """Return (a, b) that minimise the sum of (a x + b - y)^2, or (0, mean(y)) as the module says."""
    x_mean, y_mean = float(x.mean()), float(y.mean())
    x_off = x - x_mean
    if _vary(x, y) and (a := float(x_off @ (y - y_mean)) / float(x_off @ x_off)) > 0:
        return a, y_mean - a * x_mean
    return 0.0, y_mean


def _robust_fit(x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]) -> tuple[float, float]:
    """Return (a, b) of the robust variant, or (0, mean(y)) as the module says."""
    if not _vary(x, y):
        return 0.0, float(y.mean())
    x_median, y_median = median(x), median(y)
    a = float(np.abs(y - y_median).mean()) / float(np.abs(x - x_median).mean())
    return a, y_median - a * x_median


def _vary(x: Float64[ndarray, " n"], y: Float64[ndarray, " n"]) -> bool:
    """Return whether neither is constant; of a constant, rounding would leave a slope beside 0."""
    return bool(x.min() < x.max() and y.min() < y.max())
