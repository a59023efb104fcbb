"""Axes of bars by arc length, and the crossings of a scene with what judging and fitting need of both bars.

Frame: world, metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import AxisSegments, pieces
from rebar_depth_bench.bar_crossings.definition import Crossings
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.extended.segments import MAX_MATCH_RADIUS_M, STRAIGHT_DEG, CageTruth

_TANGENT_STEP_M = 1e-7


@dataclass(frozen=True, eq=False)
class Axis:
    """Axis of one bar as a polyline: segments from ``start_m`` by ``vector_m``, ``along_m`` of their starts."""

    start_m: Float64[ndarray, "s 3"]
    vector_m: Float64[ndarray, "s 3"]
    along_m: Float64[ndarray, " s"]
    length_m: float
    closed: bool
    diameter_m: float

    @classmethod
    def of_bar(cls, bar: Bar) -> Axis:
        """Return the axis of a bar that has one."""
        segments = AxisSegments.of_bars([bar])
        return cls(
            segments.start_m,
            segments.vector_m,
            segments.along_m,
            float(segments.length_m[0]),
            bool(segments.closed[0]),
            bar.diameter_m,
        )

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
            start_m, vector_m = self.start_m[segment], self.vector_m[segment]
            squared_m2 = np.einsum("ni,ni->n", vector_m, vector_m)
            share = np.clip(np.einsum("ni,ni->n", points_m - start_m, vector_m) / squared_m2, 0, 1)
            distance_m = np.linalg.norm(points_m - start_m - share[:, None] * vector_m, axis=1)
            closer = distance_m < best_m
            along_m = self.along_m[segment] + share * np.sqrt(squared_m2)
            best_along_m, best_m = np.where(closer, along_m, best_along_m), np.minimum(distance_m, best_m)
        return best_along_m, best_m

    @cached_property
    def _samples(self) -> tuple[Any, ndarray]:
        """Return a k-d tree of samples along the axis, a quarter of a diameter apart, and their segments."""
        from scipy.spatial import cKDTree

        segment, middle_m = pieces(self.start_m, self.vector_m, self.diameter_m / 4)
        return cKDTree(middle_m), segment

    def tangents(self, along_m: Float64[ndarray, " n"]) -> Float64[ndarray, "n 3"]:
        """Return the unit tangent at lengths along the axis; at a vertex, the bisector of its edges."""
        direction = self.vector_m / np.linalg.norm(self.vector_m, axis=1, keepdims=True)
        before, after = (self._segment_at(along_m + step_m) for step_m in (-_TANGENT_STEP_M, _TANGENT_STEP_M))
        bisector = direction[before] + direction[after]
        norm = np.linalg.norm(bisector, axis=1, keepdims=True)
        return np.where(norm > 1e-6, bisector / np.where(norm > 1e-6, norm, 1.0), direction[after])

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
        self, along_m: Float64[ndarray, " n"], tangent: Float64[ndarray, "n 3"], reach_m: float, max_deg: float
    ) -> Bool[ndarray, " n"]:
        """Return where all edges within ``reach_m`` along the axis are at most ``max_deg`` from the tangent."""
        lengths_m = np.linalg.norm(self.vector_m, axis=1)
        middle_m = self.relative_m((self.along_m + lengths_m / 2)[None], along_m[:, None])
        touched = np.abs(middle_m) - lengths_m / 2 < reach_m - _TANGENT_STEP_M
        cosine = tangent @ (self.vector_m / lengths_m[:, None]).T
        bends = cosine < np.cos(np.deg2rad(max_deg)) - 1e-12
        return np.asarray(~(touched & bends).any(axis=1))


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


def prepared_crossings(crossings: Crossings, bars: Iterable[Bar], cage: CageTruth) -> SceneCrossings:
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


def _match_radius_m(point_m: Float64[ndarray, "k 3"], bar_id: int, cage: CageTruth) -> Float64[ndarray, " k"]:
    """Return the match radius of the run of the bar that is nearest to each point; the largest without a run."""
    runs = np.flatnonzero(cage.bar_id == bar_id)
    if not len(runs):
        return np.full(len(point_m), MAX_MATCH_RADIUS_M)
    start_m, vector_m = cage.start_m[runs], cage.end_m[runs] - cage.start_m[runs]
    share = (point_m @ vector_m.T - (start_m * vector_m).sum(axis=1)) / (vector_m**2).sum(axis=1)
    feet_m = start_m + np.clip(share, 0, 1)[..., None] * vector_m
    distance_m = np.linalg.norm(point_m[:, None] - feet_m, axis=2)
    return np.asarray(cage.match_radius_m[runs[distance_m.argmin(axis=1)]])
