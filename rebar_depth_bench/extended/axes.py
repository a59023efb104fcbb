"""Axes of the bars of a scene: straight segments and their neighbours, places along axes, and crossings.

The segments tell which bars are parallel, how far apart they are, and between which of them a tape measure would
be applied. Determined from the ground truth alone. Frame: world, metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int16, Int64, UInt16
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import AxisSegments, nearest_points, pieces, without_repeated
from rebar_depth_bench.bar_crossings.definition import Crossings, bisectors
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar, with_axis

PARALLEL_DEG = 5.0
"""Maximum angle between the directions of parallel segments, degrees."""

MIN_OVERLAP_DIAMETERS = 4.0
"""Minimum overlap of parallel segments along the axis, in diameters of the larger bar."""

MIN_CLEARANCE_DIAMETERS = 0.25
"""Minimum clear distance of two spaced segments, in diameters of the larger bar.

Segments with less between their surfaces are lapped or bundled, not spaced.
"""

MAX_SPACING_M = 0.5
"""Maximum axis distance of neighbours, metres.

This limit is our choice; it exceeds the usual spacing of bars in one layer.
"""

_NEARER_FACTOR = 1 - 1e-6
"""A third segment separates a pair only if it is nearer by more than this factor.

It absorbs rounding: segments at equal distances do not separate a pair.
"""


def parallel_pairs(
    start_m: Float64[ndarray, "r 3"], end_m: Float64[ndarray, "r 3"], diameter_m: Float64[ndarray, " r"]
) -> tuple[Float64[ndarray, "r r"], ...]:
    """Return ``apart_m``, ``low_m``, ``high_m`` and ``middle_m`` of segments from ``start_m`` to ``end_m``.

    ``apart_m`` is the distance of the axes in the middle of their overlap, inf for pairs that are not parallel or
    do not overlap, and on the diagonal. ``low_m`` to ``high_m`` is the extent of segment j projected on the axis
    of segment i, from its start; ``middle_m`` is the middle of their overlap on that axis. One frame, metres.
    """
    count = len(diameter_m)
    apart_m, low_m, high_m, middle_m = (np.empty((count, count)) for _ in range(4))
    length_m = np.linalg.norm(end_m - start_m, axis=1)
    direction = (end_m - start_m) / length_m[:, None]
    for segment in range(count):
        starts_m = (start_m - start_m[segment]) @ direction[segment]
        ends_m = (end_m - start_m[segment]) @ direction[segment]
        low_m[segment], high_m[segment] = np.minimum(starts_m, ends_m), np.maximum(starts_m, ends_m)
        from_m, to_m = np.maximum(low_m[segment], 0.0), np.minimum(high_m[segment], length_m[segment])
        middle_m[segment] = (from_m + to_m) / 2
        cosine = direction @ direction[segment]
        overlaps = (np.abs(cosine) > np.cos(np.deg2rad(PARALLEL_DEG))) & (
            to_m - from_m >= MIN_OVERLAP_DIAMETERS * np.maximum(diameter_m, diameter_m[segment])
        )
        overlaps[segment] = False
        along_other_m = (middle_m[segment] - starts_m) / np.where(overlaps, cosine, 1.0)
        other_point_m = start_m + along_other_m[:, None] * direction
        own_point_m = start_m[segment] + middle_m[segment][:, None] * direction[segment]
        apart_m[segment] = np.where(overlaps, np.linalg.norm(other_point_m - own_point_m, axis=1), np.inf)
    return np.maximum(apart_m, apart_m.T), low_m, high_m, middle_m


def overlapping_pairs(
    parallel_m: tuple[Float64[ndarray, "r r"], ...],
    bar_id: Int64[ndarray, " r"],
    diameter_m: Float64[ndarray, " r"],
) -> Int64[ndarray, "m 2"]:
    """Return the pairs of neighbouring segments whose spacing is measured, lower index first, ascending.

    A pair consists of two parallel, overlapping segments of different bars, not lapped, at most ``MAX_SPACING_M``
    apart, without a third parallel segment between them: no segment that is present at the middle of their overlap
    is nearer to both than they are to each other (the relative neighbourhood graph: Toussaint, Pattern Recognition
    12, 1980). ``parallel_m`` is the result of ``parallel_pairs``.
    """
    all_apart_m, low_m, high_m, middle_m = parallel_m
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for segment in range(len(bar_id)):
        apart_m = all_apart_m[segment]
        clear_m = apart_m - (diameter_m + diameter_m[segment]) / 2
        lapped = clear_m < MIN_CLEARANCE_DIAMETERS * np.maximum(diameter_m, diameter_m[segment])
        others = np.flatnonzero(~lapped & (apart_m <= MAX_SPACING_M) & (bar_id != bar_id[segment]))
        others = others[others > segment]
        at_m = middle_m[segment, others]
        present = (low_m[segment][:, None] <= at_m) & (at_m <= high_m[segment][:, None])
        farther_m = np.maximum(apart_m[:, None], all_apart_m[:, others])
        blocked = (present & (farther_m < _NEARER_FACTOR * apart_m[others])).any(axis=0)
        free = others[~blocked]
        pairs.append(np.column_stack([np.full(len(free), segment), free]))
    return np.concatenate(pairs)


# Straight segments of bars, from axes that bend.

STRAIGHT_DEG = 1.0
"""A segment ends where the centreline deviates from its first direction by more than this angle, degrees."""

MIN_SEGMENT_DIAMETERS = 4.0
"""Minimum length of a segment, in diameters; shorter straight pieces belong to bends."""

MAX_MATCH_RADIUS_M = 0.050
"""Upper bound of ``CageTruth.match_radius_m``, metres: applies to bars without close neighbours."""

SURFACE_DISTANCE_RADII = (0.8, 2.0)
"""Range of the distance of points on a segment's side from its axis, in nominal radii.

