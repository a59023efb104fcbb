"""Judged parts of a view: visible straight segments of bars, pairs of them, and crossings, with their pixels.

Determined from the ground truth of the left eye alone. Frame: the camera's (OpenCV axes), metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import Rows
from rebar_depth_bench.bar_crossings.definition import TiePoints
from rebar_depth_bench.extended.axes import WINDOW_DIAMETERS, Axis, CageTruth, is_on_surface
from rebar_depth_bench.extended.steel import JudgedCrossings, SteelTruth
from rebar_depth_bench.geometry.cameras import fold_radius, project, transform

MIN_PIXELS = 30
"""Minimum number of interior pixels of a judged segment."""

MIN_VISIBLE_DIAMETERS = 3.0
"""Minimum length along the axis from a judged segment's first interior pixel to its last, in diameters."""

MAX_SAMPLES = 64
"""Maximum number of interior pixels that a segment is judged on, evenly spread."""

LINE_SAMPLES = 32
"""Number of points of the visible part of a bowed axis, evenly spread, that a line is fitted to."""

MIN_DIAMETER_FIT_WIDTH_PX = 8.0
"""Minimum apparent width (f d / z) in pixels of a bar whose diameter is measured."""

FLANK_RADII_AND_SHARE = (0.4, 0.1)
"""Further condition for a diameter measurement: the bar is visible on both sides.

At least this share (second value) of the sampled pixels lies beyond this many radii (first value) of the axis on
either side.
"""

_GOLDEN = (np.sqrt(5.0) - 1) / 2
"""Golden ratio minus 1."""


@dataclass(frozen=True, eq=False)
class VisibleSegments(Rows):
    """The r judged segments of a view, each sampled at up to k pixels.

    ``segment`` holds indices of segments of ``CageTruth``, or of crossings. ``match_radius_m`` is the distance
    within which a fitted axis belongs to the segment. ``middle_m`` is the axis point in the middle of the visible
    part, ``half_m`` half the length of that part. ``frame`` holds three unit vectors: across the line of sight,
    away from the camera, along the axis. ``pixels`` are positions in the arrays of ``SteelTruth``, ``used`` marks
    which of the k places hold one, ``rays`` are the pixels' rays in ``frame`` per metre of planar depth: see
    ``local_points_m``. ``truth_m`` are the true points in ``frame``, from ``middle_m``. ``can_fit_diameter`` marks
    the segments whose diameter can be measured: wide enough in the image, and visible on both sides of the axis.
    """

    segment: Int64[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]
    match_radius_m: Float64[ndarray, " r"]
    middle_m: Float64[ndarray, "r 3"]
    half_m: Float64[ndarray, " r"]
    frame: Float64[ndarray, "r 3 3"]
    pixels: Int64[ndarray, "r k"]
    used: Bool[ndarray, "r k"]
    rays: Float64[ndarray, "r k 3"]
    truth_m: Float64[ndarray, "r k 3"]
    can_fit_diameter: Bool[ndarray, " r"]

    def local_points_m(self, depth_m: Float64[ndarray, "r k"]) -> Float64[ndarray, "r k 3"]:
        """Return the points at planar ``depth_m`` on the rays of ``pixels``, in ``frame`` from ``middle_m``."""
        middle_m = np.einsum("rij,rj->ri", self.frame, self.middle_m)
        return np.asarray(depth_m[..., None] * self.rays - middle_m[:, None])


