"""Centreline of a tube whose triangulation consists of rings of vertices, as programs sweep bars.

A ring is found in the middle of the longest edge. From there the rings follow each other: the next one consists of
the neighbours of a ring that are not on it or the one before. Their centres are the points of the centreline that
was swept, also at sharp corners. Surfaces without rings are left to ``tube_sections``.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from dataset_builder.scene.shapes.tube_surface import TubeSurface

MIN_FACETS = 5
"""Smallest number of vertices of a ring."""


def ring_centreline_m(
    surface: TubeSurface, point_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"], radius_m: float
) -> Float64[ndarray, "n 3"] | None:
    """Return the centres of the rings in order, metres, or None if the triangulation has no rings.

    ``point_m`` is on the surface between two rings, ``direction`` the unit direction of the tube there and
    ``radius_m`` its approximate radius. The centreline of a closed hoop ends at its first point.
    """
    start = surface.cut(point_m, direction, radius_m)
    if start is None:
        return None
    corners = np.unique(surface.faces[start.faces])
    above = (surface.vertices_m[corners] - point_m) @ direction > 0
    first, before = corners[above], corners[~above]
    if len(first) != len(before) or len(first) < MIN_FACETS:
        return None
    visited = np.zeros(len(surface.vertices_m), dtype=bool)
    visited[corners] = True
    ahead = _rings_from(surface, first, visited)
    is_hoop = bool(np.isin(_neighbours(surface, ahead[-1]), before).any()) and len(ahead) > 1
    rings = [*reversed(_rings_from(surface, before, visited)), *ahead]
    centres_m = np.stack([surface.vertices_m[ring].mean(axis=0) for ring in rings])
    if not _are_covered(surface, visited, centres_m, radius_m):
        return None
    return np.asarray(np.concatenate([centres_m, centres_m[:1]]) if is_hoop else centres_m)


def _rings_from(
    surface: TubeSurface, first: Int64[ndarray, " k"], visited: Bool[ndarray, " v"]
) -> list[Int64[ndarray, " k"]]:
    """Return ``first`` and the rings that follow it, and mark their vertices in ``visited``."""
    rings = [first]
    while True:
        around = _neighbours(surface, rings[-1])
        following = np.unique(around[~visited[around]])
        if len(following) != len(first):
            return rings
        visited[following] = True
        rings.append(following)


def _neighbours(surface: TubeSurface, vertices: Int64[ndarray, " k"]) -> Int64[ndarray, " n"]:
    """Return the neighbours of all ``vertices``, with repetitions."""
    neighbours, starts = surface.neighbours
    return np.concatenate([neighbours[starts[vertex] : starts[vertex + 1]] for vertex in vertices])


def _are_covered(
    surface: TubeSurface, visited: Bool[ndarray, " v"], centres_m: Float64[ndarray, "n 3"], radius_m: float
) -> bool:
    """Return whether all vertices beyond the rings are within the end caps, less than a radius from an end."""
    beyond_m = surface.vertices_m[~visited]
    ends_m = centres_m[[0, -1]]
    distance_m = np.linalg.norm(beyond_m[:, None] - ends_m, axis=2).min(axis=1, initial=np.inf)
    return bool((distance_m < radius_m).all())
