"""Centrelines of candidate tubes: the middles of vertex rings, or of plane sections.

Programs that sweep bars make rings of vertices. A ring is found in the middle of the longest edge. From there the
rings follow each other: the next one consists of the neighbours of a ring that are not on it or the one before.
Their centres are the points of the centreline that was swept, also at sharp corners.

A tube of any other triangulation is cut with planes across its direction, which advance from a first section in
both directions. A step is longer where the tube is straight and shorter where it bends; a section is refused if
its area is not that of the first, or if its middle is not near the predicted point. The march ends where the
shortest step fails: at an end of the tube, or where it is no tube.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from dataset_builder.user_files.tubes.tube_surface import TubeSurface

MIN_FACETS = 5
"""Smallest number of vertices of a ring."""

MAX_SECTIONS = 4000
"""Largest number of sections of a bar."""

_MIN_STEP, _FIRST_STEP, _MAX_STEP = 0.12, 1.0, 8.0
"""Lengths of a step, in radii."""

_BEND_LIMIT, _STRAIGHT_LIMIT = 0.12, 0.03
"""Distances of a section's middle from the predicted one, in radii: too far; near enough to double the step."""

_CAP_COSINE = 0.7
"""Smallest cosine between the normal of a cap's triangles and the direction of the tube."""

_END_REACH = 1.4
"""Distance from the axis, in radii, within which points belong to an end: beyond ribs, before the next bar."""

_TURN_SHARE = 0.5
"""Turn from a chord to the direction at its end, relative to the turn from its start to the chord."""

_AREA_RANGE = 0.75, 1.35
"""Bounds of a section's area, relative to that of the first."""


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


class _Section(NamedTuple):
    """Middle of a section and the unit direction of the tube there."""

    centre_m: Float64[ndarray, " 3"]
    direction: Float64[ndarray, " 3"]


def section_centreline_m(
    surface: TubeSurface, point_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"], radius_m: float
) -> Float64[ndarray, "n 3"] | None:
    """Return the middles of the sections, with both ends, metres, or None if there is no closed section.

    ``point_m`` is on the surface, ``direction`` the unit direction of the tube there and ``radius_m`` its
    approximate radius. The centreline of a closed hoop ends at its first point.
    """
    first = surface.cut(point_m, direction, 2 * radius_m)
    if first is None:
        return None
    march = _March(surface, _Section(first.centre_m, direction), first.area_m2)
    ahead, is_hoop = march.run(1.0)
    if is_hoop:
        return np.asarray(np.stack([*ahead, ahead[0]]))
    back, _ = march.run(-1.0)
    return np.asarray(np.stack([*reversed(back), *ahead[1:]]))


