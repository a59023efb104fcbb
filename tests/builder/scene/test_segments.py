"""Closest points of segments, compared with the minimum over a grid of points."""

from __future__ import annotations

import numpy as np
import pytest

from rebar_depth_bench.geometry.segments import closest_points_m

SHARES = np.linspace(0, 1, 201)


def grid_distance_m(a: np.ndarray, b: np.ndarray) -> float:
    on_a, on_b = (ends[0] + SHARES[:, None] * (ends[1] - ends[0]) for ends in (a, b))
    return float(np.linalg.norm(on_a[:, None] - on_b[None], axis=2).min())


@pytest.mark.parametrize("kind", ["random", "parallel", "collinear", "crossing", "points", "point and segment"])
def test_distance_is_that_of_the_nearest_points(kind: str) -> None:
    random = np.random.default_rng(7)
    a, b = random.uniform(-1, 1, (2, 60, 2, 3))
    if kind == "parallel":
        b = a + random.uniform(-1, 1, (60, 1, 3))
    elif kind == "collinear":
        b = a + random.uniform(-3, 3, (60, 1, 1)) * (a[:, 1:] - a[:, :1])
    elif kind == "crossing":
        b = np.stack([2 * a.mean(axis=1) - b[:, 0], b[:, 0]], axis=1)
    elif kind == "points":
        a[:, 1], b[:, 1] = a[:, 0], b[:, 0]
    elif kind == "point and segment":
        a[:, 1] = a[:, 0]
    for first, second in ((a, b), (b, a)):
        on_first, on_second = closest_points_m(first[:, 0], first[:, 1], second[:, 0], second[:, 1])
        found_m = np.linalg.norm(on_first - on_second, axis=1)
        for index in range(60):
            grid_m = grid_distance_m(first[index], second[index])
            step_m = max(np.linalg.norm(ends[index, 1] - ends[index, 0]) for ends in (first, second)) / 200
            assert grid_m - step_m - 1e-12 <= found_m[index] <= grid_m + 1e-12
        for points, ends in ((on_first, first), (on_second, second)):
            detour_m = np.linalg.norm(points - ends[:, 0], axis=1) + np.linalg.norm(points - ends[:, 1], axis=1)
            np.testing.assert_allclose(detour_m, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), atol=1e-9)