def visible_segments(truth: SteelTruth) -> VisibleSegments:
    """Return the judged segments of a view and their sampled pixels.

    Judged are segments with at least ``MIN_PIXELS`` interior pixels that extend over at least
    ``MIN_VISIBLE_DIAMETERS``. A bar may be bowed: the axis of a segment is the line that fits its visible part.
    """
    cage, rotation = truth.bars.cage, truth.cam_from_world[:3, :3]
    segment, pixels, used = _sampled_pixels(truth)
    vector_m = cage.end_m[segment] - cage.start_m[segment]
    direction = vector_m / np.linalg.norm(vector_m, axis=1, keepdims=True)
    point_m = cage.start_m[segment]
    seen = _visible_parts(truth, segment, pixels, used, point_m, direction)
    middle_m = np.einsum("ri,ri->r", (seen.middle_m - truth.cam_from_world[:3, 3]) @ rotation - point_m, direction)
    for row, line_m in enumerate(cage.line_m[one] for one in segment.tolist()):
        if len(line_m) > 2:
            along_m = middle_m[row] + seen.half_m[row] * np.linspace(-1, 1, LINE_SAMPLES)
            places_m = (line_m - point_m[row]) @ direction[row]
            shown_m = np.column_stack([np.interp(along_m, places_m, column) for column in line_m.T])
            point_m[row] = shown_m.mean(axis=0)
            main = np.linalg.svd(shown_m - point_m[row])[2][0]
            direction[row] = main if main @ direction[row] > 0 else -main
    visible = _visible_parts(truth, segment, pixels, used, point_m, direction)
    return visible.of(2 * seen.half_m >= MIN_VISIBLE_DIAMETERS * seen.diameter_m)


def _visible_parts(
    truth: SteelTruth,
    segment: Int64[ndarray, " r"],
    pixels: Int64[ndarray, "r k"],
    used: Bool[ndarray, "r k"],
    point_m: Float64[ndarray, "r 3"],
    direction: Float64[ndarray, "r 3"],
) -> VisibleSegments:
    """Return the visible parts of segments by the point and the direction of an axis, world."""
    return visible_parts(
        truth,
        pixels,
        used,
        segment=segment,
        diameter_m=truth.bars.cage.diameter_m[segment],
        match_radius_m=truth.bars.cage.match_radius_m[segment],
        point_m=transform(truth.cam_from_world, point_m),
        direction=direction @ truth.cam_from_world[:3, :3].T,
    )


def visible_parts(
    truth: SteelTruth,
    pixels: Int64[ndarray, "r k"],
    used: Bool[ndarray, "r k"],
    *,
    segment: Int64[ndarray, " r"],
    diameter_m: Float64[ndarray, " r"],
    match_radius_m: Float64[ndarray, " r"],
    point_m: Float64[ndarray, "r 3"],
    direction: Float64[ndarray, "r 3"],
) -> VisibleSegments:
    """Return the visible part of each straight axis as its ``pixels`` show it.

    ``pixels`` are positions in the arrays of ``truth``. An axis is given by a point and its unit direction, camera
    frame.
    """
    rays = np.concatenate([truth.rays.take(pixels, axis=0), np.ones((*pixels.shape, 1))], axis=-1)
    depth_m = truth.depth_m.take(pixels).astype(np.float64)
    start_along_m = np.einsum("ri,ri->r", point_m, direction)
    along_m = depth_m * (rays @ direction[..., None])[..., 0] - start_along_m[:, None]
    low_m = np.where(used, along_m, np.inf).min(axis=1, initial=np.inf)
    high_m = np.where(used, along_m, -np.inf).max(axis=1, initial=-np.inf)
    middle_m = point_m + ((low_m + high_m) / 2)[:, None] * direction
    frame = _frames(middle_m, direction)
    local_rays = rays @ frame.transpose(0, 2, 1)
    truth_m = depth_m[..., None] * local_rays - np.einsum("rij,rj->ri", frame, middle_m)[:, None]
    is_wide = truth.K[0, 0] * diameter_m >= MIN_DIAMETER_FIT_WIDTH_PX * middle_m[:, 2]
    radii, share = FLANK_RADII_AND_SHARE
    across_m, flank_m = truth_m[..., 0], (radii * diameter_m / 2)[:, None]
    left, right = ((used & beyond).sum(axis=1) for beyond in (across_m < -flank_m, across_m > flank_m))
    can_fit_diameter = is_wide & (np.minimum(left, right) >= share * used.sum(axis=1))
    return VisibleSegments(
        segment, diameter_m, match_radius_m, middle_m, (high_m - low_m) / 2, frame, pixels, used, local_rays,
        truth_m, can_fit_diameter,
    )  # fmt: skip


