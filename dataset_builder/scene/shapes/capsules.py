"""Bars as capsules, one for each straight piece of an axis: distances from points and other bars. Metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.geometry.segments import closest_points_m

NEAR_M = 0.01
"""Distance up to which bars are compared; bars that are farther apart have an infinite clearance."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Straight pieces of bars as capsules: all points within ``radius_m`` of the segment from ``a_m`` to ``b_m``.

    ``bar`` is the index of the bar of each piece.
    """

    a_m: Float64[ndarray, "n 3"]
    b_m: Float64[ndarray, "n 3"]
    radius_m: Float64[ndarray, " n"]
    bar: Int64[ndarray, " n"]

    @classmethod
    def of_lines(
        cls, lines_m: Sequence[Float64[ndarray, "n 3"]], radii_m: Sequence[float] | Float64[ndarray, " n"]
    ) -> Capsules:
        """Return the capsules of bars along ``lines_m``, in order."""
        pieces = np.array([len(line) - 1 for line in lines_m], dtype=np.int64)
        return cls(
            np.concatenate([np.zeros((0, 3)), *(line[:-1] for line in lines_m)]),
            np.concatenate([np.zeros((0, 3)), *(line[1:] for line in lines_m)]),
            np.repeat(radii_m, pieces),
            np.repeat(np.arange(len(lines_m)), pieces),
        )

    def select(self, which: Bool[ndarray, " n"]) -> Capsules:
        """Return the pieces selected by the mask ``which``."""
        return Capsules(self.a_m[which], self.b_m[which], self.radius_m[which], self.bar[which])

    def overlapping(self, low_m: Float64[ndarray, " 3"], high_m: Float64[ndarray, " 3"]) -> Bool[ndarray, " n"]:
        """Return the mask of pieces whose bounding box intersects the box from ``low_m`` to ``high_m``."""
        reach = self.radius_m[:, None]
        below = (np.minimum(self.a_m, self.b_m) - reach <= high_m).all(axis=1)
        above = (np.maximum(self.a_m, self.b_m) + reach >= low_m).all(axis=1)
        return np.asarray(below & above)

    def clearance_m(
        self, points_m: Float64[ndarray, "k 3"], margin_m: float = 0.0, without: int | None = None
    ) -> float:
        """Return the smallest signed distance of the points to the capsules near them, ``without`` one of these.

        Those are near whose bounding box is at most ``margin_m`` from that of the points; infinity for none.
        """
        is_near = self.overlapping(points_m.min(axis=0) - margin_m, points_m.max(axis=0) + margin_m)
        if without is not None:
            is_near[without] = False
        if not is_near.any():
            return np.inf
        near = self.select(is_near)
        along = near.b_m - near.a_m
        from_a = points_m[:, None] - near.a_m
        share = np.clip(np.einsum("kni,ni->kn", from_a, along) / (along**2).sum(axis=1), 0.0, 1.0)
        off = np.linalg.norm(from_a - share[..., None] * along, axis=2) - near.radius_m
        return float(off.min())

    def bar_clearance_m(self, line_m: Float64[ndarray, "n 3"], radius_m: float) -> float:
        """Return the least clearance of a bar along ``line_m``; infinity if all are farther than ``NEAR_M``."""
        start_m, end_m = line_m[:-1], line_m[1:]
        i, j = self._near_pairs(start_m, end_m, NEAR_M + radius_m + self.radius_m)
        if not len(i):
            return np.inf
        on_line, on_other = closest_points_m(start_m[i], end_m[i], self.a_m[j], self.b_m[j])
        return float((np.linalg.norm(on_line - on_other, axis=1) - self.radius_m[j]).min()) - radius_m

    def _near_pairs(
        self, start_m: Float64[ndarray, "k 3"], end_m: Float64[ndarray, "k 3"], reach_m: Float64[ndarray, " n"]
    ) -> tuple[Int64[ndarray, " m"], Int64[ndarray, " m"]]:
        """Return the pairs of segments and pieces whose boxes are at most ``reach_m`` apart along each axis."""
        low_m, high_m = np.minimum(start_m, end_m), np.maximum(start_m, end_m)
        lower_m = np.minimum(self.a_m, self.b_m) - reach_m[:, None]
        upper_m = np.maximum(self.a_m, self.b_m) + reach_m[:, None]
        is_near = np.ones((len(low_m), len(lower_m)), bool)
        for axis in range(3):
            is_near &= (low_m[:, None, axis] <= upper_m[None, :, axis]) & (
                high_m[:, None, axis] >= lower_m[None, :, axis]
            )
        i, j = np.nonzero(is_near)
        return i, j


_Bars = int | slice | None
"""Index of a bar, or of several."""


class Clearances:
    """Axes of bars, of which one can be replaced at a time, and the least clearance of an axis to the others.

    The clearance of two bars is the least distance of their axes less both radii; it is negative if they penetrate
    each other.
    """

    def __init__(self, lines_m: Sequence[Float64[ndarray, "n 3"]], radii_m: Sequence[float]) -> None:
        self._lines_m, self._radii_m = list(lines_m), np.array(radii_m, dtype=np.float64)
        self._low_m = np.array([line_m.min(axis=0) for line_m in lines_m])
        self._high_m = np.array([line_m.max(axis=0) for line_m in lines_m])

    def replace(self, index: int, line_m: Float64[ndarray, "n 3"]) -> None:
        """Set the axis of a bar."""
        self._lines_m[index] = line_m
        self._low_m[index], self._high_m[index] = line_m.min(axis=0), line_m.max(axis=0)

    def neighbours(
        self, line_m: Float64[ndarray, "n 3"], radius_m: float, without: _Bars = None, margin_m: float = 0.0
    ) -> Capsules:
        """Return the bars near a bar along ``line_m``, or along lines within ``margin_m``, ``without`` some."""
        reach_m = NEAR_M + radius_m + margin_m
        low, high = line_m.min(axis=0) - reach_m, line_m.max(axis=0) + reach_m
        radii_m = self._radii_m[:, None]
        is_near = ((self._low_m - radii_m <= high) & (self._high_m + radii_m >= low)).all(axis=1)
        if without is not None:
            is_near[without] = False
        near = np.flatnonzero(is_near)
        pieces = Capsules.of_lines([self._lines_m[index] for index in near], self._radii_m[near])
        return pieces.select(pieces.overlapping(low, high))

    def least_m(self, line_m: Float64[ndarray, "n 3"], radius_m: float, without: _Bars = None) -> float:
        """Return the least clearance between a bar along ``line_m`` and the others, ``without`` some of them."""
        return self.neighbours(line_m, radius_m, without).bar_clearance_m(line_m, radius_m)

    def are_all(self, least_m: float) -> bool:
        """Return True if the clearance of any two bars is at least ``least_m``."""
        return all(
            self.least_m(line_m, float(self._radii_m[i]), slice(i + 1)) >= least_m
            for i, line_m in enumerate(self._lines_m)
        )
