"""Scores of views, the metrics of a table as functions of them, and their bootstrap intervals."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.names import scene_of
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample, resample_scenes
from rebar_depth_bench.scoring.metrics import METRIC_NAMES, DepthMetrics
from rebar_depth_bench.scoring.protocol import WITHIN_MM

SCALE_MEDIAN = "scale_median"
"""Key of the median over views of the scale factor in ``VIEW_METRICS``."""

_VIEW_INDEX = re.compile("[0-9]{4,9}")


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one view; ``scale``, ``native`` and ``scaled`` are None without valid predictions.

    ``scaled_constant`` is as in ``Table``; it is None in results that were read from a file.
    """

    view_id: str
    scored_px: int
    coverage: float
    rank_error: float
    scale: float | None
    native: DepthMetrics | None
    scaled: DepthMetrics | None
    within_mm: Mapping[int, float]
    scaled_constant: tuple[float, float] | None = None


def _metric_getter(alignment: str, name: str) -> Callable[[ViewScore], float | None]:
    return lambda view: getattr(getattr(view, alignment), name, None)


def _within_getter(tolerance_mm: int) -> Callable[[ViewScore], float | None]:
    return lambda view: view.within_mm[tolerance_mm]


VIEW_METRICS: Mapping[str, Callable[[ViewScore], float | None]] = {
    "coverage": lambda view: view.coverage,
    "rank_error": lambda view: view.rank_error,
    **{
        f"{alignment}.{name}": _metric_getter(alignment, name)
        for alignment in ("native", "scaled")
        for name in METRIC_NAMES
    },
    SCALE_MEDIAN: lambda view: view.scale,
    **{f"within_mm.{tolerance_mm}": _within_getter(tolerance_mm) for tolerance_mm in WITHIN_MM},
}
"""Functions that return a view's value of each table metric, by metric name; None where the view has no value."""


def view_intervals(views: Sequence[ViewScore], *, by_scene: bool) -> dict[str, Interval | None]:
    """Return the 95 % interval of every table metric of the given views; ``by_scene`` as in ``resample_views``."""
    values = view_metric_values(views)
    resampling = resample_views([view.view_id for view in views], by_scene=by_scene)
    return metric_intervals(bootstrap_estimates(values, resampling), values, resampling)


def metric_intervals(
    estimates: Float64[ndarray, "draws k"], values: Float64[ndarray, "n k"], resampling: Resampling
) -> dict[str, Interval | None]:
    """Return the interval of each of ``VIEW_METRICS`` from its estimates; ``values`` is NaN where it has none."""
    return {
        name: interval(estimates[:, k], resampling.blocks(np.flatnonzero(~np.isnan(values[:, k]))))
        for k, name in enumerate(VIEW_METRICS)
    }


def bootstrap_estimates(values: Float64[ndarray, "n k"], resampling: Resampling) -> Float64[ndarray, "draws k"]:
    """Return the table's ``VIEW_METRICS`` in each resample of ``view_metric_values``; NaN where undefined."""
    draws = resampling.means(values)
    scale = list(VIEW_METRICS).index(SCALE_MEDIAN)
    draws[:, scale] = resampling.medians(values[:, scale])
    return draws


def view_metric_values(views: Sequence[ViewScore]) -> Float64[ndarray, "n k"]:
    """Return the ``VIEW_METRICS`` of each view, one row per view; NaN where it has no value."""
    rows = [[get(view) for get in VIEW_METRICS.values()] for view in views]
    return np.array(rows, dtype=np.float64).reshape(len(views), len(VIEW_METRICS))


def resample_views(view_ids: Sequence[str], *, by_scene: bool) -> Resampling:
    """Return the resamples of views: of whole scenes if ``by_scene``, otherwise of blocks of consecutive views.

    Scenes are resampled in configs of several scenes, which are those with splits.
    """
    if by_scene:
        return resample_scenes([scene_of(view_id) for view_id in view_ids])
    return resample(protocol_indices(view_ids))


def protocol_indices(view_ids: Sequence[str]) -> list[int]:
    """Return each view's index in its full camera protocol: the four or more digits at the end of its view_id.

    If the ids do not all end with such an index, or are not in its ascending order, return the positions in the
    sequence.
    """
    suffixes = [view_id.rpartition("/")[2] for view_id in view_ids]
    if all(map(_VIEW_INDEX.fullmatch, suffixes)):
        indices = list(map(int, suffixes))
        if indices == sorted(indices):
            return indices
    return list(range(len(suffixes)))
