"""As built against as designed: the deviation of bars from their nominal axes.

In the middle of what is seen of a straight segment of a bar with a nominal axis, the deviation is the vector from
the nominal axis to the axis as built, or to the fitted one, across the nominal axis. Frame: the camera's, metres.

The axis as built is the whole polyline, not its straight segments, which leave out the bow of a bar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import nearest_points
from rebar_depth_bench.extended.judged import VisibleSegments
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import transform

MAX_TURN_DEG = 30.0
"""Largest angle between a segment and the part of its nominal axis that it is compared with, degrees.

It keeps the other arms of a bent bar and its bends apart.
"""


@dataclass(frozen=True, eq=False)
class DesignedSegments:
    """Visible segments of bars with a nominal axis: a point and the direction of that axis, metres.

    ``row`` holds positions among the visible segments. ``true_m`` are the vectors from the nominal axis to the
    axis as built, across the nominal one.
    """

    row: Int64[ndarray, " r"]
    nominal_m: Float64[ndarray, "r 3"]
    direction: Float64[ndarray, "r 3"]
    true_m: Float64[ndarray, "r 3"]


def designed_segments(truth: SteelTruth, visible: VisibleSegments) -> DesignedSegments:
    """Return the visible segments of bars with a nominal axis."""
    bars = truth.bars
    rows, built, nominal = [], [], []
    for row, bar_id in enumerate(bars.cage.bar_id[visible.segment].tolist()):
        if bar_id not in bars.designed:
            continue
        bar, along = bars.designed[bar_id], visible.frame[row, 2]
        axis_m, nominal_axis_m = (
            transform(truth.cam_from_world, np.array(line_m)) for line_m in (bar.axis_m, bar.nominal_axis_m)
        )
        edge = _nearest_edge(axis_m, visible.middle_m[row], along)
        built_m = visible.middle_m[row] if edge is None else edge[0]
        if nominal_edge := _nearest_edge(nominal_axis_m, built_m, along):
            rows.append(row)
            built.append(built_m)
            nominal.append(nominal_edge)
    nominal_m, direction = np.array(nominal).reshape(-1, 2, 3).transpose(1, 0, 2)
    from_nominal_m = np.array(built).reshape(-1, 3) - nominal_m
    return DesignedSegments(np.array(rows, np.int64), nominal_m, direction, across(from_nominal_m, direction))


def _nearest_edge(
    line_m: Float64[ndarray, "n 3"], point_m: Float64[ndarray, " 3"], along: Float64[ndarray, " 3"]
) -> tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]] | None:
    """Return the nearest point and the unit direction of the edge of a polyline that is nearest to a point.

    Edges within ``MAX_TURN_DEG`` of ``along`` count; None without any.
    """
    step_m = np.diff(line_m, axis=0)
    length_m = np.linalg.norm(step_m, axis=1, keepdims=True)
    direction = step_m / np.where(length_m > 0, length_m, 1.0)
    nearest_m, _, distance_m = nearest_points(point_m, line_m[:-1], step_m)
    aligned = np.abs(direction @ along) >= np.cos(np.deg2rad(MAX_TURN_DEG))
    if not aligned.any():
        return None
    edge = int(np.argmin(np.where(aligned, distance_m, np.inf)))
    return nearest_m[edge], direction[edge]


def across(vector_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]) -> Float64[ndarray, "r 3"]:
    """Return the parts of vectors across the directions."""
    return np.asarray(vector_m - np.einsum("ri,ri->r", vector_m, direction)[:, None] * direction)
