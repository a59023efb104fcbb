"""Arithmetic of a score by protocol ``rebar-2``: from depth maps to tables, without files, caches and threads.

``score_views`` is the whole computation: each view of ``Truth`` is compared with the depth that ``ReadDepth``
returns, and the scores of a config's views are tabulated. ``evaluation.score`` calls it with a dataset folder and
an archive.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Float32, UInt32
from numpy import ndarray

from rebar_depth_bench.scoring.columns import RELATIVE_INTERVALS, VIEW_COLUMNS, view_intervals
from rebar_depth_bench.scoring.groups import GROUPINGS, ViewTraits, positions_by_group
from rebar_depth_bench.scoring.metrics import (
    is_valid_prediction,
    mean,
    mean_metrics,
    median,
    median_scale,
    metrics_at_scales,
    rank_error,
)
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.reference import (
    NO_REFERENCE,
    Errors,
    Reference,
    ReferenceNumbers,
    constant_errors,
    mean_reference,
)
from rebar_depth_bench.scoring.relative import align_view, mean_errors
from rebar_depth_bench.scoring.table import PublishedMatch, Table, ViewScore
from rebar_depth_bench.submission.declaration import METRIC, NOT_DECLARED, Declaration

ReadDepth = Callable[[str], Float[ndarray, "h w"]]
"""Function that returns the predicted planar depth of a view in metres, by view id."""

UseView = Callable[[Float[ndarray, "h w"], ViewScore], None]
"""Function that is given the predicted planar depth of a view, metres, and its score."""


@dataclass(frozen=True, eq=False)
class ViewTruth:
    """Scored pixels of one view.

    ``index`` holds flat indices into the H x W image, ``depth_m`` their planar depth and ``median_m`` its median,
    in metres. ``constant`` has ``reference.constant_errors``, if they are known.
    """

    view_id: str
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]
    median_m: float
    constant: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of the views of a config that have scored pixels, in order.

    ``read(position)`` returns a view. ``references`` are the errors of ``view_reference`` and ``traits`` the
    properties by which views are grouped, of each view. ``split`` is that of the views, None in a config of one
    scene. ``views_per_distance``, ``truth_sigma_m`` and ``published`` are those of ``Table``.
    """

    view_ids: tuple[str, ...]
    read: Callable[[int], ViewTruth]
    references: Sequence[ReferenceNumbers]
    traits: Sequence[ViewTraits] = ()
    split: str | None = None
    views_per_distance: int | None = None
    truth_sigma_m: float | None = None
    published: PublishedMatch | None = None

    def __len__(self) -> int:
        return len(self.view_ids)

    def __iter__(self) -> Iterator[ViewTruth]:
        return map(self.read, range(len(self)))


Each = Callable[[str, Callable[[int], ViewScore], Sequence[int]], Iterable[ViewScore]]
"""Function that maps a function over the positions of a config's views, in order; the config's name is first."""


def score_views(
    truths: Iterable[tuple[str, Truth]],
    read_depth: ReadDepth,
    declared: Declaration = NOT_DECLARED,
    each: Each = lambda _, work, positions: map(work, positions),
    use_view: UseView | None = None,
    kind: str = METRIC,
) -> tuple[dict[str, Table], list[ViewScore]]:
    """Return the tables by config, and the scores of all views.

    ``truths`` are names and ground truth of configs, ``kind`` is that of the predictions. One view is in memory at
    a time, unless ``each`` computes several at once. ``use_view`` is called with each view, for further measures
    of the same depth.
    """
    tables: dict[str, Table] = {}
    views: list[ViewScore] = []
    for name, truth in truths:
        work = partial(_score_at, truth, read_depth, use_view, kind)
        scores = list(each(name, work, range(len(truth.view_ids))))
        tables[name] = tabulate_config(scores, truth, declared)
        views += scores
    return tables, views


def _score_at(
    truth: Truth, read_depth: ReadDepth, use_view: UseView | None, kind: str, position: int
) -> ViewScore:
    view = truth.read(position)
    prediction_m = read_depth(view.view_id)
    if kind == METRIC:
        score = score_view(view, prediction_m)
    else:
        score = align_view(view.view_id, _at_pixels(prediction_m, view), view.depth_m, kind)
    if use_view is not None:
        use_view(prediction_m, score)
    return score


