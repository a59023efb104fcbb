"""Samples of the steel of a view: fitted bars, spacings of neighbours, and crossings, beside the true ones.

A cylinder of the nominal diameter is fitted to each judged bar, and to both bars of each judged crossing. All
measures of bars and crossings, and the working ranges of tasks, are statistics of these samples. What is judged
depends on the ground truth alone: a sample that is judged and was not found is a failure.

Each view is sampled at three depths: as predicted; exact; and a plane, one constant in each view, which is what a
method without any knowledge of the steel can know: the median true distance of the judged bars, or ties, less the
radius. Each of them is taken native and aligned by a laser, which reads the true depth of the centre pixel.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from statistics import NormalDist
from typing import Any, TypeVar, cast

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import Rows
from rebar_depth_bench.bar_crossings.definition import tie_points
from rebar_depth_bench.extended.as_built import DesignedSegments, across, designed_segments
from rebar_depth_bench.extended.cover import fit_planes, plane_distances_m
from rebar_depth_bench.extended.fits import FittedAxes, fit_axes
from rebar_depth_bench.extended.judged import (
    ViewCrossings,
    VisiblePairs,
    VisibleSegments,
    view_crossings,
    visible_pairs,
    visible_segments,
)
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

LASER_SIGMA_M = 0.001
"""Standard deviation of the reading of a laser."""

_MM = 1000.0

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class _Samples(Rows):
    """Parallel arrays with a row per sample; ``view`` is the position of its view in the frame of the config."""

    view: Int64[ndarray, " n"]

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True, eq=False)
class BarSamples(_Samples):
    """Judged straight segments of bars.

    ``segment`` is the index of the segment among all straight ones of the scene. ``distance_m`` is the true
    planar depth of the axis in the middle of the visible part, and ``width_px`` the apparent width of the bar
    there. ``pixels`` is the number of pixels that the fit used. All that is measured is NaN unless ``found``.
    ``point_m`` and ``direction`` (unit) are the fitted axis, world. ``offset_mm`` is the distance of the fitted
    axis from that middle, ``tilt_deg`` its angle with the true axis, and ``depth_offset_mm`` how much farther it
    is along the optical axis. ``diameter_mm`` is judged where ``diameter_judged``: the bar is wide enough in the
    image, and visible on both sides of the axis.

    ``true_cover_mm`` is NaN where no cover is judged, and ``true_deviation_mm``, the distance of the axis as built
    from the nominal one, without a design. ``deviation_mm`` is that of the fitted axis, and ``deviation_error_mm``
    the length of the difference of the two vectors.
    """

    bar_id: Int64[ndarray, " n"]
    segment: Int64[ndarray, " n"]
    distance_m: Float64[ndarray, " n"]
    true_diameter_mm: Float64[ndarray, " n"]
    width_px: Float64[ndarray, " n"]
    pixels: Int64[ndarray, " n"]
    found: Bool[ndarray, " n"]
    point_m: Float64[ndarray, "n 3"]
    direction: Float64[ndarray, "n 3"]
    offset_mm: Float64[ndarray, " n"]
    tilt_deg: Float64[ndarray, " n"]
    diameter_judged: Bool[ndarray, " n"]
    diameter_mm: Float64[ndarray, " n"]
    depth_offset_mm: Float64[ndarray, " n"]
    true_cover_mm: Float64[ndarray, " n"]
    cover_mm: Float64[ndarray, " n"]
    true_deviation_mm: Float64[ndarray, " n"]
    deviation_mm: Float64[ndarray, " n"]
    deviation_error_mm: Float64[ndarray, " n"]


@dataclass(frozen=True, eq=False)
class SpacingSamples(_Samples):
    """Pairs of judged neighbours: the bars, and their ``segment`` in ``BarSamples``.

    Both axes are intersected with the plane perpendicular to the first one in the middle of the part where both
    are visible; ``distance_m`` is the true planar depth in the middle of the intersections. ``spacing_mm`` is the
    fitted separation of the intersections along the true direction between them, NaN if a bar was not found.
    """

    bar_a: Int64[ndarray, " n"]
    bar_b: Int64[ndarray, " n"]
    segment_a: Int64[ndarray, " n"]
    segment_b: Int64[ndarray, " n"]
    distance_m: Float64[ndarray, " n"]
    true_spacing_mm: Float64[ndarray, " n"]
    spacing_mm: Float64[ndarray, " n"]


@dataclass(frozen=True, eq=False)
class CrossingSamples(_Samples):
    """Judged crossings; ``distance_m`` is the true planar depth of the tie point.

    All that is measured is NaN unless both bars were ``found``. ``tie_error_mm`` is the distance of the fitted tie
    point from the true one. Along the optical axis, it is ``tie_along_mm`` farther from the camera; across it,
    ``tie_across_mm`` away. ``layer_mm`` is the distance of the two axes along the normal of the crossing.
    """

    crossing_id: Int64[ndarray, " n"]
    bar_a: Int64[ndarray, " n"]
    bar_b: Int64[ndarray, " n"]
    distance_m: Float64[ndarray, " n"]
    true_angle_deg: Float64[ndarray, " n"]
    found: Bool[ndarray, " n"]
    tie_error_mm: Float64[ndarray, " n"]
    tie_along_mm: Float64[ndarray, " n"]
    tie_across_mm: Float64[ndarray, " n"]
    true_layer_mm: Float64[ndarray, " n"]
    layer_mm: Float64[ndarray, " n"]
    angle_deg: Float64[ndarray, " n"]


@dataclass(frozen=True, eq=False)
class SteelSamples:
    """Samples of one depth of a view, or of the views of a config."""

    bars: BarSamples
    spacings: SpacingSamples
    crossings: CrossingSamples


@dataclass(frozen=True, eq=False)
class AlignedSamples:
    """Samples of the predicted depth, of exact depth and of the plane, with one alignment."""

    predicted: SteelSamples
    exact: SteelSamples
    plane: SteelSamples


@dataclass(frozen=True, eq=False)
class SteelFrames:
    """Samples of a view, or of the views of a config: native, and aligned by one laser reading in each view.

    ``laser`` has the ``laser_views``, those with true depth at the centre pixel. In ``unread_views`` of them, the
    prediction has none there, so that nothing is found. The rows of all depths of an alignment are the same.
    """

    native: AlignedSamples
    laser: AlignedSamples
    laser_views: int
    unread_views: int


def joined(parts: Sequence[_T]) -> _T:
    """Return all parts, one or more of one type, as one: arrays in order, numbers added, dataclasses by field."""
    some: Sequence[Any] = parts
    whole: Any
    if isinstance(some[0], np.ndarray):
        whole = np.concatenate(some)
    elif isinstance(some[0], int):
        whole = sum(some)
    else:
        whole = type(some[0])(*(joined([getattr(part, one.name) for part in some]) for one in fields(some[0])))
    return cast("_T", whole)


@dataclass(frozen=True, eq=False)
class _Judged:
    """What is judged of a view, whose place among the views of its config is ``position``."""

    truth: SteelTruth
    position: int
    visible: VisibleSegments
    pairs: VisiblePairs
    designed: DesignedSegments
    crossings: ViewCrossings


def steel_frames(prediction_m: Float[ndarray, "h w"], truth: SteelTruth, position: int) -> SteelFrames:
    """Return the samples of a view, whose ``position`` among the views of its config they get.

    ``prediction_m`` is planar depth in metres as submitted.
    """
    visible = visible_segments(truth)
    judged = _Judged(
        truth,
        position,
        visible,
        visible_pairs(visible, truth.bars.cage),
        designed_segments(truth, visible),
        view_crossings(truth),
    )
    predicted_m, exact_m = truth.predicted_m(prediction_m), truth.depth_m.astype(np.float64)
    forms_m = prediction_m.ravel().take(truth.covers.pixels).astype(np.float64)
    exact_forms_m = truth.covers.depth_m.astype(np.float64)
    fronts_m = visible.middle_m[:, 2] - visible.diameter_m / 2
    ties_m = judged.crossings.ties.tie_point_m[:, 2] - judged.crossings.radius_m.mean(axis=1)
    bar_plane_m, tie_plane_m = (np.median(some_m) if len(some_m) else np.nan for some_m in (fronts_m, ties_m))

    native = AlignedSamples(
        _steel_samples(judged, predicted_m, forms_m, predicted_m),
        _steel_samples(judged, exact_m, exact_forms_m, exact_m),
        _steel_samples(
            judged,
            np.full_like(exact_m, bar_plane_m),
            np.full_like(exact_forms_m, bar_plane_m),
            np.full_like(exact_m, tie_plane_m),
        ),
    )
    if not truth.centre_depth_m > 0:
        none, some = np.empty(0, np.int64), native.exact
        nothing = SteelSamples(some.bars.of(none), some.spacings.of(none), some.crossings.of(none))
        return SteelFrames(native, AlignedSamples(nothing, nothing, nothing), 0, 0)
    reading_m = laser_reading_m(truth.view_id, truth.centre_depth_m)
    centre_m = float(prediction_m[truth.height // 2, truth.width // 2])
    is_read = bool(is_valid_prediction(np.array(centre_m)))
    factor, exact_factor = reading_m / centre_m if is_read else np.nan, reading_m / truth.centre_depth_m
    with np.errstate(over="ignore", invalid="ignore"):
        scaled_m, scaled_forms_m = factor * predicted_m, factor * forms_m
    plane_m = np.full_like(exact_m, reading_m)
    laser = AlignedSamples(
        _steel_samples(judged, scaled_m, scaled_forms_m, scaled_m),
        _steel_samples(judged, exact_factor * exact_m, exact_factor * exact_forms_m, exact_factor * exact_m),
        _steel_samples(judged, plane_m, np.full_like(exact_forms_m, reading_m), plane_m),
    )
    return SteelFrames(native, laser, 1, int(not is_read))


def laser_reading_m(view_id: str, depth_m: float) -> float:
    """Return a reading of a planar depth, with normal noise that follows from the id of the view.

    Raw PCG64 output does not change between NumPy versions.
    """
    seed = int.from_bytes(hashlib.sha256(view_id.encode()).digest()[:8], "little")
    uniform = (int(np.random.PCG64(seed).random_raw()) // 2**11 + 0.5) / 2**53
    return depth_m + LASER_SIGMA_M * NormalDist().inv_cdf(uniform)


def _steel_samples(
    judged: _Judged,
    bars_m: Float64[ndarray, " n"],
    forms_m: Float64[ndarray, "r k"],
    ties_m: Float64[ndarray, " n"],
) -> SteelSamples:
    """Return the samples of one depth: for bars and for crossings on the pixels of the truth, and of the forms."""
    fitted = fit_axes(bars_m, judged.visible, diameters=True)
    return SteelSamples(
        _bar_samples(judged, fitted, forms_m), _spacing_samples(judged, fitted), _crossing_samples(judged, ties_m)
    )


def _bar_samples(judged: _Judged, fitted: FittedAxes, forms_m: Float64[ndarray, "r k"]) -> BarSamples:
    truth, visible, designed = judged.truth, judged.visible, judged.designed
    radius_m, found = visible.diameter_m / 2, fitted.found
    rotation, shift_m = truth.cam_from_world[:3, :3], truth.cam_from_world[:3, 3]
    point_m, direction, offset_m, tilt_deg, diameter_m = (
        np.where(found.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)
        for values in (fitted.point_m, fitted.direction, fitted.offset_m, fitted.tilt_deg, fitted.diameter_m)
    )
    covers, covered = truth.covers, np.searchsorted(visible.segment, truth.covers.segment)
    true_cover_m, cover_m = np.full((2, len(found)), np.nan)
    true_cover_m[covered] = plane_distances_m(covers.plane, visible.middle_m[covered]) - radius_m[covered]
    cover_m[covered] = plane_distances_m(fit_planes(forms_m, covers), point_m[covered]) - radius_m[covered]
    true_deviation_m, deviation_m, deviation_error_m = np.full((3, len(found)), np.nan)
    from_nominal_m = across(point_m[designed.row] - designed.nominal_m, designed.direction)
    true_deviation_m[designed.row] = np.linalg.norm(designed.true_m, axis=1)
    deviation_m[designed.row] = np.linalg.norm(from_nominal_m, axis=1)
    deviation_error_m[designed.row] = np.linalg.norm(from_nominal_m - designed.true_m, axis=1)
    return BarSamples(
        view=np.full(len(found), judged.position),
        bar_id=truth.bars.cage.bar_id[visible.segment],
        segment=visible.segment,
        distance_m=visible.middle_m[:, 2],
        true_diameter_mm=visible.diameter_m * _MM,
        width_px=truth.K[0, 0] * visible.diameter_m / visible.middle_m[:, 2],
        pixels=fitted.pixels,
        found=found,
        point_m=(point_m - shift_m) @ rotation,
        direction=direction @ rotation,
        offset_mm=offset_m * _MM,
        tilt_deg=tilt_deg,
        diameter_judged=visible.can_fit_diameter,
        diameter_mm=diameter_m * _MM,
        depth_offset_mm=(point_m - visible.middle_m)[:, 2] * _MM,
        true_cover_mm=true_cover_m * _MM,
        cover_mm=cover_m * _MM,
        true_deviation_mm=true_deviation_m * _MM,
        deviation_mm=deviation_m * _MM,
        deviation_error_mm=deviation_error_m * _MM,
    )


def _spacing_samples(judged: _Judged, fitted: FittedAxes) -> SpacingSamples:
    visible, pairs = judged.visible, judged.pairs
    true_m = pairs.intersections_m(visible.middle_m, visible.frame[:, 2])
    between_m = true_m[1] - true_m[0]
    spacing_m = np.linalg.norm(between_m, axis=1)
    with np.errstate(all="ignore"):
        fitted_m = pairs.intersections_m(fitted.point_m, fitted.direction)
        measured_m = np.einsum("mi,mi->m", fitted_m[1] - fitted_m[0], between_m / spacing_m[:, None])
    segment = visible.segment[pairs.segments]
    bar_id = judged.truth.bars.cage.bar_id[segment]
    return SpacingSamples(
        view=np.full(len(spacing_m), judged.position),
        bar_a=bar_id[:, 0],
        bar_b=bar_id[:, 1],
        segment_a=segment[:, 0],
        segment_b=segment[:, 1],
        distance_m=true_m[..., 2].mean(axis=0),
        true_spacing_mm=spacing_m * _MM,
        spacing_mm=np.where(fitted.found[pairs.segments].all(axis=1), measured_m * _MM, np.nan),
    )


def _crossing_samples(judged: _Judged, p_m: Float64[ndarray, " n"]) -> CrossingSamples:
    crossings, scene = judged.crossings, judged.truth.bars.crossings
    true, radius_m = crossings.ties, crossings.radius_m
    fitted = fit_axes(p_m, crossings.visible)
    found = fitted.found.reshape(-1, 2).all(axis=1)
    with np.errstate(all="ignore"):
        points_m = _closest_points_m(fitted)
        direction = fitted.direction.reshape(-1, 2, 3)
        ties = tie_points(*points_m, direction[:, 0], direction[:, 1], radius_m, towards=true.normal)
        offset_mm = np.where(found[:, None], (ties.tie_point_m - true.tie_point_m) * _MM, np.nan)
    return CrossingSamples(
        view=np.full(len(found), judged.position),
        crossing_id=crossings.crossing + 1,
        bar_a=scene.bar_id[crossings.crossing, 0],
        bar_b=scene.bar_id[crossings.crossing, 1],
        distance_m=true.tie_point_m[:, 2],
        true_angle_deg=true.angle_deg,
        found=found,
        tie_error_mm=np.linalg.norm(offset_mm, axis=1),
        tie_along_mm=offset_mm[:, 2],
        tie_across_mm=np.hypot(offset_mm[:, 0], offset_mm[:, 1]),
        true_layer_mm=(true.gap_m + radius_m.sum(axis=1)) * _MM,
        layer_mm=np.where(found, (ties.gap_m + radius_m.sum(axis=1)) * _MM, np.nan),
        angle_deg=np.where(found, ties.angle_deg, np.nan),
    )


def _closest_points_m(fitted: FittedAxes) -> tuple[Float64[ndarray, "m 3"], Float64[ndarray, "m 3"]]:
    """Return the points of the fitted axes a and b of each crossing that are closest to each other."""
    point_m, direction = fitted.point_m.reshape(-1, 2, 3), fitted.direction.reshape(-1, 2, 3)
    a, b = direction[:, 0], direction[:, 1]
    between_m = point_m[:, 0] - point_m[:, 1]
    cosine, along_a, along_b = (np.einsum("mi,mi->m", u, v) for u, v in ((a, b), (a, between_m), (b, between_m)))
    determinant = 1 - cosine**2
    step_a = (cosine * along_b - along_a) / determinant
    step_b = (along_b - cosine * along_a) / determinant
    return point_m[:, 0] + step_a[:, None] * a, point_m[:, 1] + step_b[:, None] * b
