"""Frames of the numbers of views, and the tables that are made of them: means, intervals, groups, JSON."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray
from pydantic import Strict

from rebar_depth_bench.base.validation import text
from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample_views
from rebar_depth_bench.scoring.columns import (
    METRICS,
    REFERENCES,
    WITHIN,
    Column,
    check_place,
    interval_columns,
    nested,
    rounded_interval,
    table_columns,
    view_columns,
)
from rebar_depth_bench.scoring.groups import GROUPINGS, ViewTraits, positions_by_group
from rebar_depth_bench.scoring.metrics import mean
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.view_numbers import ViewTruth
from rebar_depth_bench.submission.declaration import METRIC, NOT_DECLARED, Declaration

Name = Annotated[str, Strict(), text(300)]


@dataclass(frozen=True)
class PublishedMatch:
    """Scene of Table I that a config shows; ``same_optics`` is False if nothing but the optics differs."""

    scene: Name
    same_optics: Annotated[bool, Strict()]


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of the views of a config that have scored pixels, in order.

    ``views`` may read a view when it is taken. ``references`` are the reference errors of each view, by place, and
    ``traits`` the properties by which views are grouped. ``split`` is that of the views, None in a config of one
    scene. ``Table`` documents ``views_per_distance``, ``truth_sigma_m`` and ``published``.
    """

    view_ids: tuple[str, ...]
    views: Sequence[ViewTruth]
    references: Sequence[Mapping[str, float]]
    traits: Sequence[ViewTraits] = ()
    split: str | None = None
    views_per_distance: int | None = None
    truth_sigma_m: float | None = None
    published: PublishedMatch | None = None


@dataclass(frozen=True)
class ViewScore:
    """Numbers of one view by their places in the JSON, as ``view["native.abs_rel"]``; NaN where undefined."""

    view_id: str
    numbers: Mapping[str, float]

    def __getitem__(self, place: str) -> float:
        """Return a number; NaN where it is undefined. Raises ``InputError`` for a place that no number has."""
        if place not in self.numbers:
            check_place(place)
        return self.numbers.get(place, math.nan)

    def number(self, column: Column) -> float:
        """Return the number of a column; NaN where it is undefined."""
        return self[column.place_in_view]

    def interval(self, column: Column) -> None:
        """Return None: numbers of a view have no intervals. Views and tables share ``Column.cell``."""

    @property
    def error(self) -> float:
        """Rank error, or aligned error, by which views are ordered; 1 without either."""
        found = self["aligned.error"] if "aligned.error" in self.numbers else self["rank_error"]
        return 1.0 if math.isnan(found) else found

    def to_dict(self, kind: str) -> dict[str, Any]:
        """Return the JSON object of the view of a kind of predictions."""
        document = {"view_id": self.view_id, "scored_px": int(self["scored_px"])}
        written = nested({one.place_in_view: one.view_json_value(self) for one in view_columns(kind)})
        if kind != METRIC:
            nulls = dict.fromkeys(("rank_error", "scale", "native", "scaled"))
            written = _relative_object(written, nulls, self["aligned_robust.error"])
        return document | written


def _relative_object(written: dict[str, Any], nulls: Mapping[str, None], robust_error: float) -> dict[str, Any]:
    """Return the JSON object of a view or table that is not metric, with null for what only metric ones have."""
    if math.isnan(robust_error):
        written["aligned_robust"] = None  # Predictions up to a scale have no robust alignment.
    within = nested({column.place: None for column in WITHIN})
    return {"coverage": written.pop("coverage"), **nulls, **within, **written}


@dataclass(frozen=True, eq=False)
class Frame:
    """Numbers of the views of a config: float64 columns by place, NaN where a number is undefined."""

    view_ids: tuple[str, ...]
    columns: Mapping[str, Float64[ndarray, " n"]]

    @classmethod
    def of_rows(cls, rows: Mapping[str, Mapping[str, float]]) -> Frame:
        """Return the frame of the numbers of views, by id; a place that is missing in a row is undefined."""
        places = dict.fromkeys(place for row in rows.values() for place in row)
        values = {place: [row.get(place, math.nan) for row in rows.values()] for place in places}
        return cls(tuple(rows), {place: np.array(column, np.float64) for place, column in values.items()})

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.view_ids)

    def __getitem__(self, place: str) -> Float64[ndarray, " n"]:
        """Return a column; all NaN if no view has the number."""
        return self.columns[place] if place in self.columns else np.full(len(self), math.nan)

    def take(self, positions: Sequence[int] | Int64[ndarray, " m"]) -> Frame:
        """Return the views at ``positions``."""
        at = np.asarray(positions, np.intp)
        columns = {place: column[at] for place, column in self.columns.items()}
        return Frame(tuple(self.view_ids[position] for position in at), columns)

    def of_views(self, view_ids: Iterable[str]) -> Frame:
        """Return the views of these ids, in their order."""
        position = {view_id: place for place, view_id in enumerate(self.view_ids)}
        return self.take([position[view_id] for view_id in view_ids])

    def views(self) -> Iterator[ViewScore]:
        """Yield the numbers of each view."""
        for position, view_id in enumerate(self.view_ids):
            yield ViewScore(view_id, {place: float(column[position]) for place, column in self.columns.items()})


