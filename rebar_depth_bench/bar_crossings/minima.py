"""Local minima of the distance between axes of bars.

The distance of two polylines is convex on each pair of segments. A point is a local minimum exactly if it is the
minimum of every pair of segments that it belongs to: of one pair in the interior of both segments, of two or four
at a vertex.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import ROUNDING_M, AxisSegments
from rebar_depth_bench.geometry.segments import closest_on_segments


@dataclass(frozen=True, eq=False)
class Minima:
    """Local minima of the distance of axes a and b, interior to both; a point may occur more than once.

    ``bar_a`` and ``bar_b`` are positions of bars, ``along_a_m`` and ``along_b_m`` lengths along their axes,
    ``point_a_m`` and ``point_b_m`` the closest points and ``tangent_a`` and ``tangent_b`` unit tangents there: at
    a vertex, the bisector of its edges. ``least_angle_deg`` is the least angle between edges of a and b that meet
    at the points.
    """

    bar_a: Int64[ndarray, " m"]
    bar_b: Int64[ndarray, " m"]
    along_a_m: Float64[ndarray, " m"]
    along_b_m: Float64[ndarray, " m"]
    point_a_m: Float64[ndarray, "m 3"]
    point_b_m: Float64[ndarray, "m 3"]
    tangent_a: Float64[ndarray, "m 3"]
    tangent_b: Float64[ndarray, "m 3"]
    least_angle_deg: Float64[ndarray, " m"]

    def of(self, chosen: ndarray) -> Minima:
        """Return the chosen minima, by a mask or by positions."""
        return Minima(*(getattr(self, field.name)[chosen] for field in fields(self)))


def local_minima(axes: AxisSegments, max_gap_m: float) -> Minima:
    """Return the local minima with at most ``max_gap_m`` between the surfaces; bar a is not after bar b."""
    pairs = axes.near_pairs(max_gap_m)
    share, distance_m = _closest(axes, pairs)
    radii_m = axes.diameter_m[axes.bar[pairs]].sum(axis=1) / 2
    near = distance_m - radii_m <= max_gap_m
    pairs, share, distance_m = pairs[near], share[near], distance_m[near]
    others = np.stack([_segment_at_vertex(axes, pairs[:, side], share[:, side]) for side in (0, 1)], axis=1)
    chosen = _are_interior(axes, pairs, share) & (pairs[:, 0] != others[:, 1])
    for a, b in ((1, 0), (0, 1), (1, 1)):
        neighbours = np.column_stack([(pairs, others)[a][:, 0], (pairs, others)[b][:, 1]])
        exists = (neighbours >= 0).all(axis=1)
        _, neighbour_m = _closest(axes, neighbours[exists])
        chosen[exists] &= neighbour_m >= distance_m[exists] - ROUNDING_M
    return _minima(axes, pairs[chosen], share[chosen], others[chosen])


def _closest(
    axes: AxisSegments, pairs: Int64[ndarray, "p 2"]
) -> tuple[Float64[ndarray, "p 2"], Float64[ndarray, " p"]]:
    """Return the shares along both segments of each pair at their closest points, and their distance."""
    start_m, vector_m = axes.start_m[pairs], axes.vector_m[pairs]
    share = np.column_stack(closest_on_segments(start_m[:, 0], vector_m[:, 0], start_m[:, 1], vector_m[:, 1]))
    points_m = start_m + share[..., None] * vector_m
    return share, np.asarray(np.linalg.norm(points_m[:, 1] - points_m[:, 0], axis=1))


def _segment_at_vertex(
    axes: AxisSegments, segment: Int64[ndarray, " p"], share: Float64[ndarray, " p"]
) -> Int64[ndarray, " p"]:
    """Return the other segment that a point belongs to; -1 for points that are no vertex, and for ends."""
    length_m = axes.lengths_m(segment)
    at_start, at_end = share * length_m <= ROUNDING_M, (1 - share) * length_m <= ROUNDING_M
    return np.where(at_start, axes.before[segment], np.where(at_end, axes.after[segment], -1))


def _are_interior(
    axes: AxisSegments, pairs: Int64[ndarray, "p 2"], share: Float64[ndarray, "p 2"]
) -> Bool[ndarray, " p"]:
    """Return which points are interior to both axes; all points of a closed axis are."""
    inside = np.ones(len(pairs), dtype=bool)
    for side in (0, 1):
        segment = pairs[:, side]
        bar = axes.bar[segment]
        along_m = axes.along_m[segment] + share[:, side] * axes.lengths_m(segment)
        inside &= axes.closed[bar] | ((along_m > ROUNDING_M) & (along_m < axes.length_m[bar] - ROUNDING_M))
    return inside


def _minima(
    axes: AxisSegments, pairs: Int64[ndarray, "m 2"], share: Float64[ndarray, "m 2"], others: Int64[ndarray, "m 2"]
) -> Minima:
    """Return the minima at ``share`` along pairs of segments; ``others`` are the further segments at vertices."""
    length_m = np.stack([axes.lengths_m(pairs[:, side]) for side in (0, 1)], axis=1)
    along_m = axes.along_m[pairs] + share * length_m
    points_m = axes.start_m[pairs] + share[..., None] * axes.vector_m[pairs]
    edges = np.stack([axes.vector_m[pairs], axes.vector_m[np.where(others < 0, pairs, others)]], axis=2)
    edges /= np.linalg.norm(edges, axis=-1, keepdims=True)
    tangents = edges.sum(axis=2)
    lengths = np.linalg.norm(tangents, axis=-1, keepdims=True)
    # A vertex at which the axis turns back has no bisector.
    tangents = np.where(lengths > 1e-6, tangents / np.where(lengths > 1e-6, lengths, 1.0), edges[:, :, 0])
    angles_deg = np.stack([angle_deg(edges[:, 0, a], edges[:, 1, b]) for a in (0, 1) for b in (0, 1)], axis=-1)
    return Minima(
        bar_a=axes.bar[pairs[:, 0]],
        bar_b=axes.bar[pairs[:, 1]],
        along_a_m=along_m[:, 0],
        along_b_m=along_m[:, 1],
        point_a_m=points_m[:, 0],
        point_b_m=points_m[:, 1],
        tangent_a=tangents[:, 0],
        tangent_b=tangents[:, 1],
        least_angle_deg=angles_deg.min(axis=-1, initial=90.0),
    )


def angle_deg(a: Float64[ndarray, "n 3"], b: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
    """Return the angle between undirected lines along unit vectors, 0 to 90 degrees."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    cosine = np.abs(np.einsum("ni,ni->n", a, b))
    return np.asarray(np.rad2deg(np.arctan2(sine, cosine)))
