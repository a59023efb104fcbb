"""Numbers of the study ``anchor``: a whole archive's one scale from the known depth of k of its views.

The paper's "Scale anchoring": r = med(z / p) of a view with known depth z, on its scored pixels; the archive's
scale is the median of r over k such views, drawn without replacement. What counts is the error of the whole
archive times that scale against its error times a given one (ArUco markers, a baseline, ...).

The errors at hundreds of scales cost one sort a view: with relative errors d = (p - z) / z in rising order,
|s p - z| / z = |s d + (s - 1)| changes its sign once, so that two prefix sums give the mean at any scale exactly;
the sum of squares is a parabola in s, written round its lowest point because that keeps small errors exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.scoring.provenance import Stamp
from rebar_depth_bench.studies.common import ViewPairs


@dataclass(frozen=True, eq=False)
class ScaleErrors:
    """One view's (or a mean over views') errors at each of m scales: AbsRel, and RMSE in centimetres."""

    abs_rel: Float64[ndarray, " m"]
    rmse_cm: Float64[ndarray, " m"]


@dataclass(frozen=True)
class ViewRatio:
    """One view's r = median(z / p), None where no pixel has a prediction, and its coverage."""

    view_id: str
    ratio: float | None
    coverage: float


@dataclass(frozen=True)
class ScaledArchive:
    """The whole archive times one scale: mean over views of AbsRel, and of RMSE in centimetres."""

    scale: float
    abs_rel: float
    rmse_cm: float


@dataclass(frozen=True)
class Spread:
    """A number over the draws; ``sd`` is that of a sample, None of a single draw."""

    mean: float
    sd: float | None
    low: float
    high: float


@dataclass(frozen=True)
class AnchorRow:
    """k known-depth views: the scale, how far off the given one it is, and the errors' changes, over draws."""

    k: int
    scale: Spread
    deviation_percent: Spread
    abs_rel_change: Spread
    rmse_cm_change: Spread


@dataclass(frozen=True)
class AnchorStudy:
    """What the study says. ``draws`` holds for each k of ``rows`` the archive at each drawn scale."""

    stamp: Stamp
    config: str
    seed: int
    views: int
    unpredicted: tuple[str, ...]
    coverage: float
    given: ScaledArchive
    all_views: ScaledArchive
    rows: tuple[AnchorRow, ...]
    draws: tuple[tuple[ScaledArchive, ...], ...]
    left_out: tuple[int, ...]


def view_ratio(view: ViewPairs) -> ViewRatio:
    """Return a view's r = median(z / p) over its pixels (an even count takes the mean of the two middle ones)."""
    coverage = len(view.p_m) / view.scored_px
    if not len(view.p_m):
        return ViewRatio(view.view_id, None, coverage)
    with np.errstate(over="ignore", under="ignore"):
        return ViewRatio(view.view_id, float(np.median(view.z_m / view.p_m)), coverage)


def errors_at(view: ViewPairs, scales: Float64[ndarray, " m"]) -> ScaleErrors:
    """Return the errors of scale * p at each of m scales (> 0), for a view with n >= 1 predictions.

    O(n log n + m log n). What is too large to square gives ``inf``, never a warning.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        relative = np.sort((view.p_m - view.z_m) / view.z_m)
        below = np.concatenate([[0.0], np.cumsum(relative)])
        offset = scales - 1.0
        near = np.searchsorted(relative, -offset / scales)
        too_near = -(scales * below[near] + offset * near)
        too_far = scales * (below[-1] - below[near]) + offset * (len(relative) - near)
        power = np.dot(view.p_m, view.p_m)
        best = np.dot(view.p_m, view.z_m) / power
        residual_m = best * view.p_m - view.z_m
        square = power * (scales - best) ** 2 + np.dot(residual_m, residual_m)
        abs_rel = np.maximum(too_near + too_far, 0.0) / len(relative)
        rmse_cm = 100.0 * np.sqrt(square / len(relative))
    return ScaleErrors(*(np.where(np.isnan(errors), np.inf, errors) for errors in (abs_rel, rmse_cm)))


def mean_errors(views: Sequence[ScaleErrors]) -> ScaleErrors:
    """Return the mean over one or more views at each scale."""
    return ScaleErrors(
        np.mean([view.abs_rel for view in views], axis=0), np.mean([view.rmse_cm for view in views], axis=0)
    )


def drawn_scales(ratios: Float64[ndarray, " n"], k: int, draws: int, seed: int) -> Float64[ndarray, " draws"]:
    """Return for each draw the median of the ratios of k of n views, drawn without replacement (1 <= k <= n).

    A draw depends on ``seed``, ``k`` and its own number alone. Raw PCG64 numbers as sorting keys, since they do
    not change between versions of numpy.
    """
    keys = [np.random.PCG64([seed, k, draw]).random_raw(len(ratios)) for draw in range(draws)]
    return np.array([np.median(ratios[np.argsort(key, kind="stable")[:k]]) for key in keys])


def anchor_row(k: int, given: ScaledArchive, draws: Sequence[ScaledArchive]) -> AnchorRow:
    """Return the row of k: every draw against the given scale."""
    return AnchorRow(
        k=k,
        scale=spread([one.scale for one in draws]),
        deviation_percent=spread([100.0 * (one.scale / given.scale - 1.0) for one in draws]),
        abs_rel_change=spread([one.abs_rel - given.abs_rel for one in draws]),
        rmse_cm_change=spread([one.rmse_cm - given.rmse_cm for one in draws]),
    )


def spread(values: Sequence[float]) -> Spread:
    """Return mean, sample standard deviation and range of one or more values; NaN where one is not finite."""
    if not all(math.isfinite(value) for value in values):
        return Spread(math.nan, math.nan, math.nan, math.nan)
    mean = math.fsum(values) / len(values)
    sd = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1)) if len(values) > 1 else None
    return Spread(mean, sd, min(values), max(values))
