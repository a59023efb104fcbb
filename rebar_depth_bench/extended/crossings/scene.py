"""Crossings of a scene with what judging and fitting need of both bars. Frame: world, metres."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.definition import Crossings
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.extended.crossings.axis_feet import Axis
from rebar_depth_bench.extended.inspection.segments import MAX_MATCH_RADIUS_M, STRAIGHT_DEG, CageTruth

WINDOW_DIAMETERS = 6.0
"""Length along a bar on either side of a crossing that is judged and fitted, diameters."""


@dataclass(frozen=True, eq=False)
class SceneCrossings:
    """The n crossings of a scene; arrays n x 2 have a column for bar a and one for bar b.

    ``axes`` are those of the bars that cross, by bar id. ``along_m`` is the crossing's place along the axis and
    ``tangent`` the unit tangent there. ``straight`` marks where the axis deviates from it by at most
    ``STRAIGHT_DEG`` within ``WINDOW_DIAMETERS``. ``match_radius_m`` is that of the run of the bar at the crossing.
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


def no_crossings() -> SceneCrossings:
    """Return the crossings of a scene without any."""
    return prepared_crossings(Crossings.none(), (), None)


def prepared_crossings(crossings: Crossings, bars: Iterable[Bar], cage: CageTruth | None) -> SceneCrossings:
    """Return the crossings of a scene with the axes of its bars; ``cage`` has its straight runs."""
    bar_id = np.column_stack([crossings.bar_a, crossings.bar_b])
    point_m = np.stack([crossings.point_a_m, crossings.point_b_m], axis=1)
    crossing = set(bar_id.ravel().tolist())
    axes = {bar.bar_id: Axis.of_bar(bar) for bar in with_axis(bars) if bar.bar_id in crossing}
    diameter_m, along_m, match_radius_m = np.zeros((3, *bar_id.shape))
    tangent, straight = np.zeros((*bar_id.shape, 3)), np.zeros(bar_id.shape, dtype=bool)
    for number, axis in axes.items():
        own = bar_id == number
        diameter_m[own] = axis.diameter_m
        along_m[own], _ = axis.feet(point_m[own])
        tangent[own] = axis.tangents(along_m[own])
        reach_m = WINDOW_DIAMETERS * axis.diameter_m
        straight[own] = axis.is_straight(along_m[own], tangent[own], reach_m, STRAIGHT_DEG)
        match_radius_m[own] = _match_radius_m(point_m[own], number, cage)
    return SceneCrossings(crossings, axes, bar_id, diameter_m, point_m, along_m, tangent, straight, match_radius_m)


def _match_radius_m(
    point_m: Float64[ndarray, "k 3"], bar_id: int, cage: CageTruth | None
) -> Float64[ndarray, " k"]:
    """Return the match radius of the run of the bar that is nearest to each point; the largest without a run."""
    runs = np.flatnonzero(cage.bar_id == bar_id) if cage is not None else np.empty(0, np.int64)
    if cage is None or not len(runs):
        return np.full(len(point_m), MAX_MATCH_RADIUS_M)
    start_m, vector_m = cage.start_m[runs], cage.end_m[runs] - cage.start_m[runs]
    share = (point_m @ vector_m.T - (start_m * vector_m).sum(axis=1)) / (vector_m**2).sum(axis=1)
    feet_m = start_m + np.clip(share, 0, 1)[..., None] * vector_m
    distance_m = np.linalg.norm(point_m[:, None] - feet_m, axis=2)
    return np.asarray(cage.match_radius_m[runs[distance_m.argmin(axis=1)]])
