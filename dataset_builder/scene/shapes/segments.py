"""Closest points of pairs of line segments."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

_PARALLEL = 1e-12
"""Largest squared sine of the angle between two segments that count as parallel."""


def closest_points_m(
    a_start_m: Float64[ndarray, "n 3"],
    a_end_m: Float64[ndarray, "n 3"],
    b_start_m: Float64[ndarray, "n 3"],
    b_end_m: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    """Return the points of n segments a and n segments b that are closest to each other, pair by pair.

    Segments may be parallel, where any of the closest pairs is returned, and may have no length. The method is
    that of C. Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    along_a, along_b, between = a_end_m - a_start_m, b_end_m - b_start_m, a_start_m - b_start_m
    a, e = _dot(along_a, along_a), _dot(along_b, along_b)
    b, c, f = _dot(along_a, along_b), _dot(along_a, between), _dot(along_b, between)
    squared_sine = a * e - b * b
    # Of parallel lines, the start of a is taken first; the clamping below moves it where it must be.
    s = np.clip(_ratio(b * f - c * e, np.where(squared_sine > _PARALLEL * a * e, squared_sine, 0.0)), 0.0, 1.0)
    t = _ratio(b * s + f, e)
    outside = (t < 0.0) | (t > 1.0) | (e == 0.0)
    t = np.clip(t, 0.0, 1.0)
    s = np.where(outside, np.clip(_ratio(b * t - c, a), 0.0, 1.0), s)
    return a_start_m + s[:, None] * along_a, b_start_m + t[:, None] * along_b


def _dot(left: Float64[ndarray, "n 3"], right: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
    return np.asarray(np.einsum("ij,ij->i", left, right))


def _ratio(numerator: Float64[ndarray, " n"], denominator: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    """Return the ratio, 0 where the denominator is 0."""
    zeros = np.zeros_like(numerator)
    return np.asarray(np.divide(numerator, denominator, out=zeros, where=denominator > 0))
