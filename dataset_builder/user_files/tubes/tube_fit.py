"""Centreline and diameter of a bar, fitted to its surface and checked against all of it.

Three centrelines are tried: a straight line, the middles of vertex rings and the middles of plane sections
(``tube_centrelines``). The first is taken for which the whole surface is that of a round tube:

- every vertex, and the middle of every edge and triangle, lies within ``TOLERANCE`` diameters of the tube's
  surface (ends are flat; at a corner of the centreline the tube is mitred), as for polygons of five sides or more;
- the surface reaches both ends of the centreline and not beyond;
- the area of its side is that of a tube: not a channel, a doubled wall, or a piece of a tube.

Everything else is refused: plates, brackets, hollow pipes, headed bars, several bars in one surface.

The diameter of a smooth bar is that of the circle through the vertices, since most programs set the corners of a
polygon onto the circle. That of a ribbed bar, whose vertices are at various distances, is the diameter of the
smooth bar of equal length and volume, as for the nominal diameter.

Measured on six bent shapes (``tests.builder.user_files.tube_shapes``): swept polygons of 8, 12 and 24 sides to
0.01 % of diameter and length; irregular triangles with their vertices on the tube, and ribbed bars, to 0.05 % of
the diameter and 0.15 % of the length. Where the sides of a polygon are divided, most vertices are within the
circle: the diameter is 5 % (8 sides), 2 % (12) or 0.6 % (24) too small.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.user_files.tubes.tube_centrelines import ring_centreline_m, section_centreline_m
from dataset_builder.user_files.tubes.tube_surface import TubeSurface, feet_on, simplified_m

TOLERANCE = 0.1
"""Largest distance of a vertex from the fitted tube's surface, in diameters: the height of the highest ribs."""

MAX_TRIANGLES = 300_000
"""Largest number of triangles of a part to which a tube is fitted; a ribbed bar of 10 m has about 200,000."""

_MIN_AREA = 1e-8
"""Smallest area of a surface, relative to the square of its extent: that of a bar of 3e8 diameters."""

_MIN_LENGTH = 1.0
"""Smallest length of a bar, in diameters."""

_SMOOTH = 0.015
"""Largest spread of the distances of a smooth bar's vertices from the centreline, relative to the radius."""

_AREA_RANGE = 0.9, 1.4
"""Bounds of the area of the tube's side, relative to that of a smooth cylinder (pentagon: 0.94)."""

_START_AREA_RANGE = 0.6, 2.0
"""Bounds of the first section's area, relative to the estimate from volume and area, which ribs reduce."""

_SIMPLIFY_SMOOTH, _SIMPLIFY_RIBBED = 0.002, 0.06
"""Distance from the centreline, in radii, within which its points are left out."""


@dataclass(frozen=True, eq=False)
class Tube:
    """Round bar: its centreline as a polyline (metres) and its diameter; a hoop ends at its first point."""

    axis_m: Float64[ndarray, "n 3"]
    diameter_m: float


def fit_tube(vertices_m: Float64[ndarray, "v 3"], faces: ndarray) -> Tube | None:
    """Return the tube whose surface the triangles are, in the frame of ``vertices_m``, or None if no tube fits.

    Vertices need not be shared, ends may be open, and the triangles may be wound either way, but consistently.
    """
    if len(faces) > MAX_TRIANGLES:
        return None
    origin_m = vertices_m.mean(axis=0)
    scale_m = float(np.ptp(vertices_m, axis=0).max())
    if not 0 < scale_m < math.inf:
        return None
    # The surface is fitted at unit size, so that no product of small or large lengths loses its value.
    surface = TubeSurface.welded((vertices_m - origin_m) / scale_m, faces)
    if len(surface.faces) < 6 or surface.areas_m2.sum() < _MIN_AREA or not surface.is_connected():
        return None
    with np.errstate(all="ignore"):
        for line_m in _centrelines_m(surface):
            tube = _verified(surface, line_m)
            if tube is not None:
                return Tube(tube.axis_m * scale_m + origin_m, tube.diameter_m * scale_m)
    return None


def _centrelines_m(surface: TubeSurface) -> Iterator[Float64[ndarray, "n 3"]]:
    """Yield the centrelines to be checked, the simplest first."""
    yield _straight_line_m(surface)
    start = _start(surface)
    if start is None:
        return
    point_m, direction, radius_m = start
    rings_m = ring_centreline_m(surface, point_m, direction, radius_m)
    if rings_m is not None and len(rings_m) > 2:
        yield rings_m
    sections = section_centreline_m(surface, point_m, direction, radius_m)
    if sections is not None:
        yield sections


def _straight_line_m(surface: TubeSurface) -> Float64[ndarray, "2 3"]:
    """Return the line through the centroid of the surface along its longest direction, as long as the surface.

    It points towards the positive side of its dominant axis. The triangles, not the vertices, are averaged, so
    that the line does not depend on where the surface is finely divided.
    """
    weight = surface.areas_m2 / surface.areas_m2.sum()
    centroid_m = weight @ surface.corners_m.mean(axis=1)
    offset_m = surface.corners_m - centroid_m
    total_m = offset_m.sum(axis=1)
    # The integral of x x^T over a triangle is area/12 (sum of v v^T over its corners + s s^T), with s their sum.
    moment = np.einsum("n,nki,nkj->ij", weight, offset_m, offset_m)
    moment += np.einsum("n,ni,nj->ij", weight, total_m, total_m)
    direction = np.linalg.eigh(moment)[1][:, -1]
    direction = direction if direction[np.argmax(np.abs(direction))] > 0 else -direction
    along_m = offset_m @ direction
    return np.stack([centroid_m + along_m.min() * direction, centroid_m + along_m.max() * direction])


