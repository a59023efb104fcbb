"""Paired comparison of two submissions: the difference of every metric on the same views and its significance.

The difficulty of each view cancels in the paired difference. The interval of the difference is therefore much
narrower than the intervals of the two submissions, and only it shows whether one submission is better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval, resample_views
from rebar_depth_bench.scoring.columns import (
    ALIGNED_CONSTANT,
    Column,
    rounded,
    rounded_interval,
)
from rebar_depth_bench.scoring.evaluation import Provenance
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.spreadsheet import differences_sheet
from rebar_depth_bench.scoring.table import Frame, bootstrap_estimates, column_intervals, column_values

if TYPE_CHECKING:
    from pandas import DataFrame

Verdict = Literal["better", "worse", "equal", "undecided", "too few views", "too few scenes", "no verdict", ""]


@dataclass(frozen=True)
class Difference:
    """Metric of two submissions on the same views, and the difference ``other - first`` with its 95 % interval.

    ``verdict`` rates the other submission: "better" or "worse" if the interval excludes zero; "equal" if the
    interval is [0, 0]; "undecided" if it contains zero; "too few views", or "too few scenes" with splits, if there
    is none; "no verdict" for errors of valid predictions if either submission has less than
    ``MIN_COMPARABLE_COVERAGE``, since errors over freely chosen pixels are not comparable; "" for numbers of which
    neither direction is better, as the scale factor.
    """

    column: Column
    views: int
    first: float | None
    other: float | None
    difference: float | None
    interval: Interval | None
    verdict: Verdict


@dataclass(frozen=True)
class Comparison:
    """Differences of all metrics for each config that both archives contain."""

    provenance: Provenance
    configs: Mapping[str, Sequence[Difference]]

    def to_pandas(self) -> DataFrame:
        """Return one row per config and metric: values, difference with its 95 % interval, and provenance."""
        return differences_sheet([self.to_dict()]).to_pandas()

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a JSON-compatible object."""
        return {
            **self.provenance.to_dict(),
            "intervals": dict(INTERVALS),
            "configs": {
                name: [_difference_dict(difference) for difference in rows] for name, rows in self.configs.items()
            },
        }


def compare(first: Result, other: Result) -> Comparison:
    """Return the differences of ``other`` from ``first``.

    Raises ``InputError`` if they were scored against different ground truth or are of different kinds, have no
    config in common, or cover different splits of one.
    """
    check_same_kinds([(result.method, result.kind) for result in (first, other)])
    if first.dataset.digest != other.dataset.digest:
        raise InputError(
            f"{other.method} was scored on the dataset {other.dataset.digest}, expected {first.dataset.digest} as "
            f"{first.method}: only submissions on the same ground truth can be compared"
        )
    check_same_splits([first, other])
    shared = [config for config in first.tables if config in other.tables]
    if not shared:
        raise InputError(
            f"{first.method} has {', '.join(first.tables)} and {other.method} has {', '.join(other.tables)}: "
            "expected a config that is in both"
        )
    return Comparison(
        provenance=Provenance(first.protocol, first.dataset, (first.submission, other.submission)),
        configs={config: config_differences(first, other, config) for config in shared},
    )


def check_same_kinds(kinds: Sequence[tuple[str, str]]) -> None:
    """Raise ``InputError`` if the kinds of predictions of methods, pairs of both, differ."""
    first_method, first_kind = kinds[0]
    for method, kind in kinds:
        if kind != first_kind:
            raise InputError(
                f"{method} has predictions of the kind {kind}, expected {first_kind} as {first_method}: "
                "errors after different alignments cannot be compared; --align scores metric ones as another kind"
            )


def check_same_splits(results: Sequence[Result]) -> None:
    """Raise ``InputError`` if two results cover different splits of a config."""
    first: dict[str, tuple[str, str | None]] = {}
    for result in results:
        for name, table in result.tables.items():
            method, split = first.setdefault(name, (result.method, table.split))
            if table.split != split:
                raise InputError(
                    f"{result.method} covers the split {table.split} of {name}, expected {split} as {method}"
                )


def config_differences(first: Result, other: Result, config: str) -> list[Difference]:
    """Return one difference per metric of a config that both cover, with the same split.

    Error metrics use only the views where both submissions have a value. Both frames are resampled alike, so that
    the difficulty of each view cancels.
    """
    tables, frames = (first.tables[config], other.tables[config]), (first.frames[config], other.frames[config])
    of_other = set(frames[1].view_ids)
    shared = [view_id for view_id in frames[0].view_ids if view_id in of_other]
    frames = frames[0].of_views(shared), frames[1].of_views(shared)
    table = tables[0]
    are_comparable = all(one.is_comparable for one in tables)
    predicted_by_both = np.flatnonzero((frames[0]["coverage"] > 0) & (frames[1]["coverage"] > 0))
    # The constant of a fit differs with the pixels that have a value, not with the quality of a method.
    columns = [one for one in first.columns if one not in ALIGNED_CONSTANT]
    found: dict[str, Difference] = {}
    for on_all_views in (True, False):
        some = [column for column in columns if column.of_all_views == on_all_views]
        a, b = frames if on_all_views else (frame.take(predicted_by_both) for frame in frames)
        resampling = resample_views(
            a.view_ids, by_scene=table.split is not None, views_per_distance=table.views_per_distance
        )
        values = column_values(a, some), column_values(b, some)
        draws = [bootstrap_estimates(one, some, resampling) for one in values]
        intervals = column_intervals(draws[1] - draws[0], values[0] + values[1], some, resampling)
        for column in some:
            before, after = _value(column, a), _value(column, b)
            change = None if before is None or after is None else after - before
            ends = intervals[column.place]
            verdict = _verdict(column, ends, by_scene=table.split is not None, are_comparable=are_comparable)
            found[column.place] = Difference(column, len(a), before, after, change, ends, verdict)
    return [found[column.place] for column in columns]


def _value(column: Column, views: Frame) -> float | None:
    """Return the statistic of a column; None without values, or if one is infinite."""
    values = views[column.place_in_view]
    values = values[~np.isnan(values)]
    if not len(values) or not np.isfinite(values).all():
        return None
    return float(np.median(values) if column.statistic == "median" else np.mean(values))


def _verdict(column: Column, bounds: Interval | None, *, by_scene: bool, are_comparable: bool) -> Verdict:
    if not column.better:
        return ""
    if not (are_comparable or column.of_all_views):
        return "no verdict"
    if bounds is None:
        return "too few scenes" if by_scene else "too few views"
    if bounds == (0.0, 0.0):
        return "equal"
    if bounds[0] <= 0.0 <= bounds[1]:
        return "undecided"
    return "better" if (bounds[0] > 0) == (column.better == "higher") else "worse"


def _difference_dict(difference: Difference) -> dict[str, Any]:
    return {
        "name": difference.column.place,
        "views": difference.views,
        "first": rounded(difference.first),
        "other": rounded(difference.other),
        "difference": rounded(difference.difference),
        "ci95": rounded_interval(difference.interval),
        "verdict": difference.verdict,
    }
