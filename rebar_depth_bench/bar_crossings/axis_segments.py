"""Segments of the axes of bars in flat arrays, and the pairs of segments that come near each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar

ROUNDING_M = 1e-9
"""Distance below which two points or lengths are equal, metres."""

_MIN_PIECE_M = 0.02
_MAX_PIECES = 200_000


class TooManyNeighboursError(Exception):
    """So many bars are close to each other that they are not compared."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Dataclass of arrays that have a row for each of the same items."""

    def of(self, rows: ndarray) -> Self:
        """Return the rows that a mask or positions choose."""
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class AxisSegments:
    """Segments of the axes of all bars of a scene (world, metres), bar by bar, in order along the axes.

    ``bar`` is the position of a segment's bar, and ``along_m`` the length of the axis before the segment.
    ``before`` and ``after`` are the neighbouring segments of the same axis, -1 at the ends of an open one. An axis
    is closed if it ends where it starts. ``length_m``, ``closed`` and ``diameter_m`` have one value for each bar.
    """

    start_m: Float64[ndarray, "s 3"]
    vector_m: Float64[ndarray, "s 3"]
    bar: Int64[ndarray, " s"]
    along_m: Float64[ndarray, " s"]
    before: Int64[ndarray, " s"]
    after: Int64[ndarray, " s"]
    length_m: Float64[ndarray, " b"]
    closed: ndarray  # Bool b
    diameter_m: Float64[ndarray, " b"]

    @classmethod
    def of_bars(cls, bars: Sequence[Bar]) -> Self:
        """Return the segments of bars that have an axis; repeated points of an axis are left out."""
        starts, vectors, along, before, after, lengths, closed = ([] for _ in range(7))
        first = 0
        for bar in bars:
            points_m = without_repeated(np.array(bar.axis_m, dtype=np.float64))
            steps_m = np.diff(points_m, axis=0)
            step_lengths_m = np.linalg.norm(steps_m, axis=1)
            ends = np.cumsum(step_lengths_m)
            number = first + np.arange(len(steps_m))
            is_closed = len(steps_m) > 2 and bool(np.linalg.norm(points_m[-1] - points_m[0]) <= ROUNDING_M)
            starts.append(points_m[:-1])
            vectors.append(steps_m)
            along.append(ends - step_lengths_m)
            before.append(np.concatenate([[number[-1] if is_closed else -1], number[:-1]])[: len(number)])
            after.append(np.concatenate([number[1:], [first if is_closed else -1]])[: len(number)])
            lengths.append(float(ends[-1]) if len(ends) else 0.0)
            closed.append(is_closed)
            first += len(steps_m)
        counts = [len(values) for values in along]
        return cls(
            np.concatenate([np.empty((0, 3)), *starts]),
            np.concatenate([np.empty((0, 3)), *vectors]),
            np.repeat(np.arange(len(bars)), counts),
            np.concatenate([np.empty(0), *along]),
            np.concatenate([np.empty(0, np.int64), *before]),
            np.concatenate([np.empty(0, np.int64), *after]),
            np.array(lengths),
            np.array(closed, dtype=bool),
            np.array([bar.diameter_m for bar in bars]),
        )

    def lengths_m(self, segments: Int64[ndarray, " n"]) -> Float64[ndarray, " n"]:
        """Return the lengths of some segments."""
        return np.asarray(np.linalg.norm(self.vector_m[segments], axis=1))

    def near_pairs(self, max_gap_m: float, max_pairs: int | None = None) -> Int64[ndarray, "p 2"]:
        """Return the pairs of segments (lower first, ascending) that can have ``max_gap_m`` or less between bars.

        All such pairs are returned, and some whose bars are farther apart. Long segments are searched in pieces.
        Raises ``TooManyNeighboursError`` for more than ``max_pairs`` pairs of pieces.
        """
        from scipy.spatial import cKDTree  # A quarter of a second to import.

        count = len(self.start_m)
        if not count:
            return np.empty((0, 2), np.int64)
        piece_m = max(_MIN_PIECE_M, float(np.linalg.norm(self.vector_m, axis=1).sum()) / _MAX_PIECES)
        segment, middles_m = pieces(self.start_m, self.vector_m, piece_m)
        reach_m = piece_m + float(self.diameter_m.max()) + max_gap_m
        tree = cKDTree(middles_m)
        if max_pairs is not None and tree.count_neighbors(tree, reach_m) > 2 * max_pairs:
            raise TooManyNeighboursError
        found = segment[tree.query_pairs(reach_m, output_type="ndarray")].reshape(-1, 2)
        found = np.sort(found[found[:, 0] != found[:, 1]], axis=1)
        keys = np.unique(found[:, 0] * count + found[:, 1])
        return np.column_stack([keys // count, keys % count])


def pieces(
    start_m: Float64[ndarray, "s 3"], vector_m: Float64[ndarray, "s 3"], max_m: float
) -> tuple[Int64[ndarray, " p"], Float64[ndarray, "p 3"]]:
    """Return segments in equal pieces of at most ``max_m``: the segment of each piece, and its middle."""
    counts = np.maximum(np.ceil(np.linalg.norm(vector_m, axis=1) / max_m), 1).astype(np.int64)
    segment = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = (number + 0.5) / counts[segment]
    return segment, start_m[segment] + share[:, None] * vector_m[segment]


def nearest_points(
    points_m: Float64[ndarray, "*n 3"], start_m: Float64[ndarray, "*n 3"], vector_m: Float64[ndarray, "*n 3"]
) -> tuple[Float64[ndarray, "*n 3"], Float64[ndarray, " *n"], Float64[ndarray, " *n"]]:
    """Return the nearest points on segments to points, their places from the starts, and their distances, metres.

    The arrays broadcast. On a segment without a length, the nearest point is its start.
    """
    length_m = np.linalg.norm(vector_m, axis=-1)
    direction = vector_m / np.where(length_m > 0, length_m, 1.0)[..., None]
    place_m = np.clip(np.einsum("...i,...i->...", points_m - start_m, direction), 0.0, length_m)
    nearest_m = start_m + place_m[..., None] * direction
    return nearest_m, place_m, np.linalg.norm(points_m - nearest_m, axis=-1)


def without_repeated(points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "m 3"]:
    """Return points without those that repeat the point before."""
    if len(points_m) < 2:
        return points_m
    differs = np.linalg.norm(np.diff(points_m, axis=0), axis=1) > 0
    return np.asarray(points_m[np.concatenate([[True], differs])])