class _March:
    """Advance of planes from a first section; the number of sections is limited in both directions together."""

    def __init__(self, surface: TubeSurface, first: _Section, area_m2: float) -> None:
        self._surface, self._first = surface, first
        self._area_m2, self._radius_m = area_m2, float(np.sqrt(area_m2 / np.pi))
        self._sections_left = MAX_SECTIONS

    def run(self, sign: float) -> tuple[list[Float64[ndarray, " 3"]], bool]:
        """Return the middles from the first section on, and whether the march came back to it.

        The last point of an open tube is the middle of its end.
        """
        here = _Section(self._first.centre_m, sign * self._first.direction)
        points_m, step = [here.centre_m], _FIRST_STEP
        while self._sections_left > 0:
            following, error = self._advance(here, step)
            if following is None or error > _BEND_LIMIT:
                if step <= _MIN_STEP:
                    break
                step = max(step / 2, _MIN_STEP)
                continue
            if len(points_m) > 2 and self._passes_first(here, following):
                return points_m, True
            points_m.append(following.centre_m)
            here = following
            step = min(2 * step, _MAX_STEP) if error < _STRAIGHT_LIMIT else step
        return self._with_end(points_m, here.direction), False

    def _advance(self, here: _Section, step: float) -> tuple[_Section | None, float]:
        """Return the section one step (radii) ahead, and its distance from the predicted point in radii.

        The plane is turned once, to the direction that the found middle suggests.
        """
        self._sections_left -= 1
        predicted_m = here.centre_m + step * self._radius_m * here.direction
        middle_m = self._middle_m(predicted_m, here.direction)
        if middle_m is None:
            return None, 0.0
        direction = _turned(here, middle_m)
        turned_m = self._middle_m(middle_m, direction)
        if turned_m is None:
            return None, 0.0
        error = float(np.linalg.norm(middle_m - predicted_m)) / self._radius_m
        return _Section(turned_m, _turned(here, turned_m)), error

    def _middle_m(
        self, point_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"]
    ) -> Float64[ndarray, " 3"] | None:
        """Return the middle of the section near ``point_m``, or None if there is none of the right area."""
        cut = self._surface.cut(point_m, direction, 1.5 * self._radius_m)
        if cut is None or not _AREA_RANGE[0] < cut.area_m2 / self._area_m2 < _AREA_RANGE[1]:
            return None
        return cut.centre_m

    def _passes_first(self, here: _Section, following: _Section) -> bool:
        """Return whether the chord between two sections passes the first middle, not only its plane."""
        offset_m = here.centre_m - self._first.centre_m
        chord_m = following.centre_m - here.centre_m
        before_m, advance_m = offset_m @ self._first.direction, chord_m @ self._first.direction
        if not before_m <= 0 < before_m + advance_m:
            return False
        passed_m = offset_m - before_m / advance_m * chord_m
        return bool(np.linalg.norm(passed_m) < self._radius_m)

    def _with_end(
        self, points_m: list[Float64[ndarray, " 3"]], direction: Float64[ndarray, " 3"]
    ) -> list[Float64[ndarray, " 3"]]:
        """Return the middles with that of the end in place of the last ones, whose planes may cut the cap."""
        last_m = points_m[-1]
        kept = [point_m for point_m in points_m[1:] if np.linalg.norm(point_m - last_m) > self._radius_m]
        kept = [points_m[0], *kept]
        base_m = next((p for p in kept[::-1] if np.linalg.norm(p - kept[-1]) > 2 * self._radius_m), None)
        if base_m is not None:
            direction = (kept[-1] - base_m) / np.linalg.norm(kept[-1] - base_m)
        return [*kept, self._end_m(kept[-1], direction)]

    def _end_m(self, last_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"]) -> Float64[ndarray, " 3"]:
        """Return the middle of the end ahead: that of its cap, or of the edges around an open end.

        Without either, it is the point of the axis as far ahead as the farthest vertex.
        """
        surface = self._surface
        facing = np.abs(surface.area_vectors_m2 @ direction) > _CAP_COSINE * surface.areas_m2
        cap = np.flatnonzero(facing)
        cap = cap[self._is_ahead(surface.corners_m[cap].mean(axis=1), last_m, direction)]
        if surface.areas_m2[cap].sum() > self._area_m2 / 2:
            return np.asarray(
                np.average(surface.corners_m[cap].mean(axis=1), axis=0, weights=surface.areas_m2[cap])
            )
        start_m, end_m = surface.vertices_m[surface.edges[surface.is_open].T]
        rim = self._is_ahead((start_m + end_m) / 2, last_m, direction)
        length_m = np.linalg.norm(end_m - start_m, axis=1)[rim]
        if length_m.sum() > np.pi * self._radius_m:
            return np.asarray(np.average(((start_m + end_m) / 2)[rim], axis=0, weights=length_m))
        ahead = self._is_ahead(surface.vertices_m, last_m, direction)
        along_m = (surface.vertices_m[ahead] - last_m) @ direction
        return np.asarray(last_m + along_m.max(initial=0.0) * direction)

    def _is_ahead(
        self, points_m: Float64[ndarray, "n 3"], last_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"]
    ) -> Bool[ndarray, " n"]:
        """Return which points belong to the rest of the tube beyond its last middle."""
        offset_m = points_m - last_m
        along_m = offset_m @ direction
        across_m = np.linalg.norm(offset_m - along_m[:, None] * direction, axis=1)
        is_near = (along_m > 0) & (along_m < (_MAX_STEP + 2) * self._radius_m)
        return np.asarray(is_near & (across_m < _END_REACH * self._radius_m))


def _turned(here: _Section, middle_m: Float64[ndarray, " 3"]) -> Float64[ndarray, " 3"]:
    """Return the direction at ``middle_m``: that of the chord from ``here``, turned on by ``_TURN_SHARE``.

    In a circle the direction turns on from the chord's by as much as it turned to the chord's. With the whole
    turn, an error of one section would return at each of the following with alternating sign; so it decays.
    """
    chord = middle_m - here.centre_m
    chord /= np.linalg.norm(chord)
    turned = chord + _TURN_SHARE * (chord - here.direction)
    return np.asarray(turned / np.linalg.norm(turned))
