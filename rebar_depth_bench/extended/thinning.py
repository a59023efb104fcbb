"""Fewer pixels, evenly, where a measure does not need all of them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64
from numpy import ndarray


def thinned(position: Int64[ndarray, " n"], most: int) -> Int64[ndarray, " m"]:
    """Return at most ``most`` of the positions, evenly strided: of n, the m at floor(i n / m)."""
    count = min(len(position), most)
    return np.asarray(position[np.arange(count) * len(position) // max(count, 1)])
