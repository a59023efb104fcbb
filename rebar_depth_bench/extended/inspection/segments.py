"""What a measuring tape would go along: the straight runs of a scene's bars, and which of them are neighbours.

Frames: world, metres. Truth only; no submission is looked at here.

Which of many straight runs are parallel, how far apart they are, and which stand side by side.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int16, Int64, UInt16
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import DatasetError

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


STRAIGHT_DEG = 1.0
"""A run ends where the centreline leaves the run's first direction by more than this."""

MIN_RUN = 4.0
"""A straight piece of at least this many diameters is a run; shorter ones belong to bends."""

MAX_REACH_M = 0.050
"""A fitted axis further from its place than this is not that bar, however lonely the bar stands."""

SURFACE_RADII = (0.8, 2.0)
"""A point of a run's side is this many nominal radii off its axis: ribs are, the flat cut ends are not."""

MAX_RUNS = 5000
"""Runs are compared pair by pair, in memory that grows with the square of their number: 0.8 GB at this many."""


@dataclass(frozen=True)
class Run:
    """A straight piece of a bar's centreline, from ``start_m`` to ``end_m``, and the bar's nominal diameter."""

    bar_id: int
    diameter_m: float
    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class CageTruth:
    """A scene's runs, and the pairs of them that stand side by side.

    ``neighbours`` holds indices into ``runs``, the lower one first: see ``side_by_side``. ``reach_m`` is for each
    run half the distance to the nearest parallel one, at most ``MAX_REACH_M``: an axis found further away than
    that is taken for another bar.
    """

    runs: tuple[Run, ...]
    neighbours: Int64[ndarray, "m 2"]
    reach_m: Float64[ndarray, " r"]

    @cached_property
    def start_m(self) -> Float64[ndarray, "r 3"]:
        """Where each run starts, world, metres."""
        return np.array([run.start_m for run in self.runs], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def end_m(self) -> Float64[ndarray, "r 3"]:
        """Where each run ends, world, metres."""
        return np.array([run.end_m for run in self.runs], dtype=np.float64).reshape(-1, 3)

    @cached_property
    def diameter_m(self) -> Float64[ndarray, " r"]:
        """The nominal diameter of each run's bar, metres."""
        return np.array([run.diameter_m for run in self.runs], dtype=np.float64)

    @cached_property
    def bar_id(self) -> Int64[ndarray, " r"]:
        """The bar that each run belongs to."""
        return np.array([run.bar_id for run in self.runs], dtype=np.int64)


def cage_truth(bars: Iterable[Bar]) -> CageTruth:
    """Return the straight runs of a scene's bars and their neighbours.

    Raises ``DatasetError`` where there are more than ``MAX_RUNS``.
    """
    runs = tuple(run for bar in bars for run in _straight_runs(bar))
    if len(runs) > MAX_RUNS:
        raise DatasetError(f"the bars have {len(runs)} straight runs, expected up to {MAX_RUNS}")
    start_m = np.array([run.start_m for run in runs], dtype=np.float64).reshape(-1, 3)
    end_m = np.array([run.end_m for run in runs], dtype=np.float64).reshape(-1, 3)
    diameter_m = np.array([run.diameter_m for run in runs], dtype=np.float64)
    bar_id = np.array([run.bar_id for run in runs], dtype=np.int64)
    found = parallels(start_m, end_m, diameter_m)
    reach_m = np.minimum(nearest_parallel_m(found) / 2, MAX_REACH_M)
    return CageTruth(runs, side_by_side(found, bar_id, diameter_m), reach_m)


def assign_runs(
    points_m: Float64[ndarray, "n 3"], bar_id: UInt16[ndarray, " n"], cage: CageTruth
) -> Int16[ndarray, " n"]:
    """Return for each true surface point (world, metres) the run of its own bar that it lies on, -1 for none.

    A point lies on a run if it stands over it (its foot on the axis is between the run's ends) and is
    ``SURFACE_RADII`` off the axis; of several runs the one with the nearest axis takes it. So bends, hooks' curves
    and the flat ends of bars are on no run. Raises ``ValueError`` where the two arrays differ in length.
    """
    if points_m.shape != (len(bar_id), 3):
        raise ValueError(f"points_m has shape {points_m.shape}, expected ({len(bar_id)}, 3) as bar_id has")
    assigned = np.full(len(bar_id), -1, dtype=np.int16)
    nearest_m = np.full(len(bar_id), np.inf)
    order = np.argsort(bar_id, kind="stable")
    first, last = (np.searchsorted(bar_id[order], cage.bar_id, side) for side in ("left", "right"))
    for run in np.flatnonzero(last > first):
        rows = order[first[run] : last[run]]
        on, away_m = _stands_on(points_m[rows], cage, int(run))
        taken = on & (away_m < nearest_m[rows])
        assigned[rows[taken]] = run
        nearest_m[rows[taken]] = away_m[taken]
    return assigned


def _stands_on(
    points_m: Float64[ndarray, "k 3"], cage: CageTruth, run: int
) -> tuple[Bool[ndarray, " k"], Float64[ndarray, " k"]]:
    """Return which points lie on a run's side, and how far all are from its axis (metres)."""
    line_m = cage.end_m[run] - cage.start_m[run]
    length_m = np.linalg.norm(line_m)
    direction = line_m / length_m
    from_start_m = points_m - cage.start_m[run]
    along_m = from_start_m @ direction
    away_m = np.linalg.norm(from_start_m - along_m[:, None] * direction, axis=1)
    radii = away_m / (cage.diameter_m[run] / 2)
    slack_m = 1e-6  # depth is float32
    over = (along_m >= -slack_m) & (along_m <= length_m + slack_m)
    return over & (radii >= SURFACE_RADII[0]) & (radii <= SURFACE_RADII[1]), away_m


def _straight_runs(bar: Bar) -> Iterator[Run]:
    """Yield the straight pieces of a bar that are long enough, from its first point to its last."""
    points_m = np.array(bar.axis_m)
    moved = np.linalg.norm(np.diff(points_m, axis=0), axis=1) > 0
    points_m = points_m[np.concatenate([[True], moved])]
    for first, last in _straight_pieces(points_m):
        start_m, end_m = points_m[first], points_m[last]
        if np.linalg.norm(end_m - start_m) >= MIN_RUN * bar.diameter_m:
            yield Run(bar.bar_id, bar.diameter_m, _as_point(start_m), _as_point(end_m))


def _straight_pieces(points_m: Float64[ndarray, "n 3"]) -> Iterator[tuple[int, int]]:
    """Yield (first, last) point of each stretch whose segments all keep to its first one's direction."""
    steps_m = np.diff(points_m, axis=0)
    directions = steps_m / np.linalg.norm(steps_m, axis=1, keepdims=True)
    least_cosine = np.cos(np.deg2rad(STRAIGHT_DEG))
    first = 0
    for segment in range(1, len(directions) + 1):
        if segment == len(directions) or directions[first] @ directions[segment] < least_cosine:
            yield first, segment
            first = segment


def _as_point(point_m: Float64[ndarray, " 3"]) -> tuple[float, float, float]:
    return (float(point_m[0]), float(point_m[1]), float(point_m[2]))
