"""Ground truth against geometry known without the ray caster: bar axes, the board, the other eye."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt16
from numpy import ndarray

from dataset_builder.model import Bar
from rebar_depth_bench.cameras import inverse_rigid, pixel_rays, project, transform
from rebar_depth_bench.protocol import interior

_MIN_WIDTH_PX = 2.0
_AROUND = tuple((dv, du) for dv in (-1, 0, 1, 2) for du in (-1, 0, 1, 2))
"""The pixel centres round a projection, relative to the one above and left of it."""
_BOARD_EDGE_M = 0.001


@dataclass(frozen=True)
class EpipolarCounts:
    """Interior steel pixels of the left view, looked up in the right one through their depth.

    ``seen`` have the same bar at the same depth there, ``hidden`` lie behind something nearer, ``outside``
    the right frame. ``contradicted`` would be visible but the right view sees past them.
    """

    seen: int
    hidden: int
    outside: int
    contradicted: int


def world_points_m(
    depth_m: Float32[ndarray, "h w"], K: Float64[ndarray, "3 3"], cam_from_world: Float64[ndarray, "4 4"]
) -> Float64[ndarray, "h w 3"]:
    """Return every pixel's point in the world frame, metres."""
    height, width = depth_m.shape
    points_cam = pixel_rays(K, width, height) * depth_m[..., None].astype(np.float64)
    return transform(inverse_rigid(cam_from_world), points_cam)


def axis_distance_ratio(
    points_m: Float64[ndarray, "h w 3"], bars: UInt16[ndarray, "h w"], steel: Iterable[Bar]
) -> Float64[ndarray, " n"]:
    """Return each steel pixel's distance from its bar's centreline over the bar's nominal radius.

    Round the whole bar it is 1 give or take the ribs; on an end cap less.
    """
    ratios = []
    for bar in steel:
        on_bar = points_m[bars == bar.bar_id]
        if len(on_bar):
            ratios.append(_polyline_distance_m(on_bar, np.array(bar.axis_m)) / (bar.diameter_m / 2))
    return np.concatenate(ratios) if ratios else np.zeros(0)


def board_error_m(
    row: Mapping[str, Any], eye: str, board: Mapping[str, Any], points_m: Float64[ndarray, "h w 3"]
) -> Float64[ndarray, " n"]:
    """Return how far from z = 0 the points lie that are not steel and stand over the board's known rectangle.

    A millimetre along its edge is left out: the sheet has sides.
    """
    size = np.array([board["width_m"], board["height_m"]])
    on_board = (np.abs(points_m[..., :2]) < size / 2 - _BOARD_EDGE_M).all(axis=-1)
    plane = ~row[f"{eye}_mask"] & on_board & (row[f"{eye}_depth"] > 0)
    return np.asarray(np.abs(points_m[plane][:, 2]))


def epipolar_counts(row: Mapping[str, Any], steel: Iterable[Bar]) -> EpipolarCounts:
    """Look the left view's interior steel pixels up in the right view.

    The cameras are parallel, so a point keeps its depth. The right view is read at the 4 x 4 pixel centres round
    the projection. A point is seen if its bar is there at its depth, give or take the bar's diameter; hidden if
    something there is nearer; contradicted otherwise. Bars thinner than two pixels can slip between pixel
    centres and are left out.
    """
    diameter_of = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in steel:
        diameter_of[bar.bar_id] = bar.diameter_m
    diameter_m = diameter_of[row["left_bars"]]
    wide = diameter_m * row["left_K"][0, 0] >= _MIN_WIDTH_PX * row["left_depth"]
    chosen = interior(row["left_mask"]) & wide
    points_m = world_points_m(row["left_depth"], row["left_K"], row["left_cam_from_world"])[chosen]
    in_right = transform(row["right_cam_from_world"], points_m)
    corner = np.floor(project(row["right_K"], in_right)).astype(int)
    height, width = row["right_depth"].shape
    inside = ((corner >= 1) & (corner < np.array([width, height]) - 2)).all(axis=1)
    u, v = corner[inside].T
    around_m = np.stack([row["right_depth"][v + dv, u + du] for dv, du in _AROUND], axis=1)
    around_bars = np.stack([row["right_bars"][v + dv, u + du] for dv, du in _AROUND], axis=1)
    depth_m = in_right[inside, 2, None]
    near_enough = np.abs(around_m - depth_m) <= diameter_m[chosen][inside, None]
    seen = (near_enough & (around_bars == row["left_bars"][chosen][inside, None])).any(axis=1)
    hidden = ~seen & (around_m < depth_m).any(axis=1)
    return EpipolarCounts(
        seen=int(np.count_nonzero(seen)),
        hidden=int(np.count_nonzero(hidden)),
        outside=int(np.count_nonzero(~inside)),
        contradicted=int(np.count_nonzero(~seen & ~hidden)),
    )


def _polyline_distance_m(
    points_m: Float64[ndarray, "n 3"], axis_m: Float64[ndarray, "k 3"]
) -> Float64[ndarray, " n"]:
    """Return the distance of points from the nearest segment's line, ends included."""
    distances = []
    for a, b in pairwise(axis_m):
        along = b - a
        share = np.clip((points_m - a) @ along / (along @ along), 0.0, 1.0)
        distances.append(np.linalg.norm(points_m - (a + share[:, None] * along), axis=1))
    return np.asarray(np.min(distances, axis=0))
