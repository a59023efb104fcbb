"""Tables and scores of views, with their JSON: the numbers of a result.

The classes mirror the JSON, whose keys are their fields. Unknown keys are ignored, because results of later
versions have more of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    TypeAdapter,
    WrapSerializer,
    create_model,
)

from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.base.validation import Expected, field_error, one_of, text, validate_document
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import (
    METRICS,
    RELATIVE_ALIGNMENTS,
    RELATIVE_INTERVALS,
    VIEW_COLUMNS,
    Share,
    Size,
    json_as,
    rounded,
    rounded_interval,
)
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE, WITHIN_MM
from rebar_depth_bench.scoring.reference import Reference

if TYPE_CHECKING:
    from pydantic import SerializerFunctionWrapHandler

_NAME_CHARACTERS = 300
_MAX_ENTRIES = 5000
"""Largest number of entries of a JSON object whose keys are names."""


def _check_length(table: object) -> object:
    """Return ``table``; raise the error of a field if it has so many entries that their errors take minutes."""
    if isinstance(table, dict) and len(table) > _MAX_ENTRIES:
        raise field_error(f"got {len(table)} entries", f"at most {_MAX_ENTRIES}", "size")
    return table


_LIMITED = BeforeValidator(_check_length)
"""Annotation of a JSON object whose keys are names."""
Name = Annotated[str, Strict(), text(_NAME_CHARACTERS)]
Flag = Annotated[bool, Strict()]
Count = Annotated[int, Strict(), Field(ge=0, lt=1 << 53)]


def _all_fields(metrics: DepthMetrics | None, write: SerializerFunctionWrapHandler) -> Any:
    """Return the JSON object of metrics, whose fields are null without predictions."""
    return dict.fromkeys((one.name for one in fields(DepthMetrics)), None) if metrics is None else write(metrics)


Metrics = Annotated[DepthMetrics | None, WrapSerializer(_all_fields)]
_WITHIN = Expected(
    f"a share for each of {', '.join(map(str, WITHIN_MM))} mm", lambda within: within.keys() >= set(WITHIN_MM)
)
_KNOWN = AfterValidator(lambda within: {tolerance_mm: within[tolerance_mm] for tolerance_mm in WITHIN_MM})


def _write_within(within_mm: Mapping[int, float | None]) -> dict[str, float | None]:
    return {str(tolerance_mm): rounded(share) for tolerance_mm, share in within_mm.items()}


WithinMm = Annotated[
    Mapping[int, float | None],
    json_as(Annotated[dict[int, Share | None], _WITHIN, _LIMITED, _KNOWN], dict, _write_within),
]
"""Shares of all scored pixels by tolerance in millimetres."""


@dataclass(frozen=True)
class AlignedErrors:
    """Errors of aligned depth of a view, or their means over views, as ``relative`` defines them.

    ``error`` goes over all scored pixels; the metrics over those with a value, None without any.
    """

    error: Share
    abs_rel: Size | None
    rmse_cm: Size | None
    mae_cm: Size | None
    delta1: Share | None
    within_mm: WithinMm


_Bound = Annotated[float, Strict(), Field(allow_inf_nan=False)] | None
_Ends = tuple[_Bound, _Bound] | None
_INTERVAL_FIELDS: dict[str, Any] = {
    column.path.partition(".")[0]: (
        (Annotated[dict[str, _Ends], _LIMITED], Field({})) if "." in column.path else (_Ends, None)
    )
    for column in (*VIEW_COLUMNS, *RELATIVE_INTERVALS)
}
_IntervalsJson = create_model("_IntervalsJson", __config__=ConfigDict(extra="ignore"), **_INTERVAL_FIELDS)
"""Intervals nested like the numbers of a table; a missing one is undefined."""


def _flat(nested: Any) -> dict[str, Interval | None]:
    """Return the interval of each column by its path: of ``RELATIVE_INTERVALS`` if there are any of these."""
    columns = RELATIVE_INTERVALS if nested.aligned else VIEW_COLUMNS
    found = {column.path: column.value(vars(nested)) for column in columns}
    return {path: None if ends is None or None in ends else ends for path, ends in found.items()}


def _nested(intervals: Mapping[str, Interval | None]) -> dict[str, Any]:
    """Return intervals nested like the numbers of a table."""
    nested: dict[str, Any] = {}
    for path, ends in intervals.items():
        group, _, key = path.rpartition(".")
        (nested.setdefault(group, {}) if group else nested)[key] = rounded_interval(ends)
    return nested


@dataclass(frozen=True)
class ViewScore:
    """Metrics of one view; ``scale``, ``native`` and ``scaled`` are None without valid predictions.

    ``scaled_constant`` is that of ``Reference``, None in results that were read from a file. The view of a
    prediction that is not metric has none of these but those of ``relative.align_view``.
    """

    view_id: Name
    scored_px: Count
    coverage: Share
    rank_error: Share | None = None
    scale: Size | None = None
    native: Metrics = None
    scaled: Metrics = None
    within_mm: WithinMm = field(default_factory=lambda: dict.fromkeys(WITHIN_MM))
    aligned: AlignedErrors | None = None
    aligned_robust: AlignedErrors | None = None
    constant: AlignedErrors | None = None
    is_flat: Flag | None = None
    scaled_constant: Annotated[
        tuple[float, float] | None, Field(exclude=True), BeforeValidator(lambda _: None)
    ] = None

    @property
    def error(self) -> float:
        """Rank error, or aligned error, by which views are ordered; 1 without either."""
        found = self.rank_error if self.aligned is None else self.aligned.error
        return 1.0 if found is None else found


@dataclass(frozen=True)
class PublishedMatch:
    """Scene of Table I that a config shows; ``same_optics`` is False if nothing but the optics differs."""

    scene: Name
    same_optics: Flag


@dataclass(frozen=True, kw_only=True)
class Table:
    """Metrics of one config: means over its views, and the median of their scale factors.

    ``rank_error`` is None without views; ``reference`` are the config's reference errors,
    and ``published`` is the scene of the paper's Table I that it shows, if any. ``split`` is None
    for a config of one scene. ``views_per_distance`` is that of a survey, otherwise None. ``truth_sigma_m`` is the
    standard deviation of the ground truth's depth, None where it is exact. ``of_views`` is the number of the
    config's views, None if ``views`` are all. ``intervals`` has the 95 % bootstrap interval of each of
    ``VIEW_COLUMNS``, None where undefined. A table of predictions that are not metric has the means of
    ``aligned``, ``aligned_robust`` and ``constant`` instead, with the intervals of ``RELATIVE_INTERVALS``, and the
    number of views whose fit has no positive slope.
    ``groups`` has the tables of groups of views by grouping (see ``groups.GROUPINGS``) and group, of a config with
    splits; they have no groups.
    """

    split: Annotated[str, Strict(), one_of(*SPLITS)] | None = None
    views_per_distance: Annotated[int, Strict(), Field(ge=1, lt=1 << 53)] | None = None
    truth_sigma_m: Annotated[float, Strict(), Field(ge=0)] | None = None
    views: Count
    of_views: Count | None = None
    views_scored: Count
    coverage: Share | None
    ranked: Flag
    rank_error: Share | None
    native: Metrics
    scaled: Metrics
    scale_median: Size | None
    within_mm: WithinMm
    aligned: AlignedErrors | None = None
    aligned_robust: AlignedErrors | None = None
    constant: AlignedErrors | None = None
    flat_views: Count | None = None
    reference: Reference
    published: PublishedMatch | None = None
    intervals: Annotated[
        Mapping[str, Interval | None], Field(alias="ci95"), json_as(_IntervalsJson, _flat, _nested)
    ] = field(default_factory=lambda: dict.fromkeys(column.path for column in VIEW_COLUMNS))
    groups: dict[Name, dict[Name, _GroupTable]] = field(default_factory=dict)

    @property
    def error(self) -> float | None:
        """Rank error, or aligned error, by which tables are ordered; None without either."""
        return self.rank_error if self.aligned is None else self.aligned.error

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
        return is_complete and self.is_finite and (self.coverage or 0.0) >= MIN_COMPARABLE_COVERAGE

    @property
    def is_finite(self) -> bool:
        """Whether there are metrics, and none of them overflowed."""
        if self.aligned is not None:
            errors = [getattr(self.aligned, name) for name in METRICS]
            return all(error is not None and math.isfinite(error) for error in errors)
        return all(metrics is not None and metrics.is_finite for metrics in (self.native, self.scaled))


def _checked(scores: Any, is_predicted: bool) -> Any:
    """Return a table or view, without metrics if it has no predictions; raise an error if they lack."""
    if scores.aligned is not None:
        return scores
    if not is_predicted:
        return replace(scores, native=None, scaled=None)
    if scores.native is None or scores.scaled is None:
        raise field_error("native or scaled is null", "metrics where there is a prediction", "conflict")
    return scores


def _checked_table(table: Table) -> Table:
    checked: Table = _checked(table, table.views_scored > 0)
    return replace(checked, ranked=table.ranked and table.rank_error is not None)


def _without_absent(table: Table, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
    """Return the JSON object of a table, without the keys that only some tables have."""
    absent = {
        "split": table.split is None,
        "views_per_distance": table.views_per_distance is None,
        "truth_sigma_m": table.truth_sigma_m is None,
        "groups": not table.groups,
        "of_views": table.of_views is None,
        "flat_views": table.flat_views is None,
    }
    return {key: value for key, value in _without_aligned(table, write).items() if not absent.get(key)}


def _without_aligned(scores: Any, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
    """Return the JSON object of a table or view: without the keys of aligned errors, or native and scaled null."""
    if scores.aligned is not None:
        return {**write(scores), "native": None, "scaled": None}
    return {key: value for key, value in write(scores).items() if key not in (*RELATIVE_ALIGNMENTS, "is_flat")}


def _without_groups(table: Any) -> Any:
    """Return the JSON object of a table of a group, which has no groups of its own."""
    return {key: value for key, value in table.items() if key != "groups"} if isinstance(table, dict) else table


TableJson = Annotated[Table, AfterValidator(_checked_table), WrapSerializer(_without_absent)]
_GroupTable = Annotated[TableJson, BeforeValidator(_without_groups)]
ViewJson = Annotated[
    ViewScore,
    AfterValidator(lambda view: _checked(view, view.coverage > 0)),
    WrapSerializer(_without_aligned),
]
"""Types of a table and of a view in the JSON of a result."""


def check_tables(tables: object) -> object:
    """Return ``tables``; raise the error of a field if they are too many, those of groups included."""
    count = sum(_group_tables(table) for table in tables.values()) if isinstance(tables, dict) else 0
    if count > _MAX_ENTRIES:
        raise field_error(f"got {count} tables of groups", f"at most {_MAX_ENTRIES}", "size")
    return _check_length(tables)


def _group_tables(table: object) -> int:
    """Return the number of groupings and groups of a table that has not been validated."""
    groups = table.get("groups") if isinstance(table, dict) else None
    if not isinstance(groups, dict):
        return 0
    return len(groups) + sum(len(of_grouping) for of_grouping in groups.values() if isinstance(of_grouping, dict))


@cache
def _table_type() -> TypeAdapter[Table]:
    return TypeAdapter(_GroupTable)


def read_table(table: Mapping[str, Any]) -> Table:
    """Return the table of a config from its JSON object, without groups.

    Raises ``InputError`` if it is invalid.
    """
    problems: list[Problem] = []
    found = validate_document(_table_type(), table, problems)
    if found is None:
        raise InputError.from_problems("the table of a result", problems)
    return found
