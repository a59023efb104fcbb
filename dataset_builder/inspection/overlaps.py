"""Bars that penetrate each other: pairs whose axes are closer than the sum of their radii."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.scene.shapes.segments import closest_points_m
from rebar_depth_bench.data.bars import Bar, with_axis

MIN_OVERLAP_M = 0.0005
"""Smallest overlap that counts, metres: bars that touch overlap by rounding errors."""

_PIECE_M, _MAX_PIECES = 0.1, 500_000
"""Length into which axes are divided to find neighbours, metres, longer where there would be too many pieces."""

MAX_PAIRS = 20_000_000
"""Largest number of pairs of neighbouring pieces that are compared."""

_CHUNK = 500_000


class TooManyNeighboursError(Exception):
    """So many bars are close to each other that they are not compared."""


@dataclass(frozen=True)
class Overlap:
    """Two bars that penetrate each other by ``depth_m``, and the point (world) where they do so most."""

    bar_a: int
    bar_b: int
    depth_m: float
    point_m: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Short pieces of the axes of bars: their ends, and the index and radius of the bar of each."""

    start_m: Float64[ndarray, "n 3"]
    end_m: Float64[ndarray, "n 3"]
    bar: Int64[ndarray, " n"]
    radius_m: Float64[ndarray, " n"]


def overlaps(bars: Sequence[Bar]) -> list[Overlap]:
    """Return the pairs of bars that penetrate each other by more than ``MIN_OVERLAP_M``, the deepest first.

    Bars without axis are left out. Raises ``TooManyNeighboursError`` for more than ``MAX_PAIRS`` neighbours.
    """
    measured = with_axis(bars)
    if len(measured) < 2:
        return []
    pieces = _pieces(measured)
    deepest: dict[tuple[int, int], tuple[float, list[float]]] = {}
    pairs = _neighbours(pieces)
    for first in range(0, len(pairs), _CHUNK):
        i, j = pairs[first : first + _CHUNK].T
        on_a, on_b = closest_points_m(pieces.start_m[i], pieces.end_m[i], pieces.start_m[j], pieces.end_m[j])
        depth_m = pieces.radius_m[i] + pieces.radius_m[j] - np.linalg.norm(on_a - on_b, axis=1)
        for index in np.flatnonzero(depth_m > MIN_OVERLAP_M).tolist():
            a, b = sorted((int(pieces.bar[i[index]]), int(pieces.bar[j[index]])))
            found_m = float(depth_m[index])
            if found_m > deepest.get((a, b), (0.0, []))[0]:
                deepest[a, b] = found_m, ((on_a[index] + on_b[index]) / 2).tolist()
    found = [
        Overlap(measured[a].bar_id, measured[b].bar_id, depth_m, (x, y, z))
        for (a, b), (depth_m, (x, y, z)) in deepest.items()
    ]
    return sorted(found, key=lambda overlap: (-overlap.depth_m, overlap.bar_a, overlap.bar_b))


def _pieces(bars: Sequence[Bar]) -> _Pieces:
    axes_m = [np.array(bar.axis_m) for bar in bars]
    start_m = np.concatenate([axis_m[:-1] for axis_m in axes_m])
    end_m = np.concatenate([axis_m[1:] for axis_m in axes_m])
    owner = np.repeat(np.arange(len(bars)), [len(axis_m) - 1 for axis_m in axes_m])
    length_m = np.linalg.norm(end_m - start_m, axis=1)
    step_m = max(_PIECE_M, float(length_m.sum()) / _MAX_PIECES)
    counts = np.maximum(1, np.ceil(length_m / step_m)).astype(np.int64)
    segment = np.repeat(np.arange(len(start_m)), counts)
    number = np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)
    along_m = (end_m - start_m)[segment]
    share = counts[segment][:, None]
    radius_m = np.array([bar.diameter_m / 2 for bar in bars])[owner]
    return _Pieces(
        start_m[segment] + number[:, None] / share * along_m,
        start_m[segment] + (number + 1)[:, None] / share * along_m,
        owner[segment],
        radius_m[segment],
    )


def _neighbours(pieces: _Pieces) -> Int64[ndarray, "n 2"]:
    """Return the pairs of pieces of different bars that are near enough to touch."""
    from scipy.spatial import cKDTree

    longest_m = float(np.linalg.norm(pieces.end_m - pieces.start_m, axis=1).max())
    reach_m = longest_m + 2 * float(pieces.radius_m.max())
    tree = cKDTree((pieces.start_m + pieces.end_m) / 2)
    if tree.count_neighbors(tree, reach_m) > 2 * MAX_PAIRS:
        raise TooManyNeighboursError
    pairs = tree.query_pairs(reach_m, output_type="ndarray").astype(np.int64)
    return np.asarray(pairs[pieces.bar[pairs[:, 0]] != pieces.bar[pairs[:, 1]]])