def _start(surface: TubeSurface) -> tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"], float] | None:
    """Return a point of the side of the tube, the unit direction there and the approximate radius, or None.

    The middle of the longest edge is tried first, which is between two rings if there are any; then those of edges
    that are spread over the surface, since the longest edge may be on a cap.
    """
    radius_m = 2 * surface.volume_m3 / surface.areas_m2.sum()  # Exact for a tube, also bent.
    if not radius_m > 0:
        return None
    ends_m = surface.vertices_m[surface.edges]
    longest = int(np.linalg.norm(ends_m[:, 1] - ends_m[:, 0], axis=1).argmax())
    for edge in (longest, *(np.array([0.5, 0.3, 0.7]) * len(ends_m)).astype(int)):
        point_m = ends_m[edge].mean(axis=0)
        direction = _direction_at(surface, point_m, radius_m)
        cut = surface.cut(point_m, direction, radius_m)
        if cut is not None and _START_AREA_RANGE[0] < cut.area_m2 / (np.pi * radius_m**2) < _START_AREA_RANGE[1]:
            return point_m, direction, radius_m
    return None


def _direction_at(
    surface: TubeSurface, point_m: Float64[ndarray, " 3"], radius_m: float
) -> Float64[ndarray, " 3"]:
    """Return the unit direction of the tube at a point of its side.

    The first estimate is the direction to which the normals of the triangles around are most nearly perpendicular,
    the next ones that between the middles of two sections.
    """
    near_edge = np.linalg.norm(surface.vertices_m[surface.edges].mean(axis=1) - point_m, axis=1) < 3 * radius_m
    direction = _least_normal(surface, np.flatnonzero(near_edge[surface.face_edges].any(axis=1)))
    for _ in range(2):
        step_m = radius_m * direction
        behind = surface.cut(point_m - step_m, direction, 1.5 * radius_m)
        ahead = surface.cut(point_m + step_m, direction, 1.5 * radius_m)
        if behind is None or ahead is None:
            break
        chord_m = ahead.centre_m - behind.centre_m
        direction = chord_m / np.linalg.norm(chord_m)
    return direction


def _least_normal(surface: TubeSurface, faces: Int64[ndarray, " k"]) -> Float64[ndarray, " 3"]:
    """Return the unit direction to which the normals of ``faces``, weighted by area, are most perpendicular."""
    normals = surface.area_vectors_m2[faces] / np.sqrt(surface.areas_m2[faces, None])
    return np.asarray(np.linalg.eigh(normals.T @ normals)[1][:, 0])


def _verified(surface: TubeSurface, line_m: Float64[ndarray, "n 3"]) -> Tube | None:
    """Return the tube along a centreline if the whole surface is that of a round bar (see the module), or None."""
    lengths_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    length_m = float(lengths_m.sum())
    if not (np.isfinite(length_m) and lengths_m.min() > 0):
        return None
    # Each vertex counts with the area around it, so that bends, which have many rings, do not outweigh legs.
    weight = np.bincount(surface.faces.ravel(), np.repeat(surface.areas_m2, 3), len(surface.vertices_m))
    feet = feet_on(line_m, surface.vertices_m)
    rough_m = _weighted_median(feet.distance_m, weight)
    lateral = ~feet.on_cap(rough_m)
    if not lateral.any() or length_m < 2 * _MIN_LENGTH * rough_m:
        return None
    radius_m = _weighted_median(feet.distance_m[lateral], weight[lateral])
    spread_m = np.average(np.abs(feet.distance_m[lateral] - radius_m), weights=weight[lateral])
    if spread_m > 2 * TOLERANCE * radius_m:
        return None  # Some vertices are even farther away, so the check of all of them is not needed.
    is_smooth = bool(spread_m < _SMOOTH * radius_m)
    if not is_smooth:
        radius_m = math.sqrt(surface.volume_m3 / (math.pi * length_m))
    if not _is_tube(surface, line_m, radius_m, length_m):
        return None
    slack_m = radius_m * (_SIMPLIFY_SMOOTH if is_smooth else _SIMPLIFY_RIBBED)
    return Tube(simplified_m(line_m, slack_m), 2 * radius_m)


def _is_tube(surface: TubeSurface, line_m: Float64[ndarray, "n 3"], radius_m: float, length_m: float) -> bool:
    """Return whether the surface is everywhere at ``radius_m`` from the line, closed around it, and as long."""
    a_m, b_m, c_m = surface.corners_m.transpose(1, 0, 2)
    ends_m = surface.vertices_m[surface.edges.T]
    feet = feet_on(line_m, np.concatenate([surface.vertices_m, ends_m.sum(axis=0) / 2, (a_m + b_m + c_m) / 3]))
    on_cap = feet.on_cap(radius_m)
    off_m = np.abs(feet.distance_m - radius_m)
    if not (on_cap | (off_m <= 2 * TOLERANCE * radius_m)).all() or not feet.reach_ends(radius_m):
        return False
    side_m2 = surface.areas_m2[~on_cap[-len(surface.faces) :]].sum()
    low, high = _AREA_RANGE
    return bool(low < side_m2 / (2 * math.pi * radius_m * length_m) < high)


def _weighted_median(values: Float64[ndarray, " n"], weight: Float64[ndarray, " n"]) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])
