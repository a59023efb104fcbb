"""Protocol ``rebar-1``: which pixels of a view count, and what ranks.

Changing any rule or number here changes the protocol's name.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, UInt32
from numpy import ndarray

PROTOCOL = "rebar-1"

WITHIN_MM = (3, 5, 10, 20)
"""Tolerances, millimetres, of the share of scored pixels within a given absolute error."""

DELTA1_RATIO = 1.25
"""``delta1`` counts pixels whose ratio max(p/z, z/p) is strictly below this."""

MIN_RANKED_COVERAGE = 0.95
"""A config whose mean coverage is lower is shown and not ranked."""


def interior(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Erode a steel mask by one pixel: a pixel stays if all nine of its 3 x 3 neighbourhood are steel.

    Pixels outside the frame count as steel-free, so the frame's border never stays.
    """
    rows = np.zeros_like(mask)
    rows[1:-1] = mask[:-2] & mask[1:-1] & mask[2:]
    kept = np.zeros_like(mask)
    kept[:, 1:-1] = rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]
    return kept


def scored_pixels(mask: Bool[ndarray, "h w"], depth_m: Float32[ndarray, "h w"]) -> UInt32[ndarray, " n"]:
    """Return the flat, ascending indices of the pixels a view is scored on: interior steel with depth > 0.

    None at all means that the view is out of the protocol.
    """
    return np.flatnonzero(interior(mask) & (depth_m > 0)).astype(np.uint32)
