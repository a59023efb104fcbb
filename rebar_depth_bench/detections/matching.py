"""Matching of the detections of one view with its judged crossings. Frame: the left camera's, metres.

``matched_pairs`` finds the most pairs within a limit and, of several such matchings, the one with the least
total distance. For average precision, ``greedy_matches`` takes detections by descending confidence, each with the
nearest free crossing within the limit. A detection that is left over is false unless it is ``excused``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

MATCH_M = 0.010
"""Largest distance of a detection from the tie point that it is matched with, metres."""


def pairs_within(
    detected_m: Float64[ndarray, "n 3"], true_m: Float64[ndarray, "m 3"], limit_m: float
) -> tuple[Int64[ndarray, "p 2"], Float64[ndarray, " p"]]:
    """Return the pairs of a detection and a tie point at most ``limit_m`` apart, and their distances."""
    from scipy.spatial import cKDTree

    if not len(detected_m) or not len(true_m):
        return np.empty((0, 2), np.int64), np.empty(0)
    near = cKDTree(true_m).query_ball_point(detected_m, limit_m * (1 + 1e-9), return_sorted=True)
    counts = [len(found) for found in near]
    crossing = np.array([found for of_one in near for found in of_one], dtype=np.int64)
    pairs = np.column_stack([np.repeat(np.arange(len(detected_m)), counts), crossing])
    distance_m = np.linalg.norm(detected_m[pairs[:, 0]] - true_m[pairs[:, 1]], axis=1)
    return pairs, distance_m


def matched_pairs(
    detected_m: Float64[ndarray, "n 3"], true_m: Float64[ndarray, "m 3"], limit_m: float = MATCH_M
) -> Int64[ndarray, "k 2"]:
    """Return the pairs (detection, tie point) of the largest matching within ``limit_m``, by detection.

    Of several with as many pairs, it has the least total distance. Detections that share no tie point are matched
    apart from each other, which keeps the assignment problems small.
    """
    pairs, distance_m = pairs_within(detected_m, true_m, limit_m)
    groups = _components(pairs, len(detected_m), len(true_m))
    chosen = [_assignment(pairs[members], distance_m[members], limit_m) for members in groups]
    found = np.concatenate([np.empty((0, 2), np.int64), *chosen])
    return np.asarray(found[np.argsort(found[:, 0], kind="stable")])


def _components(pairs: Int64[ndarray, "p 2"], detections: int, crossings: int) -> Sequence[Int64[ndarray, " q"]]:
    """Return the positions of the pairs of each connected group of detections and tie points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(pairs):
        return []
    size = detections + crossings
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], detections + pairs[:, 1])), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    group = label[pairs[:, 0]]
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _assignment(
    pairs: Int64[ndarray, "q 2"], distance_m: Float64[ndarray, " q"], limit_m: float
) -> Int64[ndarray, "k 2"]:
    """Return the best matching of one group."""
    from scipy.optimize import linear_sum_assignment

    if len(pairs) == 1:
        return pairs
    rows, row = np.unique(pairs[:, 0], return_inverse=True)
    columns, column = np.unique(pairs[:, 1], return_inverse=True)
    # Every pair is worth more than all distances together, so that the number of pairs comes first.
    worth_m = limit_m * (min(len(rows), len(columns)) + 1)
    cost_m = np.zeros((len(rows), len(columns)))
    cost_m[row, column] = distance_m - worth_m
    first, second = linear_sum_assignment(cost_m)
    taken = cost_m[first, second] < 0
    return np.column_stack([rows[first[taken]], columns[second[taken]]])


def greedy_matches(
    detected_m: Float64[ndarray, "n 3"],
    confidence: Float64[ndarray, " n"],
    true_m: Float64[ndarray, "m 3"],
    limit_m: float,
) -> Bool[ndarray, " n"]:
    """Return which detections are matched if each takes the nearest free tie point, most confident first.

    Of equally confident ones, the nearest to a tie point comes first, so that the order of rows has no effect.
    """
    pairs, distance_m = pairs_within(detected_m, true_m, limit_m)
    nearest_m = np.full(len(detected_m), np.inf)
    np.minimum.at(nearest_m, pairs[:, 0], distance_m)
    order = np.lexsort((nearest_m, -confidence))
    by_distance = np.lexsort((distance_m, pairs[:, 0]))
    first = np.searchsorted(pairs[by_distance, 0], np.arange(len(detected_m) + 1))
    free = np.ones(len(true_m), dtype=bool)
    matched = np.zeros(len(detected_m), dtype=bool)
    for detection in order.tolist():
        candidates = pairs[by_distance[first[detection] : first[detection + 1]], 1]
        available = candidates[free[candidates]]
        if len(available):
            free[available[0]] = False
            matched[detection] = True
    return matched


def excused(
    detected_m: Float64[ndarray, "n 3"],
    left_over: Bool[ndarray, " n"],
    all_m: Float64[ndarray, "c 3"],
    is_judged: Bool[ndarray, " c"],
    priority: Float64[ndarray, " n"],
) -> Bool[ndarray, " n"]:
    """Return which detections that are left over are ignored.

    These are detections whose nearest crossing of the scene is not judged and within ``MATCH_M``. Each such
    crossing excuses one detection, the one with the highest ``priority`` and, of equal ones, the nearest.
    """
    from scipy.spatial import cKDTree

    ignored = np.zeros(len(detected_m), dtype=bool)
    if not len(all_m) or not left_over.any():
        return ignored
    distance_m, nearest = cKDTree(all_m).query(detected_m)
    candidates = np.flatnonzero(left_over & (distance_m <= MATCH_M * (1 + 1e-9)) & ~is_judged[nearest])
    order = candidates[np.lexsort((distance_m[candidates], -priority[candidates]))]
    _, first = np.unique(nearest[order], return_index=True)
    ignored[order[first]] = True
    return ignored