def score_view(truth: ViewTruth, prediction_m: Float[ndarray, "h w"]) -> ViewScore:
    """Return the metrics of one view's prediction (planar depth, metres) on the view's scored pixels."""
    p_m, z_m, z_median_m = _at_pixels(prediction_m, truth), truth.depth_m, truth.median_m
    valid = is_valid_prediction(p_m)
    error = rank_error(p_m, z_m, valid)
    constant = truth.constant
    if not valid.all():
        p_m, z_m, constant = p_m[valid], z_m[valid], None
        z_median_m = median(z_m) if len(z_m) else 0.0
    scored_px = len(truth.index)
    coverage = len(p_m) / scored_px
    if not len(p_m):
        return ViewScore(
            truth.view_id, scored_px, coverage, error, None, None, None, dict.fromkeys(WITHIN_MM, 0.0)
        )
    scale = median_scale(p_m, z_median_m)
    (native, scaled), within = metrics_at_scales(p_m, z_m, (1.0, scale), WITHIN_MM)
    return ViewScore(
        view_id=truth.view_id,
        scored_px=scored_px,
        coverage=coverage,
        rank_error=error,
        scale=scale,
        native=native,
        scaled=scaled,
        within_mm={tolerance_mm: count / scored_px for tolerance_mm, count in within.items()},
        scaled_constant=constant or constant_errors(z_m, z_median_m),
    )


def _at_pixels(prediction: Float[ndarray, "h w"], truth: ViewTruth) -> Float[ndarray, " n"]:
    return prediction.ravel().take(truth.index.astype(np.intp))


def tabulate_config(scores: Sequence[ViewScore], truth: Truth, declared: Declaration) -> Table:
    """Return the table of a config, with the tables of groups of its views if it has splits."""

    def table_of(positions: Sequence[int]) -> Table:
        views = [scores[position] for position in positions]
        reference = mean_reference([truth.references[position] for position in positions])
        known = truth.published, truth.split, truth.truth_sigma_m, truth.views_per_distance
        return tabulate(views, declared, reference, *known)

    table = table_of(range(len(scores)))
    if truth.split is None:
        return table
    groups = {
        key: {
            group: table_of(positions) for group, positions in positions_by_group(grouping, truth.traits).items()
        }
        for key, grouping in GROUPINGS.items()
    }
    return replace(table, groups=groups)


def tabulate(
    views: Sequence[ViewScore],
    declared: Declaration = NOT_DECLARED,
    reference: Reference = NO_REFERENCE,
    published: PublishedMatch | None = None,
    split: str | None = None,
    truth_sigma_m: float | None = None,
    views_per_distance: int | None = None,
) -> Table:
    """Return the table of a config, or of a group of its views, from the scores of its scored views.

    Predictions that are not metric have aligned errors alone. The intervals of a config with splits are those of
    resampled scenes, of a survey those of views, of others those of consecutive views. A config without views is
    not ranked, and neither is a submission that declares the use of ground truth. An infinite metric (of a
    prediction so large that its square overflows) is written as null; the rank error is always finite.
    """
    if views and views[0].aligned is not None:
        empty = tabulate([], declared, reference, published, split, truth_sigma_m, views_per_distance)
        return _tabulate_relative(views, empty)
    predicted = [view for view in views if view.native is not None]
    native = mean_metrics([view.native for view in predicted if view.native])
    scaled = mean_metrics([view.scaled for view in predicted if view.scaled])
    constants = [view.scaled_constant for view in predicted if view.scaled_constant is not None]
    return Table(
        views=len(views),
        views_scored=len(predicted),
        coverage=mean([view.coverage for view in views]),
        ranked=bool(views) and not declared.uses_ground_truth,
        rank_error=mean([view.rank_error for view in views if view.rank_error is not None]),
        native=native,
        scaled=scaled,
        scale_median=statistics.median([view.scale for view in predicted if view.scale is not None])
        if predicted
        else None,
        within_mm={t: mean([view.within_mm[t] or 0.0 for view in views]) for t in WITHIN_MM},
        reference=replace(reference, scaled_constant=Errors(*map(mean, zip(*constants, strict=True)))),
        published=published,
        split=split,
        views_per_distance=views_per_distance,
        truth_sigma_m=truth_sigma_m,
        intervals=view_intervals(views, by_scene=split is not None, views_per_distance=views_per_distance)
        if views
        else dict.fromkeys(column.path for column in VIEW_COLUMNS),
    )


def _tabulate_relative(views: Sequence[ViewScore], empty: Table) -> Table:
    """Return the table of one or more views of predictions that are not metric; ``empty`` is that of no views."""
    by_scene, per_distance = empty.split is not None, empty.views_per_distance
    return replace(
        empty,
        views=len(views),
        views_scored=sum(view.coverage > 0 for view in views),
        coverage=mean([view.coverage for view in views]),
        aligned=mean_errors([view.aligned for view in views]),
        aligned_robust=mean_errors([view.aligned_robust for view in views]),
        constant=mean_errors([view.constant for view in views]),
        flat_views=sum(view.is_flat is True for view in views),
        intervals=view_intervals(views, RELATIVE_INTERVALS, by_scene=by_scene, views_per_distance=per_distance),
    )