def _sampled_pixels(truth: SteelTruth) -> tuple[Int64[ndarray, " r"], Int64[ndarray, "r k"], Bool[ndarray, "r k"]]:
    """Return the segments with enough interior pixels, and up to ``MAX_SAMPLES`` pixels of each, evenly spread."""
    candidates = np.flatnonzero(truth.interior & (truth.run >= 0))
    segments = truth.run.take(candidates)
    by_segment = candidates.take(np.argsort(segments, kind="stable"))
    counts = np.bincount(segments)
    segment = np.flatnonzero(counts >= MIN_PIXELS)
    first = (np.cumsum(counts) - counts)[segment]
    total = counts[segment][:, None]
    slot = np.arange(MAX_SAMPLES)
    used = slot < total
    chosen = np.where(total > MAX_SAMPLES, spread(total, MAX_SAMPLES), np.where(used, slot, 0))
    return segment, by_segment.take(first[:, None] + chosen), used


def spread(total: int | Int64[ndarray, "r 1"], count: int) -> Int64[ndarray, " *k"]:
    """Return ``count`` of ``total`` positions, evenly spread.

    Regular strides can coincide with ribs or with the width of a bar, and sample a single column of it. Multiples
    of the golden ratio avoid such resonance.
    """
    return np.asarray(np.floor(total * ((np.arange(count) + 0.5) * _GOLDEN % 1.0)), dtype=np.int64)


def _frames(middle_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]) -> Float64[ndarray, "r 3 3"]:
    """Return orthogonal unit vectors across the line of sight, away from the camera and along the axis."""
    away = middle_m - np.einsum("ri,ri->r", middle_m, direction)[:, None] * direction
    away_norm = np.linalg.norm(away, axis=1)
    # For an axis that points at the camera every perpendicular direction is equivalent.
    any_side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=1)])
    away = np.where((away_norm > 1e-9)[:, None], away, any_side)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([np.cross(away, direction), away, direction], axis=1)


# Pairs of neighbours.

MIN_VISIBLE_OVERLAP_DIAMETERS = 2.0
"""Minimum overlap of the visible parts of a judged pair along the axis, in larger diameters."""


@dataclass(frozen=True, eq=False)
class VisiblePairs(Rows):
    """Neighbouring segments that are both visible, side by side: two positions among the visible segments.

    ``middle_m`` and ``normal`` define the plane that is intersected with both axes.
    """

    segments: Int64[ndarray, "m 2"]
    middle_m: Float64[ndarray, "m 3"]
    normal: Float64[ndarray, "m 3"]

    def intersections_m(
        self, point_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]
    ) -> Float64[ndarray, "2 m 3"]:
        """Return the intersections of the planes with the axes of both segments, of the r visible ones."""
        at_m = []
        for segment in self.segments.T:
            to_plane_m = np.einsum("mi,mi->m", self.middle_m - point_m[segment], self.normal)
            rate = np.einsum("mi,mi->m", direction[segment], self.normal)
            at_m.append(point_m[segment] + (to_plane_m / rate)[:, None] * direction[segment])
        return np.asarray(at_m)


def visible_pairs(visible: VisibleSegments, cage: CageTruth) -> VisiblePairs:
    """Return the neighbour pairs whose segments are both visible and overlap along the first one's axis."""
    position = np.full(len(cage), -1)
    position[visible.segment] = np.arange(len(visible.segment))
    segments = position[cage.neighbours]
    segments = segments[(segments >= 0).all(axis=1)]
    first, second = segments.T
    normal = visible.frame[first, 2]
    between_m = np.einsum("mi,mi->m", visible.middle_m[second] - visible.middle_m[first], normal)
    low_m = np.maximum(-visible.half_m[first], between_m - visible.half_m[second])
    high_m = np.minimum(visible.half_m[first], between_m + visible.half_m[second])
    overlapping = high_m - low_m >= MIN_VISIBLE_OVERLAP_DIAMETERS * np.maximum(
        visible.diameter_m[first], visible.diameter_m[second]
    )
    middle_m = visible.middle_m[first] + ((low_m + high_m) / 2)[:, None] * normal
    return VisiblePairs(segments, middle_m, normal).of(overlapping)


