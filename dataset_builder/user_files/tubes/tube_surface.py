"""Surface of a candidate tube: welded triangles, their neighbours, cuts by planes, and distances from a polyline.

Coordinates are relative to the middle of the surface, so that a far origin costs no digits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_CAP_REACH = 0.3
"""Distance from the plane of an end within which a point may belong to its cap, in radii."""

_CAP_RADIUS = 0.8
"""Largest distance from the axis of points that are counted to the cap, in radii."""

_MAX_SAMPLES = 200_000
"""Largest number of pieces, beside one for each segment."""

_WELD_RATIO = 1e-6
"""Grid on which vertices are merged, as a share of the surface's extent: 1 um for a bar of a metre."""

_MAX_CUT_TRIANGLES = 5000
"""Largest number of triangles that a plane may cut around a point."""


@dataclass(frozen=True, eq=False)
class Cut:
    """Closed outline in which a plane cuts a surface: centre, area and the triangles that are cut."""

    centre_m: Float64[ndarray, " 3"]
    area_m2: float
    faces: Int64[ndarray, " k"]


@dataclass(frozen=True, eq=False)
class TubeSurface:
    """Triangles without duplicates or zero area, vertices closer than the weld grid merged; metres.

    ``edges`` are the vertices of each edge, the smaller index first; ``face_edges`` the edges of each triangle:
    from its first to its second vertex, second to third, third to first.
    """

    vertices_m: Float64[ndarray, "v 3"]
    faces: Int64[ndarray, "f 3"]
    edges: Int64[ndarray, "e 2"]
    face_edges: Int64[ndarray, "f 3"]

    @classmethod
    def welded(cls, vertices_m: Float64[ndarray, "v 3"], faces: ndarray) -> TubeSurface:
        """Return the surface of triangles in any order; vertices without triangles are dropped."""
        used = vertices_m[faces.ravel()]
        grid_m = max(float(np.ptp(used, axis=0).max()) * _WELD_RATIO, np.finfo(np.float64).tiny)
        cells = np.round((used - used.min(axis=0)) / grid_m).astype(np.int64)
        key = (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]  # A cell number has 20 bits.
        _, first, index = np.unique(key, return_index=True, return_inverse=True)
        corners = index.reshape(-1, 3).astype(np.int64)
        low, middle, high = np.sort(corners, axis=1).T
        distinct = (low != middle) & (middle != high)
        count = len(first)
        _, kept = np.unique((low * count + middle) * count + high, return_index=True)
        faces = corners[np.sort(kept[distinct[kept]])]
        pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        edge_keys, edge = np.unique(pairs[:, 0] * count + pairs[:, 1], return_inverse=True)
        return cls(used[first], faces, np.stack(np.divmod(edge_keys, count), axis=1), edge.reshape(-1, 3))

    @cached_property
    def corners_m(self) -> Float64[ndarray, "f 3 3"]:
        """Corners of each triangle."""
        return np.asarray(self.vertices_m[self.faces])

    @cached_property
    def area_vectors_m2(self) -> Float64[ndarray, "f 3"]:
        """Normal of each triangle times its area."""
        a, b, c = self.corners_m.transpose(1, 0, 2)
        return np.asarray(np.cross(b - a, c - a) / 2)

    @cached_property
    def areas_m2(self) -> Float64[ndarray, " f"]:
        """Area of each triangle."""
        return np.asarray(np.linalg.norm(self.area_vectors_m2, axis=1))

    @cached_property
    def is_open(self) -> Bool[ndarray, " e"]:
        """Whether an edge is that of one triangle only: of an open end."""
        return np.asarray(np.bincount(self.face_edges.ravel(), minlength=len(self.edges)) == 1)

    @cached_property
    def neighbours(self) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " m"]]:
        """Neighbours of all vertices in one array, and where those of each vertex start in it."""
        both = np.concatenate([self.edges, self.edges[:, ::-1]])
        both = both[np.argsort(both[:, 0], kind="stable")]
        return both[:, 1], np.searchsorted(both[:, 0], np.arange(len(self.vertices_m) + 1))

    @cached_property
    def _face_tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.corners_m.mean(axis=1))

    @cached_property
    def _longest_edge_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.vertices_m[self.edges], axis=1), axis=2).max())

    def _faces_near(self, point_m: Float64[ndarray, " 3"], reach_m: float) -> Int64[ndarray, " k"]:
        """Return the triangles that may come within ``reach_m`` of a point, in order; all if edges are long."""
        if self._longest_edge_m > 4 * reach_m:
            return np.arange(len(self.faces))
        near = self._face_tree.query_ball_point(point_m, reach_m + self._longest_edge_m, return_sorted=True)
        return np.array(near, dtype=np.int64)

    def is_connected(self) -> bool:
        """Return whether all triangles hang together."""
        return bool((component_labels(self.edges, len(self.vertices_m)) == 0).all())

    @cached_property
    def volume_m3(self) -> float:
        """Enclosed volume; an open end is closed towards the middle of the vertices around it."""
        inside = np.einsum("fi,fi->", self.corners_m[:, 0], self.area_vectors_m2) / 3
        directed = np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        start, end = directed[self.is_open[self.face_edges.ravel()]].T
        opening = component_labels(self.edges[self.is_open], len(self.vertices_m))[start]
        count = np.maximum(np.bincount(opening, minlength=1), 1)
        start_m, end_m = self.vertices_m[start], self.vertices_m[end]
        sums_m = [np.bincount(opening, start_m[:, axis], len(count)) for axis in range(3)]
        middle_m = (np.stack(sums_m, axis=1) / count[:, None])[opening]
        return abs(float(inside + np.einsum("ni,ni->", middle_m, np.cross(end_m, start_m)) / 6))

    def cut(self, point_m: Float64[ndarray, " 3"], normal: Float64[ndarray, " 3"], reach_m: float) -> Cut | None:
        """Return the closed outline around ``point_m`` in which the plane cuts the surface, or None.

        The plane passes through ``point_m`` with the unit vector ``normal``. The outline must come within
        ``reach_m`` of the point and stay within twice that distance of it.
        """
        candidates = self._faces_near(point_m, 2 * reach_m)
        face_side = (self.corners_m[candidates] - point_m) @ normal > 0
        is_cut = face_side.any(axis=1) & ~face_side.all(axis=1)
        faces, face_side = candidates[is_cut], face_side[is_cut]
        if not 0 < len(faces) <= _MAX_CUT_TRIANGLES:
            return None
        # Each cut triangle has two cut edges; the edges are the corners of the outline.
        cut_edge = face_side != np.roll(face_side, -1, axis=1)
        pairs = self.face_edges[faces][cut_edge].reshape(-1, 2)
        edges, index = np.unique(pairs, return_inverse=True)
        start, end = self.edges[edges].T
        start_m, end_m = self.vertices_m[start], self.vertices_m[end]
        above_m, below_m = (start_m - point_m) @ normal, (point_m - end_m) @ normal
        corners_m = start_m + (above_m / (above_m + below_m))[:, None] * (end_m - start_m)
        return _outline(corners_m, index.reshape(-1, 2), faces, point_m, normal, reach_m)


