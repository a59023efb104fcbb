"""Errors by which a prediction is compared with its correction: pure functions of a view's scored pixels.

The error of a pixel is that of the rank error, |p - z| / max(p, z), between 0 and 1. Pixels without a valid
prediction do not count: a correction must not be judged by the places where a method has holes.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import is_valid_prediction

Values = Float64[ndarray, " n"]


def pixel_errors(p: Values, z_m: Values, scale: float | None = None) -> Values:
    """Return the errors of the valid pixels of ``scale * p``, by default after the scale median(z) / median(p)."""
    valid = is_valid_prediction(p)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        scaled, z_m = p[valid] * (median_ratio(p, z_m) if scale is None else scale), z_m[valid]
        return np.asarray(np.abs(scaled - z_m) / np.maximum(scaled, z_m))


def mean_error(p: Values, z_m: Values, scale: float | None = None) -> float:
    """Return the mean of ``pixel_errors``, NaN without any; no pixel counts for more than 1."""
    errors = pixel_errors(p, z_m, scale)
    return float(np.mean(errors)) if errors.size else math.nan


def median_ratio(p: Values, z_m: Values) -> float:
    """Return median(z) / median(p) over the valid predictions, NaN without any."""
    valid = is_valid_prediction(p)
    with np.errstate(over="ignore", under="ignore", divide="ignore"):
        return float(np.median(z_m[valid]) / np.median(p[valid])) if valid.any() else math.nan


def line_error(p: Values, z_m: Values, of_depth: Callable[[Values], Values]) -> float:
    """Return the median error after a rising line from p to ``of_depth(z)`` has been fitted.

    ``of_depth`` is a monotonic function that is its own inverse: the identity, or the reciprocal for predictions
    of disparity. NaN if no line rises.
    """
    valid = is_valid_prediction(p)
    if not valid.any():
        return math.nan
    p, z_m = p[valid], z_m[valid]
    slope, intercept = resistant_line(p, of_depth(z_m))
    if not slope > 0:
        return math.nan
    fitted = slope * p + intercept
    return _median(pixel_errors(of_depth(np.where(fitted > 0, fitted, np.nan)), z_m, 1.0))


def resistant_line(x: Values, y: Values) -> tuple[float, float]:
    """Return slope and intercept of Tukey's resistant line, which outliers do not bend.

    The slope is that between the medians of the lowest and the highest third of x, 0 if these are equal; the
    intercept is the median of what remains (Tukey, "Exploratory Data Analysis", 1977, chapter 5).
    """
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)
    low, high = order[:third], order[-third:]
    run = float(np.median(x[high]) - np.median(x[low]))
    slope = float(np.median(y[high]) - np.median(y[low])) / run if run > 0 else 0.0
    return slope, float(np.median(y - slope * x))


def plane_error(z_m: Values) -> float:
    """Return the median error of a plane at the median depth: that of a line fitted to nothing but noise."""
    return _median(pixel_errors(np.ones_like(z_m), z_m))


def _median(errors: Values) -> float:
    return float(np.median(errors)) if errors.size else math.nan


def valid_share(p: Values) -> float:
    """Return the share of valid predictions."""
    return float(is_valid_prediction(p).mean())
