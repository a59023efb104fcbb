"""Depth that several views agree on: each pixel's point is looked up in the neighbours' own depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from rebar_depth_bench.cameras import inverse_rigid, pixel_rays, project, transform

AGREEMENT = 0.01
"""Two views agree where their depths of a point differ by at most this share."""


def consistent(
    depth: Float32[ndarray, "h w"],
    cam_from_sfm: Float64[ndarray, "4 4"],
    neighbours: Sequence[tuple[Float32[ndarray, "h w"], Float64[ndarray, "4 4"]]],
    K: Float64[ndarray, "3 3"],
    least: int,
) -> Bool[ndarray, "h w"]:
    """Tell which pixels at least ``least`` of the neighbours (their depth and pose) confirm."""
    height, width = depth.shape
    known = np.isfinite(depth)
    points = transform(
        inverse_rigid(cam_from_sfm), pixel_rays(K, width, height)[known] * depth[known][:, None].astype(np.float64)
    )
    votes = np.zeros(len(points), np.int64)
    for other, pose in neighbours:
        seen = transform(pose, points)
        in_front = seen[:, 2] > 0
        places = np.full((len(points), 2), -1.0)
        places[in_front] = project(K, seen[in_front])
        u, v = np.rint(places).astype(np.int64).T
        inside = in_front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        there = np.full(len(points), np.nan)
        there[inside] = other[v[inside], u[inside]]
        with np.errstate(invalid="ignore"):
            votes += np.abs(there - seen[:, 2]) <= AGREEMENT * seen[:, 2]
    agreed = np.zeros(depth.shape, bool)
    agreed[known] = votes >= least
    return agreed
