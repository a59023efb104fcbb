"""Protocol ``rebar-2``: scored pixels of a view and constants of its metrics.

A change of any rule or number in this module requires a new protocol name.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32, UInt16, UInt32
from numpy import ndarray

PROTOCOL = "rebar-2"
"""Name of the scoring protocol."""

RELATIVE_PROTOCOL = "rebar-relative-1"
"""Name of the protocol of predictions that are not metric, see ``relative``."""

WITHIN_MM = (3, 5, 10, 20)
"""Tolerances in millimetres for the share of scored pixels within a given absolute error."""

DELTA1_RATIO = 1.25
"""``delta1`` counts pixels whose ratio max(p/z, z/p) is strictly below this."""

MIN_COMPARABLE_COVERAGE = 0.95
"""Smallest mean coverage of a config whose errors on valid predictions are compared with those of others.

The ranking needs no such limit, because ``rank_error`` counts every scored pixel.
"""


def interior(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return a steel mask eroded by one pixel: a pixel remains if its 3 x 3 neighbourhood is all steel.

    Pixels outside the image count as not steel, so the border pixels of the image never remain.
    """
    rows = np.zeros_like(mask)
    rows[1:-1] = mask[:-2] & mask[1:-1] & mask[2:]
    eroded = np.zeros_like(mask)
    eroded[:, 1:-1] = rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:]
    return eroded


def single_bar_pixels(bars: UInt16[ndarray, "h w"], pixels: UInt32[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return which of the scored pixels belong to one bar with their whole 3 x 3 neighbourhood.

    ``bars`` holds bar ids and ``pixels`` flat indices, which are never at the border of the image. Extended
    measures call these pixels the single-bar interior; all other metrics use all scored pixels. These erode the
    union of all bars: where bars lie side by side in the image, a scored pixel can have another bar beside it, at
    another depth, and a prediction that is exact but shifted by one pixel has a large error there.
    """
    width, flat = bars.shape[1], bars.ravel()
    centre = pixels.astype(np.intp)
    own = flat[centre]
    same = own > 0
    for offset in (-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1):
        same &= flat[centre + offset] == own
    return same


def scored_pixels(mask: Bool[ndarray, "h w"] | None, depth_m: Float32[ndarray, "h w"]) -> UInt32[ndarray, " n"]:
    """Return the flat, ascending indices of the scored pixels of a view: eroded steel mask and depth > 0.

    Without a mask, all pixels with depth are scored. A view without scored pixels is not part of the protocol.
    """
    scored = depth_m > 0 if mask is None else interior(mask) & (depth_m > 0)
    return np.flatnonzero(scored).astype(np.uint32)
