"""Positions of points relative to a polyline: nearest segment, distance from its line, distance beyond an end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

_CAP_REACH = 0.3
"""Distance from the plane of an end within which a point may belong to its cap, in radii."""

_CAP_RADIUS = 0.8
"""Largest distance from the axis of points that are counted to the cap, in radii."""

_MAX_SAMPLES = 200_000
"""Largest number of pieces, beside one for each segment."""


@dataclass(frozen=True, eq=False)
class Feet:
    """Points relative to a polyline, metres.

    ``distance_m`` is the distance from the (infinite) line of the nearest segment, so that it is the radius also
    at the mitre of a corner. ``beyond_m`` is the distance beyond the plane of each end, negative before it, and
    minus infinity for points near other segments and for closed polylines.
    """

    distance_m: Float64[ndarray, " n"]
    beyond_m: Float64[ndarray, "n 2"]

    def on_cap(self, radius_m: float) -> Bool[ndarray, " n"]:
        """Return which points are on the flat ends of a bar of this radius, inside its circumference."""
        at_end = np.abs(self.beyond_m).min(axis=1) < _CAP_REACH * radius_m
        return np.asarray(at_end & (self.distance_m < _CAP_RADIUS * radius_m))

    def reach_ends(self, radius_m: float) -> bool:
        """Return whether the points extend to both ends and not farther; True for a closed polyline."""
        farthest_m = self.beyond_m.max(axis=0)
        return bool((np.isneginf(farthest_m) | (np.abs(farthest_m) < _CAP_REACH * radius_m)).all())


def feet_on(line_m: Float64[ndarray, "k 3"], points_m: Float64[ndarray, "n 3"]) -> Feet:
    """Return the positions of points relative to a polyline without repeated points."""
    from scipy.spatial import cKDTree

    start_m, along_m = line_m[:-1], np.diff(line_m, axis=0)
    length_m = np.linalg.norm(along_m, axis=1)
    direction = along_m / length_m[:, None]
    count = len(length_m)
    is_closed = bool((line_m[0] == line_m[-1]).all())
    # The middles of short pieces find the nearest segment up to its neighbours.
    step_m = float(max(length_m.mean() / 2, length_m.sum() / _MAX_SAMPLES))
    pieces = np.ceil(length_m / step_m).astype(np.int64)
    segment = np.repeat(np.arange(count), pieces)
    share = (np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / pieces[segment]
    tree = cKDTree(start_m[segment] + share[:, None] * along_m[segment])
    nearest = segment[tree.query(points_m)[1]]
    best = np.full(len(points_m), np.inf)
    distance_m, along_best_m = np.zeros(len(points_m)), np.zeros(len(points_m))
    own: Int64[ndarray, " n"] = nearest.copy()
    for shift in (0, -1, 1):
        tried = (nearest + shift) % count if is_closed else np.clip(nearest + shift, 0, count - 1)
        offset_m = points_m - start_m[tried]
        foot_m = np.einsum("ni,ni->n", offset_m, direction[tried])
        across_m = np.linalg.norm(offset_m - foot_m[:, None] * direction[tried], axis=1)
        outside_m = np.maximum(np.maximum(-foot_m, foot_m - length_m[tried]), 0.0)
        gap_m = np.hypot(across_m, outside_m)
        better = gap_m < best
        best[better], own[better] = gap_m[better], tried[better]
        distance_m[better], along_best_m[better] = across_m[better], foot_m[better]
    beyond_m = np.full((len(points_m), 2), -np.inf)
    if not is_closed:
        beyond_m[own == 0, 0] = -along_best_m[own == 0]
        last = own == count - 1
        beyond_m[last, 1] = along_best_m[last] - length_m[-1]
    return Feet(distance_m, beyond_m)


def simplified_m(line_m: Float64[ndarray, "n 3"], slack_m: float) -> Float64[ndarray, "k 3"]:
    """Return the polyline without points that are within ``slack_m`` of it (Douglas and Peucker 1973)."""
    kept = np.zeros(len(line_m), dtype=bool)
    kept[[0, -1]] = True
    pending = [(0, len(line_m) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        inner_m = line_m[first + 1 : last] - line_m[first]
        chord_m = line_m[last] - line_m[first]
        squared = float(chord_m @ chord_m)
        share = np.clip(inner_m @ chord_m / squared, 0.0, 1.0) if squared > 0 else np.zeros(len(inner_m))
        off_m = np.linalg.norm(inner_m - share[:, None] * chord_m, axis=1)
        farthest = int(off_m.argmax())
        if off_m[farthest] > slack_m:
            middle = first + 1 + farthest
            kept[middle] = True
            pending += [(first, middle), (middle, last)]
    return np.asarray(line_m[kept])
