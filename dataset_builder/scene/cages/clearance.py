"""Clear distances between the bars of a cage, exact for capsules along the segments of their axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.geometry.segments import closest_points_m

NEAR_M = 0.05
"""Distance up to which bars are compared, metres; bars that are farther apart have an infinite clearance."""


class Clearances:
    """Axes of bars, of which one can be replaced at a time, and the least clearance of an axis to the others.

    The clearance of two bars is the least distance of their axes less both radii, metres; it is negative if they
    penetrate each other.
    """

    def __init__(self, lines_m: Sequence[Float64[ndarray, "n 3"]], radii_m: Sequence[float]) -> None:
        self._lines_m, self._radii_m = list(lines_m), np.array(radii_m, dtype=np.float64)
        self._low_m = np.array([line_m.min(axis=0) for line_m in lines_m])
        self._high_m = np.array([line_m.max(axis=0) for line_m in lines_m])

    def replace(self, index: int, line_m: Float64[ndarray, "n 3"]) -> None:
        """Set the axis of a bar."""
        self._lines_m[index] = line_m
        self._low_m[index], self._high_m[index] = line_m.min(axis=0), line_m.max(axis=0)

    def append(self, line_m: Float64[ndarray, "n 3"], radius_m: float) -> None:
        """Add a bar."""
        self._lines_m.append(line_m)
        self._radii_m = np.append(self._radii_m, radius_m)
        self._low_m = np.vstack([self._low_m, line_m.min(axis=0)])
        self._high_m = np.vstack([self._high_m, line_m.max(axis=0)])

    def neighbours(
        self, line_m: Float64[ndarray, "n 3"], radius_m: float, without: int | None = None, margin_m: float = 0.0
    ) -> Neighbours:
        """Return the bars near a bar along ``line_m``, or along lines within ``margin_m``, ``without`` one."""
        reach_m = NEAR_M + radius_m + margin_m
        low, high = line_m.min(axis=0) - reach_m, line_m.max(axis=0) + reach_m
        radii_m = self._radii_m[:, None]
        is_near = ((self._low_m - radii_m <= high) & (self._high_m + radii_m >= low)).all(axis=1)
        if without is not None:
            is_near[without] = False
        near = np.flatnonzero(is_near).tolist()
        if not near:
            return Neighbours(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        start_m = np.concatenate([self._lines_m[index][:-1] for index in near])
        end_m = np.concatenate([self._lines_m[index][1:] for index in near])
        radii_m = np.repeat(self._radii_m[near], [len(self._lines_m[index]) - 1 for index in near])
        lower_m, upper_m = np.minimum(start_m, end_m), np.maximum(start_m, end_m)
        is_near = ((lower_m - radii_m[:, None] <= high) & (upper_m + radii_m[:, None] >= low)).all(axis=1)
        return Neighbours(start_m[is_near], end_m[is_near], radii_m[is_near])

    def least_m(self, line_m: Float64[ndarray, "n 3"], radius_m: float, without: int | None = None) -> float:
        """Return the least clearance between a bar along ``line_m`` and the others, ``without`` one of them."""
        return self.neighbours(line_m, radius_m, without).least_m(line_m, radius_m)

    def are_all(self, least_m: float) -> bool:
        """Return True if the clearance of any two bars is at least ``least_m``."""
        return all(
            self.least_m(line_m, float(self._radii_m[i]), i) >= least_m for i, line_m in enumerate(self._lines_m)
        )


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Segments of the axes of bars, and their radii, to which bars in one place are compared."""

    start_m: Float64[ndarray, "k 3"]
    end_m: Float64[ndarray, "k 3"]
    radii_m: Float64[ndarray, " k"]

    def least_m(self, line_m: Float64[ndarray, "n 3"], radius_m: float) -> float:
        """Return the least clearance of a bar; infinity if all are farther than ``NEAR_M``."""
        i, j = _near_segments(line_m[:-1], line_m[1:], self.start_m, self.end_m, NEAR_M + radius_m + self.radii_m)
        if not len(i):
            return np.inf
        on_a, on_b = closest_points_m(line_m[:-1][i], line_m[1:][i], self.start_m[j], self.end_m[j])
        return float((np.linalg.norm(on_a - on_b, axis=1) - self.radii_m[j]).min()) - radius_m


def _near_segments(
    a_start_m: Float64[ndarray, "n 3"],
    a_end_m: Float64[ndarray, "n 3"],
    b_start_m: Float64[ndarray, "k 3"],
    b_end_m: Float64[ndarray, "k 3"],
    reach_m: Float64[ndarray, " k"],
) -> tuple[Int64[ndarray, " m"], Int64[ndarray, " m"]]:
    """Return the pairs of segments whose boxes are at most ``reach_m`` apart along each axis."""
    a_low, a_high = np.minimum(a_start_m, a_end_m), np.maximum(a_start_m, a_end_m)
    b_low = np.minimum(b_start_m, b_end_m) - reach_m[:, None]
    b_high = np.maximum(b_start_m, b_end_m) + reach_m[:, None]
    is_near = np.ones((len(a_low), len(b_low)), bool)
    for axis in range(3):
        is_near &= (a_low[:, None, axis] <= b_high[None, :, axis]) & (
            a_high[:, None, axis] >= b_low[None, :, axis]
        )
    i, j = np.nonzero(is_near)
    return i, j