def component_labels(edges: Int64[ndarray, "e 2"], vertices: int) -> Int64[ndarray, " v"]:
    """Return the number of each vertex's connected component, from 0."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(vertices, vertices))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _outline(
    corners_m: Float64[ndarray, "c 3"],
    sides: Int64[ndarray, "s 2"],
    faces: Int64[ndarray, " s"],
    point_m: Float64[ndarray, " 3"],
    normal: Float64[ndarray, " 3"],
    reach_m: float,
) -> Cut | None:
    """Return the outline whose corner is the nearest to ``point_m``; None if it is open, forked or too far."""
    offset_m = corners_m - point_m
    distance_m = np.linalg.norm(offset_m, axis=1)
    first = int(distance_m.argmin())
    ordered = _closed_walk(sides, first) if distance_m[first] <= reach_m else None
    if ordered is None:
        return None
    outline_m = offset_m[ordered]
    following_m = np.roll(outline_m, -1, axis=0)
    doubled_area = np.cross(outline_m, following_m) @ normal
    total = float(doubled_area.sum())
    if total == 0:
        return None
    centre_m = (doubled_area[:, None] * (outline_m + following_m)).sum(axis=0) / (3 * total)
    is_part: Bool[ndarray, " c"] = np.zeros(len(corners_m), dtype=bool)
    is_part[ordered] = True
    return Cut(point_m + centre_m, abs(total) / 2, faces[is_part[sides[:, 0]]])


def _closed_walk(sides: Int64[ndarray, "s 2"], first: int) -> list[int] | None:
    """Return the corners of the closed outline through ``first``, in order, or None if it is open or forked."""
    beside: list[list[int]] = [[] for _ in range(int(sides.max()) + 1)]
    for a, b in sides.tolist():
        beside[a].append(b)
        beside[b].append(a)
    ordered, before, here = [first], first, beside[first][0]
    while here != first:
        if len(beside[here]) != 2:
            return None
        ordered.append(here)
        a, b = beside[here]
        before, here = here, b if a == before else a
    return ordered


@dataclass(frozen=True, eq=False)
class Feet:
    """Points relative to a polyline, metres.

    ``distance_m`` is the distance from the (infinite) line of the nearest segment, so that it is the radius also
    at the mitre of a corner. ``beyond_m`` is the distance beyond the plane of each end, negative before it, and
    minus infinity for points near other segments and for closed polylines.
    """

    distance_m: Float64[ndarray, " n"]
    beyond_m: Float64[ndarray, "n 2"]

    def on_cap(self, radius_m: float) -> Bool[ndarray, " n"]:
        """Return which points are on the flat ends of a bar of this radius, inside its circumference."""
        at_end = np.abs(self.beyond_m).min(axis=1) < _CAP_REACH * radius_m
        return np.asarray(at_end & (self.distance_m < _CAP_RADIUS * radius_m))

    def reach_ends(self, radius_m: float) -> bool:
        """Return whether the points extend to both ends and not farther; True for a closed polyline."""
        farthest_m = self.beyond_m.max(axis=0)
        return bool((np.isneginf(farthest_m) | (np.abs(farthest_m) < _CAP_REACH * radius_m)).all())


def feet_on(line_m: Float64[ndarray, "k 3"], points_m: Float64[ndarray, "n 3"]) -> Feet:
    """Return the positions of points relative to a polyline without repeated points."""
    from scipy.spatial import cKDTree

    start_m, along_m = line_m[:-1], np.diff(line_m, axis=0)
    length_m = np.linalg.norm(along_m, axis=1)
    direction = along_m / length_m[:, None]
    count = len(length_m)
    is_closed = bool((line_m[0] == line_m[-1]).all())
    # The middles of short pieces find the nearest segment up to its neighbours.
    step_m = float(max(length_m.mean() / 2, length_m.sum() / _MAX_SAMPLES))
    pieces = np.ceil(length_m / step_m).astype(np.int64)
    segment = np.repeat(np.arange(count), pieces)
    share = (np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 0.5) / pieces[segment]
    tree = cKDTree(start_m[segment] + share[:, None] * along_m[segment])
    nearest = segment[tree.query(points_m)[1]]
    best = np.full(len(points_m), np.inf)
    distance_m, along_best_m = np.zeros(len(points_m)), np.zeros(len(points_m))
    own: Int64[ndarray, " n"] = nearest.copy()
    for shift in (0, -1, 1):
        tried = (nearest + shift) % count if is_closed else np.clip(nearest + shift, 0, count - 1)
        offset_m = points_m - start_m[tried]
        foot_m = np.einsum("ni,ni->n", offset_m, direction[tried])
        across_m = np.linalg.norm(offset_m - foot_m[:, None] * direction[tried], axis=1)
        outside_m = np.maximum(np.maximum(-foot_m, foot_m - length_m[tried]), 0.0)
        gap_m = np.hypot(across_m, outside_m)
        better = gap_m < best
        best[better], own[better] = gap_m[better], tried[better]
        distance_m[better], along_best_m[better] = across_m[better], foot_m[better]
    beyond_m = np.full((len(points_m), 2), -np.inf)
    if not is_closed:
        beyond_m[own == 0, 0] = -along_best_m[own == 0]
        last = own == count - 1
        beyond_m[last, 1] = along_best_m[last] - length_m[-1]
    return Feet(distance_m, beyond_m)


def simplified_m(line_m: Float64[ndarray, "n 3"], slack_m: float) -> Float64[ndarray, "k 3"]:
    """Return the polyline without points that are within ``slack_m`` of it (Douglas and Peucker 1973)."""
    kept = np.zeros(len(line_m), dtype=bool)
    kept[[0, -1]] = True
    pending = [(0, len(line_m) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        inner_m = line_m[first + 1 : last] - line_m[first]
        chord_m = line_m[last] - line_m[first]
        squared = float(chord_m @ chord_m)
        share = np.clip(inner_m @ chord_m / squared, 0.0, 1.0) if squared > 0 else np.zeros(len(inner_m))
        off_m = np.linalg.norm(inner_m - share[:, None] * chord_m, axis=1)
        farthest = int(off_m.argmax())
        if off_m[farthest] > slack_m:
            middle = first + 1 + farthest
            kept[middle] = True
            pending += [(first, middle), (middle, last)]
    return np.asarray(line_m[kept])
