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
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval, resample_views
from rebar_depth_bench.scoring.columns import (
    ALIGNED_CONSTANT,
    Column,
    bootstrap_estimates,
    column_intervals,
    rounded,
    rounded_interval,
    view_values,
)
from rebar_depth_bench.scoring.evaluation import Provenance
from rebar_depth_bench.scoring.frames import differences_frame
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import ViewScore

if TYPE_CHECKING:
    from pandas import DataFrame

Verdict = Literal["better", "worse", "equal", "undecided", "no verdict", ""]


@dataclass(frozen=True)
class Difference:
    """Metric of two submissions on the same views, and the difference ``other - first`` with its 95 % interval.

    ``verdict`` rates the other submission: "better" or "worse" if the interval excludes zero; "equal" if the
    interval is [0, 0]; "undecided" if the interval contains zero or is None; "no verdict" for errors of valid
    predictions if either submission has less than ``MIN_COMPARABLE_COVERAGE``, since errors over freely chosen
    pixels are not comparable; "" for numbers of which neither direction is better, as the scale factor.
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
        return differences_frame([self.to_dict()])

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

    Error metrics use only the views where both submissions have a value.
    """
    tables = first.tables[config], other.tables[config]
    # The constant of a fit differs with the pixels that have a value, not with the quality of a method.
    columns = [column for column in first.columns if column not in ALIGNED_CONSTANT]
    of_first, of_other = (
        {view.view_id: view for view in result.views if config_of(view.view_id) == config}
        for result in (first, other)
    )
    predicted_by_both = [
        view_id for view_id in of_first if of_first[view_id].coverage and of_other[view_id].coverage
    ]
    on_all_views, on_predicted_by_both = (
        _differences_on_views(
            [of_first[view_id] for view_id in view_ids],
            [of_other[view_id] for view_id in view_ids],
            columns,
            by_scene=tables[0].split is not None,
            are_comparable=all(table.is_comparable for table in tables),
        )
        for view_ids in (of_first, predicted_by_both)
    )
    return [(on_all_views if column.of_all_views else on_predicted_by_both)[column.path] for column in columns]


def _differences_on_views(
    first: Sequence[ViewScore],
    other: Sequence[ViewScore],
    columns: Sequence[Column],
    *,
    by_scene: bool,
    are_comparable: bool,
) -> dict[str, Difference]:
    """Return the differences on the given views by metric name, with the same resamples for both submissions."""
    resampling = resample_views([view.view_id for view in first], by_scene=by_scene)
    first_values, other_values = view_values(first, columns), view_values(other, columns)
    first_draws, other_draws = (
        bootstrap_estimates(values, columns, resampling) for values in (first_values, other_values)
    )
    intervals = column_intervals(other_draws - first_draws, first_values + other_values, columns, resampling)
    differences = {}
    for column in columns:
        bounds = intervals[column.path]
        first_value, other_value = (_table_value(column, views) for views in (first, other))
        change = None if first_value is None or other_value is None else other_value - first_value
        verdict = _verdict(column, bounds) if are_comparable or column.of_all_views else "no verdict"
        differences[column.path] = Difference(
            column, len(first), first_value, other_value, change, bounds, verdict if column.better else ""
        )
    return differences


def _table_value(column: Column, views: Sequence[ViewScore]) -> float | None:
    values = [value for view in views if (value := column.view_value(view)) is not None]
    if not values or not np.isfinite(values).all():
        return None
    return float(np.median(values) if column.statistic == "median" else np.mean(values))


def _verdict(column: Column, bounds: Interval | None) -> Verdict:
    if bounds == (0.0, 0.0):
        return "equal"
    if bounds is None or bounds[0] <= 0.0 <= bounds[1]:
        return "undecided"
    return "better" if (bounds[0] > 0) == (column.better == "higher") else "worse"


def _difference_dict(difference: Difference) -> dict[str, Any]:
    return {
        "name": difference.column.path,
        "views": difference.views,
        "first": rounded(difference.first),
        "other": rounded(difference.other),
        "difference": rounded(difference.difference),
        "ci95": rounded_interval(difference.interval),
        "verdict": difference.verdict,
    }