# Crossings that a view can be judged by.

SAMPLED_PIXELS = MIN_PIXELS
"""Number of pixels of each bar that are fitted at a crossing, spread evenly along it."""

MAX_SURFACE_DIAMETERS = 3.0
"""Largest distance of a judged crossing's tie point from the surface at its pixel, in diameters of the larger bar.

A bar that bends or is long can hide its own crossing.
"""


def judged_crossings(truth: SteelTruth) -> JudgedCrossings:
    """Return the judged crossings of a view, and the sampled pixels of both bars of each.

    A crossing is judged if the pixel of its tie point shows one of its bars, at a surface within
    ``MAX_SURFACE_DIAMETERS`` of the tie point, and if each bar has at least ``MIN_PIXELS`` single-bar interior
    pixels on its side within ``WINDOW_DIAMETERS`` along its axis, on both sides of the crossing and over
    ``MIN_VISIBLE_DIAMETERS`` or more. Measures of depth further need both bars to be straight there
    (``SceneCrossings.straight``).
    """
    scene = truth.bars.crossings
    tie_point_m = transform(truth.cam_from_world, scene.crossings.tie_point_m)
    pixel = shown_pixels(truth, tie_point_m)
    shown = np.flatnonzero(pixel >= 0)
    pixel = pixel[shown]
    rays = np.column_stack([truth.rays[pixel], np.ones(len(pixel))])
    surface_m = truth.depth_m[pixel].astype(np.float64)[:, None] * rays
    distance_m = np.linalg.norm(surface_m - tie_point_m[shown], axis=1)
    is_there = distance_m <= MAX_SURFACE_DIAMETERS * scene.diameter_m[shown].max(axis=1)
    shows_bar = (truth.bar_id[pixel][:, None] == scene.bar_id[shown]).any(axis=1)
    candidates = shown[is_there & shows_bar]
    by_bar = np.flatnonzero(truth.single_bar)
    by_bar = by_bar[np.argsort(truth.bar_id[by_bar], kind="stable")]
    bar_id = truth.bar_id[by_bar]
    on_side = {}
    for bar in np.unique(scene.bar_id[candidates]).tolist():
        first, last = np.searchsorted(bar_id, [bar, bar + 1])
        on_side[bar] = _on_side(truth, by_bar[first:last], scene.axes[bar])
    judged, pixels = [], []
    for crossing in candidates.tolist():
        bars = zip(scene.bar_id[crossing].tolist(), scene.along_m[crossing].tolist(), strict=True)
        sides = [_near_crossing(*on_side[bar], scene.axes[bar], along_m) for bar, along_m in bars]
        if all(len(side) for side in sides):
            judged.append(crossing)
            pixels.append(sides)
    return JudgedCrossings(
        np.array(judged, dtype=np.int64), np.array(pixels, dtype=np.int64).reshape(-1, 2, SAMPLED_PIXELS)
    )


def _on_side(
    truth: SteelTruth, pixels: Int64[ndarray, " n"], axis: Axis
) -> tuple[Int64[ndarray, " n"], Float64[ndarray, " n"]]:
    """Return the pixels of a bar that are on its side, and their places along its axis, metres."""
    rays = np.column_stack([truth.rays[pixels], np.ones(len(pixels))])
    camera_m = truth.depth_m[pixels].astype(np.float64)[:, None] * rays
    rotation, shift_m = truth.cam_from_world[:3, :3], truth.cam_from_world[:3, 3]
    along_m, distance_m = axis.feet((camera_m - shift_m) @ rotation)
    on_side = is_on_surface(distance_m, axis.diameter_m.item())
    return pixels[on_side], along_m[on_side]


