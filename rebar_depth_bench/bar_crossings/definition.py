"""Crossings of the bars of a scene: where a robot ties, as ``rebar-crossings-1`` defines it.

A crossing is a local minimum of the distance between the axes of two bars, or within one axis at points that are
``MIN_SEPARATION_DIAMETERS`` or more apart along it. It is interior to both axes, whose tangents there are
``MIN_ANGLE_DEG`` or more apart, with a nominal gap between the surfaces of at most ``MAX_GAP_M``; cylinders that
intersect have a negative gap. At a vertex of an axis, the tangent is the bisector of its two edges, and the
edges keep the angle as well. Minima of one pair of bars whose tie points are linked by steps below the larger
diameter are one crossing, at the middle one of them along the first bar (of an even number, the first of the two
in the middle). Frame: world, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import ROUNDING_M, AxisSegments, Rows
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.geometry.segments import closest_on_segments

CROSSINGS_PROTOCOL = "rebar-crossings-1"
"""Version of the definition of crossings, which the manifest states; any change changes it."""

MAX_GAP_M = 0.005
"""Largest nominal gap between the surfaces of bars that cross, metres."""

MIN_ANGLE_DEG = 20.0
"""Smallest angle between the tangents of bars that cross, degrees."""

MIN_SEPARATION_DIAMETERS = 6.0
"""Least distance along the axis of a bar that crosses itself, diameters."""


_DECIMALS = 12
"""Decimals of all numbers of crossings, so that processors with other rounding errors write the same bytes."""


def crossing_parameters() -> dict[str, Any]:
    """Return the parameters of the definition, as the manifest of a dataset folder states them."""
    return {
        "protocol": CROSSINGS_PROTOCOL,
        "max_gap_m": MAX_GAP_M,
        "min_angle_deg": MIN_ANGLE_DEG,
        "min_separation_diameters": MIN_SEPARATION_DIAMETERS,
    }


@dataclass(frozen=True, eq=False)
class TiePoints(Rows):
    """Tie points of pairs of axes: see ``tie_points``. ``normal`` is a unit vector from a to b."""

    tie_point_m: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]
    gap_m: Float64[ndarray, " n"]
    angle_deg: Float64[ndarray, " n"]


def tie_points(
    point_a_m: Float64[ndarray, "n 3"],
    point_b_m: Float64[ndarray, "n 3"],
    tangent_a: Float64[ndarray, "n 3"],
    tangent_b: Float64[ndarray, "n 3"],
    radius_m: Float64[ndarray, "n 2"],
    towards: Float64[ndarray, "n 3"] | None = None,
) -> TiePoints:
    """Return the tie points of axes with closest points q_a, q_b, unit tangents and radii r_a, r_b.

    The normal is n = +-(t_a x t_b), on the side of ``towards``, which is q_b - q_a for the truth; where the axes
    intersect, it is t_a x t_b. The tie point is (q_a + r_a n + q_b - r_b n) / 2, in the middle between the
    surfaces, and the gap (q_b - q_a) n - r_a - r_b. The tangents must not be parallel.
    """
    normal = np.cross(tangent_a, tangent_b)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    between_m = point_b_m - point_a_m
    sense = np.einsum("ni,ni->n", normal, between_m if towards is None else towards)
    normal *= np.where(sense < -ROUNDING_M, -1.0, 1.0)[:, None]
    r_a, r_b = radius_m[:, :1], radius_m[:, 1:]
    return TiePoints(
        tie_point_m=(point_a_m + r_a * normal + point_b_m - r_b * normal) / 2,
        normal=normal,
        gap_m=np.einsum("ni,ni->n", between_m, normal) - radius_m.sum(axis=1),
        angle_deg=angle_deg(tangent_a, tangent_b),
    )


@dataclass(frozen=True, eq=False)
class Crossings:
    """Crossings of a scene, in the order of their ids, which count from 1. Frame: world, metres.

    ``node_id`` is shared by crossings that one tie holds. ``point_a_m`` and ``point_b_m`` are the closest points
    of the axes, ``normal`` points from a to b. ``bar_a`` is less than ``bar_b``, or equal for a bar that crosses
    itself.
    """

    node_id: Int64[ndarray, " n"]
    bar_a: Int64[ndarray, " n"]
    bar_b: Int64[ndarray, " n"]
    point_a_m: Float64[ndarray, "n 3"]
    point_b_m: Float64[ndarray, "n 3"]
    tie_point_m: Float64[ndarray, "n 3"]
    gap_m: Float64[ndarray, " n"]
    angle_deg: Float64[ndarray, " n"]
    normal: Float64[ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.bar_a)

    @property
    def crossing_id(self) -> Int64[ndarray, " n"]:
        """Ids, 1 to n."""
        return np.arange(1, len(self) + 1)

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(np.unique(self.node_id))


def scene_crossings(bars: Sequence[Bar], max_gap_m: float = MAX_GAP_M) -> Crossings:
    """Return the crossings of a scene's bars, ordered by bars and along the first one; without an axis, none."""
    measured = sorted(with_axis(bars), key=lambda bar: bar.bar_id)
    axes = AxisSegments.of_bars(measured)
    found = local_minima(axes, max_gap_m)
    angles_deg = np.minimum(found.least_angle_deg, angle_deg(found.tangent_a, found.tangent_b))
    found = found.of((angles_deg >= MIN_ANGLE_DEG) & _are_separate(axes, found))
    along_a, along_b = (np.round(along_m / ROUNDING_M) for along_m in (found.along_a_m, found.along_b_m))
    found = found.of(np.lexsort((along_b, along_a, found.bar_b, found.bar_a)))
    found = found.of(_first_occurrences(found))
    radius_m = axes.diameter_m[np.column_stack([found.bar_a, found.bar_b])] / 2
    arguments = (found.point_a_m, found.point_b_m, found.tangent_a, found.tangent_b)
    ties = tie_points(*arguments, radius_m)
    chosen = _middle_minima(found, ties.tie_point_m, 2 * radius_m.max(axis=1, initial=0.0))
    found, ties = found.of(chosen), ties.of(chosen)
    ids = np.array([bar.bar_id for bar in measured], dtype=np.int64)
    return Crossings(
        node_id=node_ids(ties.tie_point_m, 2 * radius_m[chosen].max(axis=1, initial=0.0)),
        bar_a=ids[found.bar_a],
        bar_b=ids[found.bar_b],
        point_a_m=_rounded(found.point_a_m),
        point_b_m=_rounded(found.point_b_m),
        tie_point_m=_rounded(ties.tie_point_m),
        gap_m=_rounded(ties.gap_m),
        angle_deg=_rounded(ties.angle_deg),
        normal=_rounded(ties.normal),
    )


