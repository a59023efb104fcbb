"""Scale-anchor study: one scale for a whole archive from the known depth of k of its views.

This is the paper's "Scale anchoring". A view with known depth z and prediction p has the ratio r = median(z / p)
over its scored pixels; the scale of the archive is the median of r over k such views, drawn without replacement.
The study compares the error of the archive times this scale with its error times a given scale (from ArUco
markers, a baseline, ...).

Evaluating the errors at hundreds of scales costs one sort per view. With the relative errors d = (p - z) / z in
ascending order, s d + (s - 1), whose absolute value is |s p - z| / z, changes its sign at most once, so two prefix
sums give the mean at any scale s exactly. The sum of squares is a parabola in s, evaluated relative to its minimum
to keep small errors accurate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.scoring.provenance import Provenance
from rebar_depth_bench.studies.common import ViewPairs


@dataclass(frozen=True, eq=False)
class ScaleErrors:
    """AbsRel and RMSE (centimetres) at each of m scales, of one view or averaged over views."""

    abs_rel: Float64[ndarray, " m"]
    rmse_cm: Float64[ndarray, " m"]


@dataclass(frozen=True)
class ViewRatio:
    """Ratio r = median(z / p) of one view, None if no pixel has a prediction, and its coverage."""

    view_id: str
    ratio: float | None
    coverage: float


@dataclass(frozen=True)
class ScaledArchive:
    """Errors of the whole archive times one scale: means over views of AbsRel and of RMSE (centimetres)."""

    scale: float
    abs_rel: float
    rmse_cm: float


@dataclass(frozen=True)
class Spread:
    """Mean, sample standard deviation (None for a single draw), minimum and maximum over the draws."""

    mean: float
    sd: float | None
    low: float
    high: float


@dataclass(frozen=True)
class AnchorRow:
    """Statistics over the draws of k known-depth views.

    ``scale`` is the anchored scale, ``deviation_percent`` its deviation from the given scale;
    ``abs_rel_change`` and ``rmse_cm_change`` are the errors at the anchored scale minus those at the given scale.
    """

    k: int
    scale: Spread
    deviation_percent: Spread
    abs_rel_change: Spread
    rmse_cm_change: Spread


@dataclass(frozen=True)
class AnchorStudy:
    """Result of the scale-anchor study of one config.

    ``markers`` is the number of ArUco markers on the board of its scenes, None without a board or if they differ.
    ``given`` and ``all_views`` are the errors at the given scale and at the median ratio of all views. ``draws``
    has for each k of ``rows`` the errors at each drawn scale. ``skipped_counts`` are the requested k that exceed
    the number of views with a prediction.
    """

    provenance: Provenance
    config: str
    markers: int | None
    seed: int
    views: int
    views_without_prediction: tuple[str, ...]
    coverage: float
    given: ScaledArchive
    all_views: ScaledArchive
    rows: tuple[AnchorRow, ...]
    draws: tuple[tuple[ScaledArchive, ...], ...]
    skipped_counts: tuple[int, ...]


def view_ratio(view: ViewPairs) -> ViewRatio:
    """Return the ratio r = median(z / p) over the pixels of a view (``numpy.median``), and its coverage."""
    coverage = len(view.p_m) / view.scored_px
    if not len(view.p_m):
        return ViewRatio(view.view_id, None, coverage)
    with np.errstate(over="ignore", under="ignore"):
        return ViewRatio(view.view_id, float(np.median(view.z_m / view.p_m)), coverage)


def errors_at_scales(view: ViewPairs, scales: Float64[ndarray, " m"]) -> ScaleErrors:
    """Return the errors of scale * p at each of m scales (> 0), for a view with n >= 1 predictions.

    The cost is O(n log n + m log n). Values that overflow give ``inf`` without a warning.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        relative = np.sort((view.p_m - view.z_m) / view.z_m)
        prefix_sums = np.concatenate([[0.0], np.cumsum(relative)])
        offset = scales - 1.0
        split = np.searchsorted(relative, -offset / scales)
        too_near_sum = -(scales * prefix_sums[split] + offset * split)
        too_far_sum = scales * (prefix_sums[-1] - prefix_sums[split]) + offset * (len(relative) - split)
        power = np.dot(view.p_m, view.p_m)
        best_scale = np.dot(view.p_m, view.z_m) / power
        residual_m = best_scale * view.p_m - view.z_m
        square_sum = power * (scales - best_scale) ** 2 + np.dot(residual_m, residual_m)
        abs_rel = np.maximum(too_near_sum + too_far_sum, 0.0) / len(relative)
        rmse_cm = 100.0 * np.sqrt(square_sum / len(relative))
    return ScaleErrors(*(np.where(np.isnan(errors), np.inf, errors) for errors in (abs_rel, rmse_cm)))


def mean_errors(views: Sequence[ScaleErrors]) -> ScaleErrors:
    """Return the mean of the errors over one or more views at each scale."""
    return ScaleErrors(
        np.mean([view.abs_rel for view in views], axis=0), np.mean([view.rmse_cm for view in views], axis=0)
    )


def draw_scales(ratios: Float64[ndarray, " n"], k: int, draws: int, seed: int) -> Float64[ndarray, " draws"]:
    """Return for each draw the median ratio of k of n views, drawn without replacement (1 <= k <= n).

    A draw depends only on ``seed``, ``k`` and the number of the draw. Raw PCG64 output serves as sort keys because
    it does not change between NumPy versions.
    """
    keys = [np.random.PCG64([seed, k, draw]).random_raw(len(ratios)) for draw in range(draws)]
    return np.array([np.median(ratios[np.argsort(key, kind="stable")[:k]]) for key in keys])


def anchor_row(k: int, given: ScaledArchive, draws: Sequence[ScaledArchive]) -> AnchorRow:
    """Return the row of k: statistics of the draws relative to the given scale."""
    return AnchorRow(
        k=k,
        scale=summarize_draws([draw.scale for draw in draws]),
        deviation_percent=summarize_draws([100.0 * (draw.scale / given.scale - 1.0) for draw in draws]),
        abs_rel_change=summarize_draws([draw.abs_rel - given.abs_rel for draw in draws]),
        rmse_cm_change=summarize_draws([draw.rmse_cm - given.rmse_cm for draw in draws]),
    )


def summarize_draws(values: Sequence[float]) -> Spread:
    """Return mean, sample standard deviation and range of one or more values; all NaN if any is not finite."""
    if not all(math.isfinite(value) for value in values):
        return Spread(math.nan, math.nan, math.nan, math.nan)
    mean = math.fsum(values) / len(values)
    sd = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1)) if len(values) > 1 else None
    return Spread(mean, sd, min(values), max(values))