def _near_crossing(
    pixels: Int64[ndarray, " n"], along_m: Float64[ndarray, " n"], axis: Axis, crossing_m: float
) -> Int64[ndarray, " k"]:
    """Return the sampled pixels of a bar near its crossing, none if they do not suffice to judge it.

    ``along_m`` are the places of the pixels along the axis, and ``crossing_m`` is the place of the crossing.
    """
    relative_m = axis.relative_m(along_m, crossing_m)
    near = np.flatnonzero(np.abs(relative_m) <= WINDOW_DIAMETERS * axis.diameter_m)
    if len(near) < MIN_PIXELS:
        return np.empty(0, np.int64)
    low_m, high_m = relative_m[near].min(), relative_m[near].max()
    if not low_m < 0 < high_m or high_m - low_m < MIN_VISIBLE_DIAMETERS * axis.diameter_m:
        return np.empty(0, np.int64)
    ordered = near[np.argsort(relative_m[near], kind="stable")]
    return np.asarray(pixels[ordered[spread(len(ordered), SAMPLED_PIXELS)]])


def shown_pixels(truth: SteelTruth, points_m: Float64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    """Return the nearest pixel of each point (camera frame, metres) as a position in the arrays of ``truth``.

    It is -1 where that pixel is not among them, outside of the image and behind the camera.
    """
    positions = np.full(len(points_m), -1, np.int64)
    in_front = points_m[:, 2] > 0
    with np.errstate(over="ignore"):  # Points almost in the plane of the camera are outside of the image.
        ray = points_m[:, :2] / np.where(in_front, points_m[:, 2], 1.0)[:, None]
    in_front &= np.linalg.norm(ray, axis=1) < fold_radius(truth.distortion)
    pixel = np.floor(project(truth.K, points_m[in_front], truth.distortion) + 0.5)
    size = np.array([truth.width, truth.height])
    inside = ((pixel >= 0) & (pixel < size)).all(axis=1)
    flat = pixel[inside, 1].astype(np.int64) * truth.width + pixel[inside, 0].astype(np.int64)
    position = np.minimum(np.searchsorted(truth.index, flat), max(len(truth.index) - 1, 0))
    known = (truth.index[position] == flat) if len(truth.index) else np.zeros(len(flat), bool)
    positions[np.flatnonzero(in_front)[inside][known]] = position[known]
    return positions


# Crossings that depth is judged at.


@dataclass(frozen=True, eq=False)
class ViewCrossings:
    """The m crossings of a view on which depth is judged: judged ones between bars that are straight there.

    ``crossing`` holds indices into the scene's crossings. ``visible`` are the parts of bar a and bar b of the
    first crossing, then of the second, and so on. ``ties`` are the true tie points in the camera frame.
    """

    crossing: Int64[ndarray, " m"]
    visible: VisibleSegments
    ties: TiePoints

    @property
    def radius_m(self) -> Float64[ndarray, "m 2"]:
        """Radii of bar a and bar b."""
        return np.asarray(self.visible.diameter_m.reshape(-1, 2) / 2)


def view_crossings(truth: SteelTruth) -> ViewCrossings:
    """Return the crossings of a view on which depth is judged."""
    scene = truth.bars.crossings
    straight = scene.straight[truth.judged.crossing].all(axis=1)
    crossing, pixels = truth.judged.crossing[straight], truth.judged.pixels[straight]
    pixels = pixels.reshape(2 * len(crossing), pixels.shape[2])
    rotation = truth.cam_from_world[:3, :3]
    visible = visible_parts(
        truth,
        pixels,
        np.ones(pixels.shape, dtype=bool),
        segment=np.repeat(crossing, 2),
        diameter_m=scene.diameter_m[crossing].ravel(),
        match_radius_m=scene.match_radius_m[crossing].ravel(),
        point_m=transform(truth.cam_from_world, scene.point_m[crossing].reshape(-1, 3)),
        direction=scene.tangent[crossing].reshape(-1, 3) @ rotation.T,
    )
    found = scene.crossings
    ties = TiePoints(
        transform(truth.cam_from_world, found.tie_point_m[crossing]),
        found.normal[crossing] @ rotation.T,
        found.gap_m[crossing],
        found.angle_deg[crossing],
    )
    return ViewCrossings(crossing, visible, ties)
