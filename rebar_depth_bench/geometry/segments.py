"""Closest points of pairs of line segments."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

_PARALLEL = 1e-12
"""Largest squared sine of the angle between two segments that count as parallel."""


def closest_on_segments(
    start_a: Float64[ndarray, "n 3"],
    vector_a: Float64[ndarray, "n 3"],
    start_b: Float64[ndarray, "n 3"],
    vector_b: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the shares (0 to 1) along n segments a and n segments b at which they are closest, pair by pair.

    Segments may be parallel, where any of the closest pairs of points is returned, and may have no length. The
    method is that of C. Ericson, Real-Time Collision Detection (2005), section 5.1.9.
    """
    between = start_a - start_b
    aa, bb = _dot(vector_a, vector_a), _dot(vector_b, vector_b)
    ab, a_between, b_between = _dot(vector_a, vector_b), _dot(vector_a, between), _dot(vector_b, between)
    squared_sine = aa * bb - ab * ab
    # Of parallel lines, the start of a is taken first; the clamping below moves it where it must be.
    oblique = np.where(squared_sine > _PARALLEL * aa * bb, squared_sine, 0.0)
    share_a = np.clip(_ratio(ab * b_between - a_between * bb, oblique), 0.0, 1.0)
    share_b = _ratio(ab * share_a + b_between, bb)
    outside = (share_b < 0.0) | (share_b > 1.0) | (bb == 0.0)
    share_b = np.clip(share_b, 0.0, 1.0)
    share_a = np.where(outside, np.clip(_ratio(ab * share_b - a_between, aa), 0.0, 1.0), share_a)
    return share_a, share_b


def closest_points_m(
    start_a: Float64[ndarray, "n 3"],
    end_a: Float64[ndarray, "n 3"],
    start_b: Float64[ndarray, "n 3"],
    end_b: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    """Return the points of n segments a and b that are closest to each other, as ``closest_on_segments``."""
    vector_a, vector_b = end_a - start_a, end_b - start_b
    share_a, share_b = closest_on_segments(start_a, vector_a, start_b, vector_b)
    return start_a + share_a[:, None] * vector_a, start_b + share_b[:, None] * vector_b


def _dot(left: Float64[ndarray, "n 3"], right: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
    return np.asarray(np.einsum("ij,ij->i", left, right))


def _ratio(numerator: Float64[ndarray, " n"], denominator: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    """Return the ratio, 0 where the denominator is 0."""
    zeros = np.zeros_like(numerator)
    return np.asarray(np.divide(numerator, denominator, out=zeros, where=denominator > 0))
