"""Which of many straight runs are parallel, how far apart they are, and which stand side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

PARALLEL_DEG = 5.0
"""Runs whose directions differ by less are parallel."""

MIN_OVERLAP = 4.0
"""Parallel runs must pass each other for this many of the larger diameter."""

MIN_CLEAR = 0.25
"""Runs with less between their surfaces, in the larger diameter, are lapped or bundled, not spaced."""

MAX_SPACING_M = 0.5
"""Runs further apart are no neighbours to measure between: a choice, above the spacing of bars in one layer."""

_NEARER = 1 - 1e-6
"""A third run blocks a pair only if it is nearer by more than rounding: equal distances block nothing."""


@dataclass(frozen=True, eq=False)
class Parallels:
    """Pairs of parallel runs that pass each other. All arrays are runs x runs.

    ``apart_m`` is the distance of the axes in the middle of their overlap, inf for pairs that are not parallel or
    do not pass each other, and for a run and itself. ``low_m`` to ``high_m`` is the part of run i's axis, from its
    start, that run j stands beside; ``middle_m`` the middle of what both have of it.
    """

    apart_m: Float64[ndarray, "r r"]
    low_m: Float64[ndarray, "r r"]
    high_m: Float64[ndarray, "r r"]
    middle_m: Float64[ndarray, "r r"]


def parallels(
    start_m: Float64[ndarray, "r 3"], end_m: Float64[ndarray, "r 3"], diameter_m: Float64[ndarray, " r"]
) -> Parallels:
    """Return which of the runs from ``start_m`` to ``end_m`` (one frame, metres) are parallel, and where."""
    count = len(diameter_m)
    apart_m, low_m, high_m, middle_m = (np.empty((count, count)) for _ in range(4))
    length_m = np.linalg.norm(end_m - start_m, axis=1)
    direction = (end_m - start_m) / length_m[:, None]
    for run in range(count):
        starts_m = (start_m - start_m[run]) @ direction[run]
        ends_m = (end_m - start_m[run]) @ direction[run]
        low_m[run], high_m[run] = np.minimum(starts_m, ends_m), np.maximum(starts_m, ends_m)
        from_m, to_m = np.maximum(low_m[run], 0.0), np.minimum(high_m[run], length_m[run])
        middle_m[run] = (from_m + to_m) / 2
        cosine = direction @ direction[run]
        passing = (np.abs(cosine) > np.cos(np.deg2rad(PARALLEL_DEG))) & (
            to_m - from_m >= MIN_OVERLAP * np.maximum(diameter_m, diameter_m[run])
        )
        passing[run] = False
        on_plane_m = (middle_m[run] - starts_m) / np.where(passing, cosine, 1.0)
        beside_m = start_m + on_plane_m[:, None] * direction
        here_m = start_m[run] + middle_m[run][:, None] * direction[run]
        apart_m[run] = np.where(passing, np.linalg.norm(beside_m - here_m, axis=1), np.inf)
    return Parallels(np.maximum(apart_m, apart_m.T), low_m, high_m, middle_m)


def nearest_parallel_m(found: Parallels) -> Float64[ndarray, " r"]:
    """Return each run's distance to the nearest run parallel to it, of whatever bar; inf where there is none."""
    return np.asarray(found.apart_m.min(axis=1, initial=np.inf))


def side_by_side(
    found: Parallels, bar_id: Int64[ndarray, " r"], diameter_m: Float64[ndarray, " r"]
) -> Int64[ndarray, "m 2"]:
    """Return the pairs (lower index first, ascending) that a tape measure would be held between.

    Two parallel runs of different bars, not lapped, at most ``MAX_SPACING_M`` apart, with no third parallel run
    between: none beside the middle of their overlap is nearer to both than they are to each other (the relative
    neighbourhood graph: Toussaint, Pattern Recognition 12, 1980).
    """
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for run in range(len(bar_id)):
        others = np.flatnonzero(_measurable(found, run, bar_id, diameter_m))
        others = others[others > run]
        at_m = found.middle_m[run, others]
        present = (found.low_m[run][:, None] <= at_m) & (at_m <= found.high_m[run][:, None])
        farther_m = np.maximum(found.apart_m[run][:, None], found.apart_m[:, others])
        blocked = (present & (farther_m < _NEARER * found.apart_m[run, others])).any(axis=0)
        free = others[~blocked]
        pairs.append(np.column_stack([np.full(len(free), run), free]))
    return np.concatenate(pairs)


def _measurable(
    found: Parallels, run: int, bar_id: Int64[ndarray, " r"], diameter_m: Float64[ndarray, " r"]
) -> Bool[ndarray, " r"]:
    """Return which runs stand beside a run as bars of their own: neither lapped with it nor out of reach."""
    apart_m = found.apart_m[run]
    clear_m = apart_m - (diameter_m + diameter_m[run]) / 2
    lapped = clear_m < MIN_CLEAR * np.maximum(diameter_m, diameter_m[run])
    return np.asarray(~lapped & (apart_m <= MAX_SPACING_M) & (bar_id != bar_id[run]))