def _rounded(values: ndarray) -> ndarray:
    return np.asarray(np.round(values, _DECIMALS) + 0.0)  # + 0.0: no negative zeros.


def node_ids(tie_point_m: Float64[ndarray, "n 3"], diameter_m: Float64[ndarray, " n"]) -> Int64[ndarray, " n"]:
    """Return the node of each crossing, counted from 1 in the order of first occurrence.

    Crossings whose tie points are at most the largest diameter involved apart are linked, and all that are linked,
    also over others, are one node. ``diameter_m`` is the larger diameter of each crossing.
    """
    from scipy.spatial import cKDTree

    if not len(tie_point_m):
        return np.empty(0, np.int64)
    links = cKDTree(tie_point_m).query_pairs(float(diameter_m.max()) + ROUNDING_M, output_type="ndarray")
    apart_m = np.linalg.norm(tie_point_m[links[:, 0]] - tie_point_m[links[:, 1]], axis=1)
    return _linked(len(tie_point_m), links[apart_m <= diameter_m[links].max(axis=1, initial=0.0) + ROUNDING_M]) + 1


def _are_separate(axes: AxisSegments, found: Minima) -> ndarray:
    """Return which minima are of two bars, or far enough apart along one."""
    apart_m = np.abs(found.along_a_m - found.along_b_m)
    apart_m = np.where(
        axes.closed[found.bar_a], np.minimum(apart_m, axes.length_m[found.bar_a] - apart_m), apart_m
    )
    enough_m = MIN_SEPARATION_DIAMETERS * axes.diameter_m[found.bar_a] - ROUNDING_M
    return np.asarray((found.bar_a != found.bar_b) | (apart_m >= enough_m))


def _first_occurrences(found: Minima) -> ndarray:
    """Return which sorted minima are at other points than the one before; segments of a vertex repeat it."""
    same = np.zeros(len(found.bar_a), dtype=bool)
    same[1:] = (np.diff(found.bar_a) == 0) & (np.diff(found.bar_b) == 0)
    for points_m in (found.point_a_m, found.point_b_m):
        same[1:] &= np.linalg.norm(np.diff(points_m, axis=0), axis=1) <= 2 * ROUNDING_M
    return ~same


def _middle_minima(
    found: Minima, tie_point_m: Float64[ndarray, "m 3"], diameter_m: Float64[ndarray, " m"]
) -> Int64[ndarray, " n"]:
    """Return the positions of the middle minima of each linked group, ascending.

    ``found`` is sorted by pair and along the first bar; ``diameter_m`` is the larger diameter of each pair.
    """
    new_pair = (np.diff(found.bar_a, prepend=-1) != 0) | (np.diff(found.bar_b, prepend=-1) != 0)
    first = np.flatnonzero(new_pair)
    chosen = []
    for begin, end in zip(first, np.append(first, len(new_pair))[1:], strict=True):
        if end - begin == 1:
            chosen.append(int(begin))
            continue
        points_m = tie_point_m[begin:end]
        apart_m = np.linalg.norm(points_m[:, None] - points_m, axis=2)
        group = _linked(end - begin, np.argwhere(np.triu(apart_m < diameter_m[begin], 1)))
        members = (np.flatnonzero(group == number) for number in range(group.max() + 1))
        chosen += [int(begin + inside[(len(inside) - 1) // 2]) for inside in members]
    return np.array(sorted(chosen), dtype=np.int64)


def _linked(count: int, links: Int64[ndarray, "l 2"]) -> Int64[ndarray, " n"]:
    """Return the number of the connected group of each of ``count`` items, in the order of first occurrence."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse], dtype=np.int64)


# Local minima. The distance of two polylines is convex on each pair of segments. A point is a local minimum
# exactly if it is the minimum of every pair of segments that it belongs to: of one pair in the interior of both
# segments, of two or four at a vertex.


@dataclass(frozen=True, eq=False)
class Minima(Rows):
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
    tangents = bisectors(edges[:, :, 0], edges[:, :, 1])
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


def bisectors(a: Float64[ndarray, "*n 3"], b: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3"]:
    """Return the unit bisectors of unit vectors; opposite ones, where an axis turns back, have none: a."""
    sums = a + b
    length = np.linalg.norm(sums, axis=-1, keepdims=True)
    return np.where(length > 1e-6, sums / np.where(length > 1e-6, length, 1.0), a)


def angle_deg(a: Float64[ndarray, "n 3"], b: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
    """Return the angle between undirected lines along unit vectors, 0 to 90 degrees."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    cosine = np.abs(np.einsum("ni,ni->n", a, b))
    return np.asarray(np.rad2deg(np.arctan2(sine, cosine)))