It includes ribs and excludes the flat cut ends.
"""

MAX_SEGMENTS = 5000
"""Maximum number of segments per scene.

Segments are compared pairwise, in memory quadratic in their number: 0.8 GB for this many.
"""


@dataclass(frozen=True, eq=False)
class CageTruth:
    """Straight bar segments of a scene and the pairs of neighbours among them; world, metres.

    ``bar_id`` and ``diameter_m`` describe the bar of each segment, and ``line_m`` are the points of its axis from
    ``start_m`` to ``end_m``, between which a bar may be bowed. ``neighbours`` holds indices of segments, the
    lower one first: see ``overlapping_pairs``; ``spacing_m`` is the distance of their axes in the middle of their
    overlap. ``match_radius_m`` is half the distance from each segment to the nearest parallel segment of any bar,
    at most ``MAX_MATCH_RADIUS_M``: a fitted axis farther away than that is attributed to another bar.
    """

    bar_id: Int64[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]
    start_m: Float64[ndarray, "r 3"]
    end_m: Float64[ndarray, "r 3"]
    line_m: Sequence[Float64[ndarray, "k 3"]]
    neighbours: Int64[ndarray, "m 2"]
    spacing_m: Float64[ndarray, " m"]
    match_radius_m: Float64[ndarray, " r"]

    def __len__(self) -> int:
        return len(self.bar_id)


def cage_truth(bars: Iterable[Bar]) -> CageTruth:
    """Return the straight segments of a scene's bars and their neighbours; bars without an axis have none.

    Raises ``DatasetError`` if there are more than ``MAX_SEGMENTS``.
    """
    segments = [(bar, line_m) for bar in with_axis(bars) for line_m in _straight_segments(bar)]
    if len(segments) > MAX_SEGMENTS:
        raise DatasetError(f"the bars have {len(segments)} straight runs, expected up to {MAX_SEGMENTS}")
    bar_id = np.array([bar.bar_id for bar, _ in segments], dtype=np.int64)
    diameter_m = np.array([bar.diameter_m for bar, _ in segments], dtype=np.float64)
    lines_m = [line_m for _, line_m in segments]
    start_m, end_m = (np.array([line_m[end] for line_m in lines_m]).reshape(-1, 3) for end in (0, -1))
    parallel_m = parallel_pairs(start_m, end_m, diameter_m)
    match_radius_m = np.minimum(parallel_m[0].min(axis=1, initial=np.inf) / 2, MAX_MATCH_RADIUS_M)
    neighbours = overlapping_pairs(parallel_m, bar_id, diameter_m)
    spacing_m = parallel_m[0][neighbours[:, 0], neighbours[:, 1]]
    return CageTruth(bar_id, diameter_m, start_m, end_m, lines_m, neighbours, spacing_m, match_radius_m)


def assign_segments(
    points_m: Float64[ndarray, "n 3"], bar_id: UInt16[ndarray, " n"], cage: CageTruth
) -> Int16[ndarray, " n"]:
    """Return for each true surface point (world, metres) the segment of its own bar that it lies on, -1 for none.

    A point lies on a segment if its foot on the axis is between the segment's ends and its distance from the axis
    is within ``SURFACE_DISTANCE_RADII``; of several segments the one with the nearest axis is assigned. Bends,
    hooks and the flat ends of bars therefore belong to no segment.
    """
    assigned = np.full(len(bar_id), -1, dtype=np.int16)
    nearest_m = np.full(len(bar_id), np.inf)
    order = np.argsort(bar_id, kind="stable")
    first, last = (np.searchsorted(bar_id[order], cage.bar_id, side) for side in ("left", "right"))
    for segment in np.flatnonzero(last > first):
        rows = order[first[segment] : last[segment]]
        line_m = cage.end_m[segment] - cage.start_m[segment]
        length_m = np.linalg.norm(line_m)
        direction = line_m / length_m
        from_start_m = points_m[rows] - cage.start_m[segment]
        along_m = from_start_m @ direction
        distance_m = np.linalg.norm(from_start_m - along_m[:, None] * direction, axis=1)
        slack_m = 1e-6  # rounding of float32 depth
        foot_inside = (along_m >= -slack_m) & (along_m <= length_m + slack_m)
        on_side = foot_inside & is_on_surface(distance_m, cage.diameter_m[segment])
        nearer = on_side & (distance_m < nearest_m[rows])
        assigned[rows[nearer]] = segment
        nearest_m[rows[nearer]] = distance_m[nearer]
    return assigned


def is_on_surface(distance_m: Float64[ndarray, " n"], diameter_m: float) -> Bool[ndarray, " n"]:
    """Return which distances from the axis of a bar are within ``SURFACE_DISTANCE_RADII``."""
    radii = distance_m / (diameter_m / 2)
    return np.asarray((radii >= SURFACE_DISTANCE_RADII[0]) & (radii <= SURFACE_DISTANCE_RADII[1]))


def _straight_segments(bar: Bar) -> Iterator[Float64[ndarray, "k 3"]]:
    """Yield the points of the straight segments of a bar that are long enough, from its first point to its last.

    All edges of a segment follow the direction of its first one.
    """
    points_m = without_repeated(np.array(bar.axis_m))
    steps_m = np.diff(points_m, axis=0)
    directions = steps_m / np.linalg.norm(steps_m, axis=1, keepdims=True)
    least_cosine = np.cos(np.deg2rad(STRAIGHT_DEG))
    first = 0
    for edge in range(1, len(directions) + 1):
        if edge == len(directions) or directions[first] @ directions[edge] < least_cosine:
            if np.linalg.norm(points_m[edge] - points_m[first]) >= MIN_SEGMENT_DIAMETERS * bar.diameter_m:
                yield points_m[first : edge + 1]
            first = edge


# Windows of both bars around a crossing.

WINDOW_DIAMETERS = 6.0
"""Length along a bar on either side of a crossing that is judged and fitted, diameters."""

_TANGENT_STEP_M = 1e-7


class Axis(AxisSegments):
    """Axis of one bar: the arrays of the bar, such as ``diameter_m``, have one value."""

    def feet(self, points_m: Float64[ndarray, "n 3"]) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
        """Return for each point the length along the axis at the nearest point of the axis, and its distance.

        The nearest of close samples of the axis is found first, then the foot on the segments around it.
        """
        tree, segments = self._samples
        _, nearest = tree.query(points_m)
        best_along_m, best_m = np.zeros(len(points_m)), np.full(len(points_m), np.inf)
        for step in (-1, 0, 1):
            sample = nearest + step
            segment = segments[sample % len(segments) if self.closed else np.clip(sample, 0, len(segments) - 1)]
            _, place_m, distance_m = nearest_points(points_m, self.start_m[segment], self.vector_m[segment])
            best_along_m = np.where(distance_m < best_m, self.along_m[segment] + place_m, best_along_m)
            best_m = np.minimum(distance_m, best_m)
        return best_along_m, best_m

    @cached_property
    def _samples(self) -> tuple[Any, ndarray]:
        """Return a k-d tree of samples along the axis, a quarter of a diameter apart, and their segments."""
        from scipy.spatial import cKDTree

        segment, middle_m = pieces(self.start_m, self.vector_m, self.diameter_m.item() / 4)
        return cKDTree(middle_m), segment

    def tangents(self, along_m: Float64[ndarray, " n"]) -> Float64[ndarray, "n 3"]:
        """Return the unit tangent at lengths along the axis; at a vertex, the bisector of its edges."""
        direction = self.vector_m / np.linalg.norm(self.vector_m, axis=1, keepdims=True)
        before, after = (self._segment_at(along_m + step_m) for step_m in (-_TANGENT_STEP_M, _TANGENT_STEP_M))
        return bisectors(direction[after], direction[before])

    def _segment_at(self, along_m: Float64[ndarray, " n"]) -> ndarray:
        if self.closed:
            along_m = along_m % self.length_m
        return np.clip(np.searchsorted(self.along_m, along_m, side="right") - 1, 0, len(self.along_m) - 1)

    def relative_m(self, along_m: ndarray, origin_m: ndarray | float) -> ndarray:
        """Return lengths along the axis from ``origin_m``; around a closed axis, the shorter way."""
        relative_m = np.asarray(along_m - origin_m)
        if not self.closed:
            return relative_m
        return np.asarray((relative_m + self.length_m / 2) % self.length_m - self.length_m / 2)

    def is_straight(
        self, along_m: Float64[ndarray, " n"], tangent: Float64[ndarray, "n 3"]
    ) -> Bool[ndarray, " n"]:
        """Return where all edges within the window of a point are at most ``STRAIGHT_DEG`` from the tangent."""
        lengths_m = np.linalg.norm(self.vector_m, axis=1)
        middle_m = self.relative_m((self.along_m + lengths_m / 2)[None], along_m[:, None])
        touched = np.abs(middle_m) - lengths_m / 2 < WINDOW_DIAMETERS * self.diameter_m - _TANGENT_STEP_M
        cosine = tangent @ (self.vector_m / lengths_m[:, None]).T
        bends = cosine < np.cos(np.deg2rad(STRAIGHT_DEG)) - 1e-12
        return np.asarray(~(touched & bends).any(axis=1))


@dataclass(frozen=True, eq=False)
class SceneCrossings:
    """The n crossings of a scene; arrays n x 2 have a column for bar a and one for bar b.

    ``axes`` holds the axis of each bar that crosses another, by bar id. ``along_m`` is the crossing's place along
    the axis and ``tangent`` the unit tangent there. ``straight`` marks where the axis deviates from the tangent by
    at most ``STRAIGHT_DEG`` within ``WINDOW_DIAMETERS``. ``match_radius_m`` is the radius of the nearest segment
    of the bar, or ``MAX_MATCH_RADIUS_M`` for a bar without segments.
    """

    crossings: Crossings
    axes: Mapping[int, Axis]
    bar_id: ndarray  # Int64 n 2
    diameter_m: Float64[ndarray, "n 2"]
    point_m: Float64[ndarray, "n 2 3"]
    along_m: Float64[ndarray, "n 2"]
    tangent: Float64[ndarray, "n 2 3"]
    straight: Bool[ndarray, "n 2"]
    match_radius_m: Float64[ndarray, "n 2"]

    def __len__(self) -> int:
        return len(self.crossings)


def prepared_crossings(crossings: Crossings, bars: Iterable[Bar], cage: CageTruth) -> SceneCrossings:
    """Return the crossings of a scene with the axes of its bars; ``cage`` has its straight runs."""
    bar_id = np.column_stack([crossings.bar_a, crossings.bar_b])
    point_m = np.stack([crossings.point_a_m, crossings.point_b_m], axis=1)
    crossing = set(bar_id.ravel().tolist())
    axes = {bar.bar_id: Axis.of_bars([bar]) for bar in with_axis(bars) if bar.bar_id in crossing}
    diameter_m, along_m = np.zeros((2, *bar_id.shape))
    match_radius_m = np.full(bar_id.shape, MAX_MATCH_RADIUS_M)
    tangent, straight = np.zeros((*bar_id.shape, 3)), np.zeros(bar_id.shape, dtype=bool)
    for number, axis in axes.items():
        own = bar_id == number
        diameter_m[own] = axis.diameter_m
        along_m[own], _ = axis.feet(point_m[own])
        tangent[own] = axis.tangents(along_m[own])
        straight[own] = axis.is_straight(along_m[own], tangent[own])
        runs = np.flatnonzero(cage.bar_id == number)
        if len(runs):
            vector_m = cage.end_m[runs] - cage.start_m[runs]
            _, _, distance_m = nearest_points(point_m[own][:, None], cage.start_m[runs], vector_m)
            match_radius_m[own] = cage.match_radius_m[runs[distance_m.argmin(axis=1)]]
    return SceneCrossings(crossings, axes, bar_id, diameter_m, point_m, along_m, tangent, straight, match_radius_m)
