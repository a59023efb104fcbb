"""Point sets of surfaces: random samples, points that cover a mesh, points far from each other, short paths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.scene.model import Mesh

_CELL = 0.5
_EDGE = 0.97
"""Cells to which vertices are rounded and longest edges, per spacing.

Half the diagonal of a cell, and the distance of a triangle's points from its nearest corner (the longest edge over
the root of 3), add up to less than the spacing.
"""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface and its unit normals there, which point outward."""

    points_m: Float64[ndarray, "n 3"]
    normals: Float64[ndarray, "n 3"]


class SurfaceSampler:
    """Source of random points of a mesh, evenly distributed over its area."""

    def __init__(self, mesh: Mesh) -> None:
        """Prepare the sampling of ``mesh``; raise ``ValueError`` if it has no area."""
        self._mesh = mesh
        self._cumulative_area = np.cumsum(np.linalg.norm(_normals(mesh.vertices_m[mesh.faces]), axis=1))
        if not len(self._cumulative_area) or not self._cumulative_area[-1] > 0:
            raise ValueError("the mesh has no area")

    def sample(self, count: int, rng: np.random.Generator) -> SurfacePoints:
        """Return ``count`` points."""
        areas = rng.random(count) * self._cumulative_area[-1]
        faces = self._mesh.faces[np.searchsorted(self._cumulative_area, areas, side="right")]
        corners_m = self._mesh.vertices_m[faces]
        a, b = rng.random((2, count, 1))
        a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)  # Fold the square onto the triangle.
        first, second, third = np.moveaxis(corners_m, 1, 0)
        normals = _normals(corners_m)
        unit_normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return SurfacePoints(first + a * (second - first) + b * (third - first), unit_normals)


def _normals(corners: Float64[ndarray, "n 3 3"]) -> Float64[ndarray, "n 3"]:
    """Return the outward normals of triangles, as long as twice their area."""
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def covering_points(mesh: Mesh, spacing_m: float) -> Float64[ndarray, "n 3"]:
    """Return points of which one is within ``spacing_m`` of every point of the surface.

    The vertices are rounded to a grid, so that fine detail gives few points, and triangles with long edges are
    bisected.
    """
    cells, cell_of = _unique_cells(mesh.vertices_m / (_CELL * spacing_m))
    points_m = cells * (_CELL * spacing_m)
    triangles = _unique_triangles(cell_of[mesh.faces], len(cells))
    while len(triangles):
        corners_m = points_m[triangles]
        lengths_m = np.linalg.norm(corners_m - np.roll(corners_m, -1, axis=1), axis=2)
        is_long = lengths_m.max(axis=1) > _EDGE * spacing_m
        triangles, middles_m = _bisected(triangles[is_long], lengths_m[is_long].argmax(axis=1), points_m)
        points_m = np.concatenate([points_m, middles_m])
    return points_m


def _unique_cells(positions: Float64[ndarray, "v 3"]) -> tuple[Float64[ndarray, "c 3"], Int64[ndarray, " v"]]:
    """Return the different rounded positions, and the index of that of each position."""
    cells = np.round(positions).astype(np.int64)
    low = cells.min(axis=0)
    _, rows, columns = (cells - low).max(axis=0) + 1
    x, y, z = (cells - low).T
    _, first, cell_of = np.unique((x * rows + y) * columns + z, return_index=True, return_inverse=True)
    return cells[first].astype(np.float64), cell_of.reshape(-1)


def _unique_triangles(triangles: Int64[ndarray, "t 3"], points: int) -> Int64[ndarray, "u 3"]:
    """Return the different triangles, those with all corners at one of the ``points`` left out."""
    a, b, c = np.sort(triangles, axis=1).T
    used = a != c
    _, pair = np.unique(a[used] * points + b[used], return_inverse=True)
    _, first = np.unique(pair.reshape(-1) * points + c[used], return_index=True)
    return np.stack([a[used][first], b[used][first], c[used][first]], axis=1)


def _bisected(
    triangles: Int64[ndarray, "t 3"], edge: Int64[ndarray, " t"], points_m: Float64[ndarray, "n 3"]
) -> tuple[Int64[ndarray, "u 3"], Float64[ndarray, "m 3"]]:
    """Return both halves of each triangle, and the new points: the middles of the edges at corner ``edge``."""
    row, count = np.arange(len(triangles)), len(points_m)
    start, end, apex = (triangles[row, (edge + k) % 3] for k in range(3))
    edges, edge_of = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True)
    middle = count + edge_of.reshape(-1)
    halves = np.concatenate([np.stack([start, middle, apex], 1), np.stack([middle, end, apex], 1)])
    return halves, (points_m[edges // count] + points_m[edges % count]) / 2


def farthest_points(points_m: Float64[ndarray, "n 3"], count: int) -> Int64[ndarray, " k"]:
    """Return the indices of up to ``count`` points, each as far as possible from those before it.

    The first one is the farthest from the mean of all.
    """
    chosen = np.zeros(min(count, len(points_m)), np.int64)
    if len(chosen):
        chosen[0] = np.linalg.norm(points_m - points_m.mean(axis=0), axis=1).argmax()
    nearest_m = np.full(len(points_m), np.inf)
    for k in range(1, len(chosen)):
        nearest_m = np.minimum(nearest_m, np.linalg.norm(points_m - points_m[chosen[k - 1]], axis=1))
        chosen[k] = nearest_m.argmax()
    return chosen


def short_path(points_m: Float64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    """Return an order of points in which each is followed by the nearest one left; the lowest one is the first."""
    order = np.zeros(len(points_m), np.int64)
    left = np.ones(len(points_m), bool)
    for k in range(len(points_m)):
        previous_m = points_m[order[k - 1]]
        score = points_m[:, 2] if k == 0 else np.linalg.norm(points_m - previous_m, axis=1)
        order[k] = np.where(left, score, np.inf).argmin()
        left[order[k]] = False
    return order
