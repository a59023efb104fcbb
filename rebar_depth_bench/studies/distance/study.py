"""Distance study: scale and error over the distance of the steel, and the slope of the scale.

The paper reports that the scale correction s = median(z) / median(p) "reverses with distance": s is below 1 on the
lattice and above 1 on the pier. If s were a power of the distance, log s would be linear in log distance. The
slope of that line measures how much the correction depends on distance: 0 means that one scale fits all distances,
1 that the prediction is the same at every distance.

Intervals resample blocks of views, or scenes (``scoring.bootstrap``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.extended.crossings.config import ConfigReaches
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample
from rebar_depth_bench.scoring.metrics import DepthMetrics, mean
from rebar_depth_bench.scoring.provenance import Provenance
from rebar_depth_bench.scoring.single_bar import SingleBarScore, mean_single_bar
from rebar_depth_bench.scoring.view_score import ViewScore, resample_views
from rebar_depth_bench.view_ids import split_of

MIN_DISTANCE_RATIO = 1.05
"""Minimum ratio of the farthest to the nearest view distance for which a slope is fitted."""

ALL_CONFIGS = "all"
"""Value of ``ScaleSlope.config`` for the slope over all configs together."""


@dataclass(frozen=True)
class DistancePoint:
    """Score of one view at its distance.

    ``index`` is the index of the view in its full protocol; ``distance_m`` is the median true depth of its scored
    pixels. ``single_bar`` is the score on the single-bar interior.
    """

    config: str
    index: int
    distance_m: float
    score: ViewScore
    single_bar: SingleBarScore


@dataclass(frozen=True)
class IntervalEstimate:
    """Estimate with its 95 % interval.

    ``value`` is None if undefined; ``interval`` is None if undefined or if there are too few views.
    """

    value: float | None
    interval: Interval | None


@dataclass(frozen=True)
class DistanceBin:
    """Statistics of the views of one config whose distance lies in [``low_m``, ``high_m``).

    ``distance_m`` is the median distance of the views. ``scale`` is the median and ``scale_range`` the (minimum,
    maximum) of s over the ``views_scored`` views that have a prediction; the AbsRel values are means over these
    views. ``single_bar`` has the means on the single-bar interior.
    """

    config: str
    low_m: float
    high_m: float
    distance_m: float
    views: int
    views_scored: int
    scale: IntervalEstimate
    scale_range: Interval | None
    native_abs_rel: IntervalEstimate
    scaled_abs_rel: IntervalEstimate
    single_bar: SingleBarScore


@dataclass(frozen=True)
class ScaleSlope:
    """Least-squares slope of log s over log distance.

    ``config`` is the name of a config or ``ALL_CONFIGS``; ``views`` counts the views with a usable scale, whose
    distances lie between ``nearest_m`` and ``farthest_m``.
    """

    config: str
    views: int
    nearest_m: float
    farthest_m: float
    slope: IntervalEstimate


@dataclass(frozen=True)
class DistanceStudy:
    """Result of the distance study.

    ``slopes`` has one slope per config and, if there are several configs, a last one over all configs together.
    ``reaches`` holds the reaches at the crossings of bars, by config with bar ids.
    """

    provenance: Provenance
    bins_per_decade: int
    points: tuple[DistancePoint, ...]
    bins: tuple[DistanceBin, ...]
    slopes: tuple[ScaleSlope, ...]
    reaches: Mapping[str, ConfigReaches]


def bin_views(points: Sequence[DistancePoint], per_decade: int) -> list[DistanceBin]:
    """Return the non-empty bins of the views of one config, nearest first.

    The bin edges are 10^(i / per_decade) metres for integer i.
    """
    grouped: dict[int, list[DistancePoint]] = {}
    for point in points:
        grouped.setdefault(math.floor(math.log10(point.distance_m) * per_decade + 1e-9), []).append(point)
    return [
        _make_bin(grouped[number], 10.0 ** (number / per_decade), 10.0 ** ((number + 1) / per_decade))
        for number in sorted(grouped)
    ]


def fit_scale_slope(name: str, configs: Mapping[str, Sequence[DistancePoint]]) -> ScaleSlope:
    """Fit the slope of log s over log distance to the views of one or more configs with a finite scale > 0.

    For the interval, the views of each config are resampled separately. The value of the slope is None if fewer
    than two views have a scale or if their distances differ by less than a factor of ``MIN_DISTANCE_RATIO``; its
    interval is None if a config has fewer than ``MIN_BLOCKS`` blocks of such views, or scenes.
    """
    usable = [scaled for points in configs.values() if (scaled := [p for p in points if _has_usable_scale(p)])]
    all_points = [point for points in usable for point in points]
    distances_m = [point.distance_m for point in all_points] or [math.nan]
    nearest_m, farthest_m = min(distances_m), max(distances_m)
    if len(all_points) < 2 or farthest_m < MIN_DISTANCE_RATIO * nearest_m:
        return ScaleSlope(name, len(all_points), nearest_m, farthest_m, IntervalEstimate(None, None))
    log_center = math.log(nearest_m * farthest_m) / 2
    moments = [_regression_moments(points, log_center) for points in usable]
    value = float(
        _least_squares_slopes(np.sum([view_moments.sum(axis=0) for view_moments in moments], axis=0)[None])[0]
    )
    resamplings = list(map(_resampling, usable))
    sums = [one.counts @ one.sums(of_views) for one, of_views in zip(resamplings, moments, strict=True)]
    fewest = min(resampling.blocks() for resampling in resamplings)
    slope_interval = interval(_least_squares_slopes(np.sum(sums, axis=0)), fewest)
    return ScaleSlope(name, len(all_points), nearest_m, farthest_m, IntervalEstimate(value, slope_interval))


def _make_bin(points: Sequence[DistancePoint], low_m: float, high_m: float) -> DistanceBin:
    scales = np.array([scale for point in points if (scale := point.score.scale) is not None])
    with_scale = np.flatnonzero([point.score.scale is not None for point in points])
    resampling = _resampling(points)
    medians = resampling.percentile(scales, with_scale, 50)
    native_abs_rel, scaled_abs_rel = _mean_abs_rels(points, resampling)
    return DistanceBin(
        config=points[0].config,
        low_m=low_m,
        high_m=high_m,
        distance_m=float(np.median([point.distance_m for point in points])),
        views=len(points),
        views_scored=len(scales),
        scale=IntervalEstimate(
            float(np.median(scales)) if len(scales) else None, interval(medians, resampling.blocks(with_scale))
        ),
        scale_range=(float(scales.min()), float(scales.max())) if len(scales) else None,
        native_abs_rel=native_abs_rel,
        scaled_abs_rel=scaled_abs_rel,
        single_bar=mean_single_bar([point.single_bar for point in points]),
    )


def _mean_abs_rels(
    points: Sequence[DistancePoint], resampling: Resampling
) -> tuple[IntervalEstimate, IntervalEstimate]:
    """Return the means of native and scaled AbsRel over the views that have them."""
    errors = np.array([[_abs_rel(point.score.native), _abs_rel(point.score.scaled)] for point in points])
    draws = resampling.means(errors)
    means = [mean([value for value in column if not math.isnan(value)]) for column in errors.T.tolist()]
    blocks = resampling.blocks(np.flatnonzero(~np.isnan(errors[:, 0])))
    native, scaled = (IntervalEstimate(means[k], interval(draws[:, k], blocks)) for k in (0, 1))
    return native, scaled


def _abs_rel(metrics: DepthMetrics | None) -> float:
    return metrics.abs_rel if metrics else math.nan


def _resampling(points: Sequence[DistancePoint]) -> Resampling:
    """Return the resamples of the views of one config: of whole scenes if it has several."""
    view_ids = [point.score.view_id for point in points]
    if split_of(view_ids[0]) is not None:
        return resample_views(view_ids, by_scene=True)
    return resample([point.index for point in points])


def _has_usable_scale(point: DistancePoint) -> bool:
    scale = point.score.scale
    return scale is not None and math.isfinite(scale) and scale > 0


def _regression_moments(points: Sequence[DistancePoint], log_center: float) -> Float64[ndarray, "n 5"]:
    """Return the columns 1, x, y, x^2, x y of the views: x = log(distance) - ``log_center``, y = log(s)."""
    x = np.log([point.distance_m for point in points]) - log_center
    y = np.log([point.score.scale or math.nan for point in points])
    return np.stack([np.ones_like(x), x, y, x * x, x * y], axis=1)


def _least_squares_slopes(sums: Float64[ndarray, "draws 5"]) -> Float64[ndarray, " draws"]:
    """Return the least-squares slopes from sums of moments, NaN if all views have the same distance."""
    n, x, y, xx, xy = sums.T
    x_variance = n * xx - x * x
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(x_variance > 1e-9 * n * n, (n * xy - x * y) / x_variance, np.nan)
