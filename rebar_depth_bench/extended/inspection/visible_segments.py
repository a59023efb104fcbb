"""Visible bar segments of a view: those judged by inspection, and the pixels that they are judged on.

Determined from the ground truth alone. Frame: the camera's (OpenCV axes), metres.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.inspection.segments import CageTruth
from rebar_depth_bench.extended.steel_truth import SteelTruth

MIN_PIXELS = 30
"""Minimum number of interior pixels of a judged segment."""

MIN_VISIBLE_DIAMETERS = 3.0
"""Minimum length along the axis from a judged segment's first interior pixel to its last, in diameters."""

MAX_SAMPLES = 64
"""Maximum number of interior pixels that a segment is judged on, evenly spread."""

MIN_DIAMETER_FIT_WIDTH_PX = 8.0
"""Minimum apparent width (f d / z) in pixels of a bar whose diameter is measured."""

FLANK_RADII_AND_SHARE = (0.4, 0.1)
"""Further condition for a diameter measurement: the bar is visible on both sides.

At least this share (second value) of the sampled pixels lies beyond this many radii (first value) of the axis on
either side.
"""

GOLDEN = (np.sqrt(5.0) - 1) / 2
"""Golden ratio minus 1."""


@dataclass(frozen=True, eq=False)
class VisibleSegments:
    """The r judged segments of a view, each sampled at up to k pixels.

    ``segment`` holds indices into ``CageTruth.segments``. ``middle_m`` is the axis point in the middle of the
    visible part, ``half_m`` half the length of that part. ``frame`` holds three unit vectors: across the line of
    sight, away from the camera, along the axis. ``pixels`` are positions in the arrays of ``SteelTruth``,
    ``used`` marks which of the k places hold one, ``rays`` are the pixels' rays in ``frame`` per metre of planar
    depth: see ``local_points_m``. ``truth_m`` are the true points in ``frame``, from ``middle_m``.
    ``can_fit_diameter`` marks the segments whose diameter can be measured.
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

    def of(self, rows: Bool[ndarray, " r"] | Int64[ndarray, " s"]) -> VisibleSegments:
        """Return the selected segments."""
        return VisibleSegments(*(getattr(self, field.name)[rows] for field in fields(self)))

    def local_points_m(self, depth_m: Float64[ndarray, "r k"]) -> Float64[ndarray, "r k 3"]:
        """Return the points at planar ``depth_m`` on the rays of ``pixels``, in ``frame`` from ``middle_m``."""
        middle_m = np.einsum("rij,rj->ri", self.frame, self.middle_m)
        return np.asarray(depth_m[..., None] * self.rays - middle_m[:, None])


def visible_segments(truth: SteelTruth, cage: CageTruth) -> VisibleSegments:
    """Return the judged segments of a view and their sampled pixels.

    Judged are segments with at least ``MIN_PIXELS`` interior pixels that extend over at least
    ``MIN_VISIBLE_DIAMETERS``.
    """
    segment, pixels, used = _sampled_pixels(truth)
    rotation, shift_m = truth.cam_from_world[:3, :3], truth.cam_from_world[:3, 3]
    start_m = cage.start_m[segment] @ rotation.T + shift_m
    axis_m = (cage.end_m[segment] - cage.start_m[segment]) @ rotation.T
    runs = AxisLines(
        segment,
        cage.diameter_m[segment],
        cage.match_radius_m[segment],
        start_m,
        axis_m / np.linalg.norm(axis_m, axis=1, keepdims=True),
    )
    visible = visible_parts(truth, runs, pixels, used)
    return visible.of(2 * visible.half_m >= MIN_VISIBLE_DIAMETERS * visible.diameter_m)


@dataclass(frozen=True, eq=False)
class AxisLines:
    """Straight parts of axes: their bars' diameters, and a point and the unit direction in the camera frame.

    ``segment`` holds indices into ``CageTruth.segments`` or other items, and ``match_radius_m`` is the distance
    within which a fitted axis belongs to the part.
    """

    segment: Int64[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]
    match_radius_m: Float64[ndarray, " r"]
    start_m: Float64[ndarray, "r 3"]
    direction: Float64[ndarray, "r 3"]


def visible_parts(
    truth: SteelTruth, lines: AxisLines, pixels: Int64[ndarray, "r k"], used: Bool[ndarray, "r k"]
) -> VisibleSegments:
    """Return the visible part of each line as its ``pixels`` show it: positions in the arrays of ``truth``."""
    direction = lines.direction
    rays = np.concatenate([truth.rays.take(pixels, axis=0), np.ones((*pixels.shape, 1))], axis=-1)
    depth_m = truth.depth_m.take(pixels).astype(np.float64)
    start_along_m = np.einsum("ri,ri->r", lines.start_m, direction)
    along_m = depth_m * (rays @ direction[..., None])[..., 0] - start_along_m[:, None]
    low_m = np.where(used, along_m, np.inf).min(axis=1, initial=np.inf)
    high_m = np.where(used, along_m, -np.inf).max(axis=1, initial=-np.inf)
    middle_m = lines.start_m + ((low_m + high_m) / 2)[:, None] * direction
    frame = _frames(middle_m, direction)
    local_rays = rays @ frame.transpose(0, 2, 1)
    truth_m = depth_m[..., None] * local_rays - np.einsum("rij,rj->ri", frame, middle_m)[:, None]
    focal_px, diameter_m = float(truth.K[0, 0]), lines.diameter_m
    return VisibleSegments(
        lines.segment, diameter_m, lines.match_radius_m, middle_m, (high_m - low_m) / 2, frame, pixels, used,
        local_rays, truth_m, _can_fit_diameter(truth_m[..., 0], used, diameter_m, focal_px, middle_m[:, 2]),
    )  # fmt: skip


def _sampled_pixels(
    truth: SteelTruth,
) -> tuple[Int64[ndarray, " r"], Int64[ndarray, "r k"], Bool[ndarray, "r k"]]:
    """Return the segments with enough interior pixels, and up to ``MAX_SAMPLES`` pixels of each, evenly spread.

    Regular strides can coincide with the width of a bar and sample a single column of it. Multiples of the golden
    ratio avoid such resonance.
    """
    candidates = np.flatnonzero(truth.interior & (truth.run >= 0))
    segments = truth.run.take(candidates)
    by_segment = candidates.take(np.argsort(segments, kind="stable"))
    counts = np.bincount(segments)
    segment = np.flatnonzero(counts >= MIN_PIXELS)
    first = (np.cumsum(counts) - counts)[segment]
    total = counts[segment][:, None]
    slot = np.arange(MAX_SAMPLES)
    spread = np.floor(total * ((slot + 0.5) * GOLDEN % 1.0)).astype(np.int64)
    used = slot < total
    chosen = np.where(total > MAX_SAMPLES, spread, np.where(used, slot, 0))
    return segment, by_segment.take(first[:, None] + chosen), used


def _frames(middle_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]) -> Float64[ndarray, "r 3 3"]:
    """Return orthogonal unit vectors across the line of sight, away from the camera and along the axis."""
    away = middle_m - np.einsum("ri,ri->r", middle_m, direction)[:, None] * direction
    away_norm = np.linalg.norm(away, axis=1)
    # For an axis that points at the camera every perpendicular direction is equivalent.
    any_side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=1)])
    away = np.where((away_norm > 1e-9)[:, None], away, any_side)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([np.cross(away, direction), away, direction], axis=1)


def _can_fit_diameter(
    across_m: Float64[ndarray, "r k"],
    used: Bool[ndarray, "r k"],
    diameter_m: Float64[ndarray, " r"],
    focal_px: float,
    depth_m: Float64[ndarray, " r"],
) -> Bool[ndarray, " r"]:
    """Return which segments are wide enough in the image and visible on both sides of the axis."""
    radii, share = FLANK_RADII_AND_SHARE
    beyond_m = (radii * diameter_m / 2)[:, None]
    left = (used & (across_m < -beyond_m)).sum(axis=1)
    right = (used & (across_m > beyond_m)).sum(axis=1)
    both_sides_visible = np.minimum(left, right) >= share * used.sum(axis=1)
    return np.asarray((focal_px * diameter_m >= MIN_DIAMETER_FIT_WIDTH_PX * depth_m) & both_sides_visible)
