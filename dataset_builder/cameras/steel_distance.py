"""Distance of points from the nearest steel, computed from the axes and diameters of the bars, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.shapes.capsules import Capsules
from rebar_depth_bench.data.bars import Bar, with_axis

_CHUNK = 32
_STEP_TOLERANCE_M = 1e-7
_MAX_STEPS = 200


@dataclass(frozen=True, eq=False)
class Cylinders:
    """Solid cylinders with flat ends: one for each segment of the bars' centrelines.

    Where two segments meet in a bend of small steps, their union is the bar to a thousandth of its radius.
    """

    start_m: Float64[ndarray, "s 3"]
    direction: Float64[ndarray, "s 3"]
    length_m: Float64[ndarray, " s"]
    radius_m: Float64[ndarray, " s"]

    @classmethod
    def from_bars(cls, bars: Sequence[Bar]) -> Cylinders:
        """Return the cylinders of the bars that have an axis; raise ``ValueError`` if there is no segment."""
        measured = with_axis(bars)
        lines_m = [np.array(bar.axis_m, dtype=np.float64) for bar in measured]
        pieces = Capsules.of_lines(lines_m, [bar.diameter_m / 2 for bar in measured])
        along_m = pieces.b_m - pieces.a_m
        length_m = np.linalg.norm(along_m, axis=1)
        used = length_m > 0
        if not used.any():
            raise ValueError("there are no bars to measure the distance from")
        direction = along_m[used] / length_m[used, None]
        return cls(pieces.a_m[used], direction, length_m[used], pieces.radius_m[used])

    def distance_m(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return the Euclidean distance of each point from the nearest cylinder, 0 inside of one."""
        chunks = (points_m[first : first + _CHUNK] for first in range(0, len(points_m), _CHUNK))
        return np.concatenate([np.zeros(0), *map(self._chunk_distance_m, chunks)])

    def _chunk_distance_m(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return the distances of a few points; matrix products compute squares and products with all segments."""
        along_m = points_m @ self.direction.T - (self.start_m * self.direction).sum(axis=1)
        square = (points_m * points_m).sum(axis=1, keepdims=True) - 2 * points_m @ self.start_m.T
        square += (self.start_m * self.start_m).sum(axis=1)
        beyond_m = np.maximum(np.maximum(-along_m, along_m - self.length_m), 0.0)
        across_m = np.sqrt(np.maximum(square - along_m * along_m, 0.0))
        outside_m = np.maximum(across_m - self.radius_m, 0.0)
        return np.asarray(np.sqrt((beyond_m * beyond_m + outside_m * outside_m).min(axis=1)))

    def reach_m(self, point_m: Float64[ndarray, 3]) -> float:
        """Return an upper bound of the distance of steel from a point."""
        ends_m = np.concatenate([self.start_m, self.start_m + self.length_m[:, None] * self.direction])
        return float(np.linalg.norm(ends_m - point_m, axis=1).max() + self.radius_m.max())


def radii_at_steel_distance_m(
    target_m: Float64[ndarray, 3],
    directions: Float64[ndarray, "n 3"],
    distance_m: Float64[ndarray, " n"],
    bars: Sequence[Bar],
) -> Float64[ndarray, " n"]:
    """Return how far from the target each view lies whose nearest steel is ``distance_m`` away.

    The views lie on the rays from ``target_m`` along the unit ``directions``. Of several such points of a ray, the
    outermost is returned. The search starts beyond it and moves each point inward by its excess distance. Such a
    step cannot pass the solution, because the distance from steel changes by at most the length of the step.

    Raises ``ValueError`` if there are no bars, or if the target is farther from them than a ``distance_m``: some
    rays would then have no solution.
    """
    cylinders = Cylinders.from_bars(bars)
    if cylinders.distance_m(target_m[None])[0] > distance_m.min():
        raise ValueError(f"no steel is within {distance_m.min():g} m of the point that the cameras aim at")
    radii_m = distance_m + cylinders.reach_m(target_m)
    for _ in range(_MAX_STEPS):
        excess_m = cylinders.distance_m(target_m + radii_m[:, None] * directions) - distance_m
        radii_m = radii_m - excess_m
        if excess_m.max() < _STEP_TOLERANCE_M:
            break
    return radii_m