@dataclass(frozen=True, kw_only=True)
class Table:
    """Numbers of one config by their places in the JSON, as ``table["native.abs_rel"]``; NaN where undefined.

    They are means over the views that have them, the median of the scale factors, the count of views whose fit has
    no positive slope, and the reference errors. ``kind`` is that of the predictions. ``intervals`` has the 95 %
    bootstrap intervals of the columns that have one, None where undefined. ``published`` is the scene of the
    paper's Table I that the config shows, if any. ``split`` is None for a config of one scene.
    ``views_per_distance`` is the number of views at each distance of a survey, otherwise None. ``truth_sigma_m``
    is the standard deviation of the ground truth's depth, None where it is exact. ``of_views`` is the number of
    the config's views, None if ``views`` are all. ``groups`` has the tables of groups of views by grouping (see
    ``groups.GROUPINGS``) and group, of a config with splits; they have no groups.
    """

    kind: str
    views: int
    views_scored: int
    ranked: bool
    numbers: Mapping[str, float]
    intervals: Mapping[str, Interval | None]
    split: str | None = None
    views_per_distance: int | None = None
    truth_sigma_m: float | None = None
    of_views: int | None = None
    published: PublishedMatch | None = None
    groups: Mapping[str, Mapping[str, Table]] = field(default_factory=dict)

    def __getitem__(self, place: str) -> float:
        """Return a number; NaN where it is undefined. Raises ``InputError`` for a place that no number has."""
        if place not in self.numbers:
            check_place(place)
        return self.numbers.get(place, math.nan)

    def number(self, column: Column) -> float:
        """Return the number of a column; NaN where it is undefined."""
        return self[column.place]

    def interval(self, column: Column) -> Interval | None:
        """Return the interval of the number of a column; None where it is undefined."""
        return self.intervals.get(column.place)

    @property
    def error(self) -> float:
        """Rank error, or aligned error, by which tables are ordered; NaN without either."""
        return self["rank_error"] if self.kind == METRIC else self["aligned.error"]

    @property
    def scored_of_views(self) -> str:
        """Numbers of the views with a prediction and of all views."""
        return f"{self.views_scored}/{self.views}"

    def of_some_views(self, of_views: int) -> Table:
        """Return the table as that of some of the ``of_views`` views of the config, which is not ranked."""
        groups = {
            grouping: {group: replace(table, ranked=False) for group, table in tables.items()}
            for grouping, tables in self.groups.items()
        }
        return replace(self, ranked=False, groups=groups, of_views=of_views)

    @property
    def is_comparable(self) -> bool:
        """Whether the errors of valid predictions can be compared with those of other submissions.

        Every view needs a prediction, the coverage must be at least ``MIN_COMPARABLE_COVERAGE``, and no metric may
        be infinite. Otherwise, missing or enormous predictions could improve the comparison.
        """
        is_complete = 0 < self.views == self.views_scored
        return is_complete and self.is_finite and self["coverage"] >= MIN_COMPARABLE_COVERAGE

    @property
    def is_finite(self) -> bool:
        """Whether there are metrics, and none of them overflowed."""
        alignments = ("native", "scaled") if self.kind == METRIC else ("aligned",)
        return all(math.isfinite(self[f"{alignment}.{name}"]) for alignment in alignments for name in METRICS)

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the table."""
        document: dict[str, Any] = {
            "split": self.split,
            "views_per_distance": self.views_per_distance,
            "truth_sigma_m": self.truth_sigma_m,
            "views": self.views,
            "of_views": self.of_views,
        }
        document = {key: value for key, value in document.items() if value is not None}
        columns = (*table_columns(self.kind), *REFERENCES)
        written = nested({column.place: column.json_value(self) for column in columns})
        if self.kind != METRIC:
            nulls = dict.fromkeys(("rank_error", "native", "scaled", "scale_median"))
            written = _relative_object(written, nulls, self["aligned_robust.error"])
        document |= {
            "views_scored": self.views_scored,
            "coverage": written.pop("coverage"),
            "ranked": self.ranked,
            **written,
            "published": None if self.published is None else asdict(self.published),
            "ci95": nested({place: rounded_interval(ends) for place, ends in self.intervals.items()}),
        }
        if self.groups:
            document["groups"] = {
                grouping: {group: table.to_dict() for group, table in tables.items()}
                for grouping, tables in self.groups.items()
            }
        return document


def tabulate(frame: Frame, truth: Truth, kind: str = METRIC, declaration: Declaration = NOT_DECLARED) -> Table:
    """Return the table of a config from the numbers of its scored views, with tables of groups if it has splits.

    Scenes are resampled for the intervals of a config with splits, single views for those of a survey, blocks of
    consecutive views otherwise. A config without views is not ranked, and neither are predictions that are not
    metric, nor a submission that declares the use of ground truth. An infinite metric (of a prediction so large
    that its square overflows) is written as null; the rank error is always finite.
    """

    table = _table_of_views(frame, truth, kind, declaration)
    if truth.split is None:
        return table
    groups = {
        key: {
            group: _table_of_views(frame.take(positions), truth, kind, declaration)
            for group, positions in positions_by_group(grouping, truth.traits).items()
        }
        for key, grouping in GROUPINGS.items()
    }
    return replace(table, groups=groups)


def _table_of_views(views: Frame, truth: Truth, kind: str, declaration: Declaration) -> Table:
    """Return the table of views of a config, all of them or a group, without groups."""
    if not len(views):
        kind = METRIC  # Without views there is nothing of any kind.
    columns = interval_columns(kind)
    intervals: dict[str, Interval | None] = dict.fromkeys(column.place for column in columns)
    if len(views):
        resampling = resample_views(
            views.view_ids, by_scene=truth.split is not None, views_per_distance=truth.views_per_distance
        )
        values = column_values(views, columns)
        intervals = column_intervals(bootstrap_estimates(values, columns, resampling), values, columns, resampling)
    return Table(
        kind=kind,
        views=len(views),
        views_scored=int(np.count_nonzero(views["coverage"] > 0)),
        ranked=kind == METRIC and len(views) > 0 and not declaration.uses_ground_truth,
        numbers={one.place: _summary(one, views) for one in (*table_columns(kind), *REFERENCES)},
        intervals=intervals,
        split=truth.split,
        views_per_distance=truth.views_per_distance,
        truth_sigma_m=truth.truth_sigma_m,
        published=truth.published,
    )


def _summary(column: Column, views: Frame) -> float:
    """Return the number of a table in a column: NaN without values, inf if one overflowed."""
    values = views[column.place_in_view]
    defined = values[~np.isnan(values)].tolist()
    if not defined:
        return math.nan
    if column.statistic == "median":
        return float(statistics.median(defined))
    # Correctly rounded, so that the order of the views has no effect.
    return float(sum(defined)) if column.statistic == "count" else mean(defined)


def column_values(views: Frame, columns: Sequence[Column]) -> Float64[ndarray, "n k"]:
    """Return the ``columns`` of each view, one row per view; NaN where it has no value."""
    return np.column_stack([views[column.place_in_view] for column in columns])


def bootstrap_estimates(
    values: Float64[ndarray, "n k"], columns: Sequence[Column], resampling: Resampling
) -> Float64[ndarray, "draws k"]:
    """Return the table's ``columns`` in each resample of ``column_values``; NaN where undefined."""
    draws = resampling.means(values)
    for k, column in enumerate(columns):
        if column.statistic == "median":
            draws[:, k] = resampling.medians(values[:, k])
    return draws


def column_intervals(
    estimates: Float64[ndarray, "draws k"],
    values: Float64[ndarray, "n k"],
    columns: Sequence[Column],
    resampling: Resampling,
) -> dict[str, Interval | None]:
    """Return the interval of each of ``columns`` from its estimates; ``values`` is NaN where it has none."""
    return {
        column.place: interval(estimates[:, k], resampling.blocks(np.flatnonzero(~np.isnan(values[:, k]))))
        for k, column in enumerate(columns)
    }
