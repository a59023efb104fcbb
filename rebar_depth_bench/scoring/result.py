"""Result of scoring one submission: tables by config and scores of views, written and read by the same classes.

The classes mirror the JSON, whose keys are their fields. Unknown keys are ignored, because results of later
versions have more of them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    FailFast,
    Field,
    GetPydanticSchema,
    Strict,
    TypeAdapter,
    WrapSerializer,
    create_model,
)
from pydantic_core import core_schema

from rebar_depth_bench.errors import InputError, Problem, printable
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.names import SPLITS, config_of
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.scoring import frames
from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval
from rebar_depth_bench.scoring.columns import (
    COLUMN_BY_PATH,
    VIEW_COLUMNS,
    Share,
    Size,
    json_as,
    rounded,
    rounded_interval,
)
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.reference import Reference
from rebar_depth_bench.submission.declaration import INPUTS, Declaration
from rebar_depth_bench.validation import Expected, field_error, one_of, text, validate_document

if TYPE_CHECKING:
    from pandas import DataFrame
    from pydantic import SerializerFunctionWrapHandler

    from rebar_depth_bench.extended.result import ExtendedResult

_MAX_CONFIGS_SHOWN = 10
_NOTEBOOK_COLUMNS = (
    *("config", "views", "views_scored", "coverage", "ranked", "rank_error"),
    *("native_abs_rel", "native_rmse_cm", "scaled_abs_rel", "scaled_rmse_cm", "scale_median"),
)
_NAME_CHARACTERS = 300
_MAX_ENTRIES = 5000
"""Largest number of entries of a JSON object whose keys are names."""


def _check_length(table: object) -> object:
    """Return ``table``; raise the error of a field if it has so many entries that their errors take minutes."""
    if isinstance(table, dict) and len(table) > _MAX_ENTRIES:
        raise field_error(f"got {len(table)} entries", f"at most {_MAX_ENTRIES}", "size")
    return table


LIMITED = BeforeValidator(_check_length)
"""Annotation of a JSON object whose keys are names."""
Name = Annotated[str, Strict(), text(_NAME_CHARACTERS)]
_Flag = Annotated[bool, Strict()]
_Count = Annotated[int, Strict(), Field(ge=0, lt=1 << 53)]


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


_Bound = Annotated[float, Strict(), Field(allow_inf_nan=False)] | None
_Ends = tuple[_Bound, _Bound] | None
_INTERVAL_FIELDS: dict[str, Any] = {
    column.path.partition(".")[0]: (
        (Annotated[dict[str, _Ends], LIMITED], Field({})) if "." in column.path else (_Ends, None)
    )
    for column in VIEW_COLUMNS
}
_IntervalsJson = create_model("_IntervalsJson", __config__=ConfigDict(extra="ignore"), **_INTERVAL_FIELDS)
"""Intervals nested like the numbers of a table; a missing one is undefined."""


def _flat(nested: Any) -> dict[str, Interval | None]:
    """Return the interval of each of ``VIEW_COLUMNS`` by its path."""
    found = {path: column.value(vars(nested)) for path, column in COLUMN_BY_PATH.items()}
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

    ``scaled_constant`` is that of ``Reference``, None in results that were read from a file.
    """

    view_id: Name
    scored_px: _Count
    coverage: Share
    rank_error: Share
    scale: Size | None
    native: Metrics
    scaled: Metrics
    within_mm: Annotated[
        Mapping[int, float], json_as(Annotated[dict[int, Share], _WITHIN, LIMITED, _KNOWN], dict, _write_within)
    ]
    scaled_constant: Annotated[
        tuple[float, float] | None, Field(exclude=True), BeforeValidator(lambda _: None)
    ] = None


@dataclass(frozen=True)
class PublishedMatch:
    """Scene of Table I that a config shows; ``same_optics`` is False if nothing but the optics differs."""

    scene: Name
    same_optics: _Flag


@dataclass(frozen=True, kw_only=True)
class Table:
    """Metrics of one config: means over its views, and the median of their scale factors.

    ``rank_error`` is None without views; ``reference`` are the config's reference errors,
    and ``published`` is the scene of the paper's Table I that it shows, if any. ``split`` is None
    for a config of one scene. ``truth_sigma_m`` is the standard deviation of the ground truth's depth, None where
    it is exact. ``intervals`` has the 95 % bootstrap interval of each of ``VIEW_COLUMNS``, None where undefined.
    ``groups`` has the tables of groups of views by grouping (see ``groups.GROUPINGS``) and group, of a config with
    splits; they have no groups.
    """

    split: Annotated[str, Strict(), one_of(*SPLITS)] | None = None
    truth_sigma_m: Annotated[float, Strict(), Field(ge=0)] | None = None
    views: _Count
    views_scored: _Count
    coverage: Share | None
    ranked: _Flag
    rank_error: Share | None
    native: Metrics
    scaled: Metrics
    scale_median: Size | None
    within_mm: Annotated[
        Mapping[int, float | None],
        json_as(Annotated[dict[int, Share | None], _WITHIN, LIMITED, _KNOWN], dict, _write_within),
    ]
    reference: Reference
    published: PublishedMatch | None = None
    intervals: Annotated[
        Mapping[str, Interval | None], Field(alias="ci95"), json_as(_IntervalsJson, _flat, _nested)
    ] = field(default_factory=lambda: dict.fromkeys(COLUMN_BY_PATH))
    groups: dict[Name, dict[Name, _GroupTable]] = field(default_factory=dict)

    @property
    def scored_of_views(self) -> str:
        """Numbers of the views with a prediction and of all views."""
        return f"{self.views_scored}/{self.views}"

    @property
    def is_comparable(self) -> bool:
        """Whether the errors of valid predictions can be compared with those of other submissions.

        Every view needs a prediction, the coverage must be at least ``MIN_COMPARABLE_COVERAGE``, and no metric may
        be infinite. Otherwise, missing or enormous predictions could improve the comparison.
        """
        is_complete = 0 < self.views == self.views_scored
        is_finite = all(metrics is not None and metrics.is_finite for metrics in (self.native, self.scaled))
        return is_complete and is_finite and (self.coverage or 0.0) >= MIN_COMPARABLE_COVERAGE


def _checked(scores: Any, is_predicted: bool) -> Any:
    """Return a table or view, with no metrics if it has no predictions; raise the error of a field if they lack."""
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
        "truth_sigma_m": table.truth_sigma_m is None,
        "groups": not table.groups,
    }
    return {key: value for key, value in write(table).items() if not absent.get(key)}


def _without_groups(table: Any) -> Any:
    """Return the JSON object of a table of a group, which has no groups of its own."""
    return {key: value for key, value in table.items() if key != "groups"} if isinstance(table, dict) else table


_Table = Annotated[Table, AfterValidator(_checked_table), WrapSerializer(_without_absent)]
_GroupTable = Annotated[_Table, BeforeValidator(_without_groups)]
_View = Annotated[ViewScore, AfterValidator(lambda view: _checked(view, view.coverage > 0))]


def _check_tables(tables: object) -> object:
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


@dataclass(frozen=True)
class DatasetIdentity:
    """Identity of the dataset."""

    digest: Annotated[str, Strict(), Field(pattern="^sha256:[0-9a-f]{64}$")]
    version: Name


@dataclass(frozen=True)
class SubmissionIdentity:
    """Method name of a submission, SHA-256 of its archive in hexadecimal, and what it declares."""

    method: Name
    sha256: Annotated[str, Strict(), Field(pattern="^[0-9a-f]{64}$")]
    inputs: Annotated[str, Strict(), one_of(*INPUTS)] | None = None
    uses_ground_truth: _Flag | None = None


@dataclass(frozen=True)
class SoftwareIdentity:
    """Version of the software that scored."""

    version: Name


@dataclass(frozen=True)
class IntervalMethod:
    """How intervals were computed."""

    method: Name
    draws: _Count
    level: Share


_EXTENDED = GetPydanticSchema(
    lambda *_: core_schema.no_info_plain_validator_function(
        lambda _: None,
        serialization=core_schema.plain_serializer_function_ser_schema(
            lambda extended: None if extended is None else extended.to_dict()
        ),
    )
)
"""Annotation of extended measures, which are written and not read."""
if not TYPE_CHECKING:
    ExtendedResult = Any  # Only type checkers need the class, which would be imported in a circle.


@dataclass(frozen=True, repr=False, kw_only=True)
class Result:
    """Result of scoring one submission, with the digests and versions of its inputs.

    ``intervals`` states how the intervals were computed; None in a file of an earlier version, which does not.
    ``extended`` are the extended measures, None in a result that was read from a file.
    """

    protocol: Annotated[str, Strict(), one_of(PROTOCOL)] = PROTOCOL
    dataset: DatasetIdentity
    submission: SubmissionIdentity
    software: SoftwareIdentity
    intervals: IntervalMethod | None = field(default_factory=lambda: IntervalMethod(**INTERVALS))
    tables: Annotated[dict[Name, _Table], BeforeValidator(_check_tables)]
    views: Annotated[list[_View], FailFast()]
    extended: Annotated[ExtendedResult | None, _EXTENDED] = None

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.submission.method

    @property
    def declared(self) -> Declaration:
        """What the submission declares about its inputs and its use of ground truth."""
        return Declaration(self.submission.inputs, self.submission.uses_ground_truth)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-compatible object; extended measures, if computed, are its last entry."""
        document: dict[str, Any] = _result_type().dump_python(self, mode="json", by_alias=True)
        return {key: value for key, value in document.items() if value is not None}

    def to_pandas(self, rows: Literal["tables", "groups", "views", "extended"] = "tables") -> DataFrame:
        """Return the numbers of the JSON as a frame.

        ``"tables"`` has one row per config, with the 95 % interval of each metric in the columns
        ``<metric>_low`` and ``<metric>_high``; ``"groups"`` has one row per group of views of each config with
        splits, with the same columns; ``"views"`` has one row per view; ``"extended"`` has one row per config,
        alignment and extended measure. Raises ``ValueError`` for other rows, and for ``"extended"`` if the result
        has no extended measures.
        """
        if rows == "tables":
            return frames.tables_frame([self])
        if rows == "groups":
            return frames.groups_frame([self])
        if rows == "views":
            return frames.views_frame(self.views)
        if rows == "extended" and self.extended is not None:
            return self.extended.to_pandas()
        expected = "'tables', 'groups', 'views', or 'extended' for a result that has them"
        raise ValueError(f"rows is {rows!r}, expected {expected}")

    def __repr__(self) -> str:
        """Return the method, the numbers of the first ten configs, and the number of views."""
        shown = [f"  {printable(name)}: {_describe_table(table)}" for name, table in self.tables.items()]
        omitted = [f"  ... and {len(shown) - _MAX_CONFIGS_SHOWN} more"] if len(shown) > _MAX_CONFIGS_SHOWN else []
        head = f"<Result of {printable(self.method)}: {len(shown)} configs, {len(self.views)} views"
        return "\n".join([head, *shown[:_MAX_CONFIGS_SHOWN], *omitted]) + ">"

    def _repr_html_(self) -> str:
        """Return the method, its provenance and the tables for notebooks."""
        frame = self.to_pandas()[[*_NOTEBOOK_COLUMNS]]
        frame["config"] = frame["config"].map(printable)
        provenance = f"protocol {self.protocol}, dataset {self.dataset.version} ({self.dataset.digest[:19]})"
        head = f"<p><b>{escape(printable(self.method))}</b>, {escape(printable(provenance))}</p>"
        return head + str(frame.to_html(index=False, na_rep="–", float_format="{:.4g}".format, border=0))

    def to_json(self) -> bytes:
        """Return the result as UTF-8 JSON; the same archive and dataset give the same bytes on every machine."""
        return (json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


@cache
def _result_type() -> TypeAdapter[Result]:
    return TypeAdapter(Annotated[Result, AfterValidator(_check_views)])


@cache
def _table_type() -> TypeAdapter[Table]:
    return TypeAdapter(_GroupTable)


def _check_views(result: Result) -> Result:
    view_ids = [view.view_id for view in result.views]
    if len(set(view_ids)) < len(view_ids):
        raise field_error("views: a view_id occurs twice", "each view once", "duplicate")
    if not {config_of(view_id) for view_id in view_ids} <= result.tables.keys():
        raise field_error("views: a view belongs to no config of the tables", "views of these", "conflict")
    groups = [
        table for tables in result.tables.values() for group in tables.groups.values() for table in group.values()
    ]
    if any(table.views and table.rank_error is None for table in (*result.tables.values(), *groups)):
        raise field_error("a table of views has no rank_error", "one in each of them", "missing")
    return result


def read_result(data: bytes, where: str) -> Result:
    """Return the result in ``data`` without extended measures; ``where`` names the source in error messages.

    Raises ``InputError`` with all problems if ``data`` is not a result of ``PROTOCOL``.
    """
    if len(data) > JSON_BYTES.value():
        problem = Problem("size", "", f"the result has {len(data)} bytes", JSON_BYTES.allowed())
        raise InputError.from_problems(where, [problem])
    document, problems = parse_json(data)
    if isinstance(document, dict):
        document.setdefault("intervals", None)  # Results of earlier versions do not state how they were computed.
    result = None if problems else validate_document(_result_type(), document, problems)
    if result is None:
        raise InputError.from_problems(f"{where}: is not a rebar-bench result", problems)
    return result


def read_table(table: Mapping[str, Any]) -> Table:
    """Return the table of a config from its JSON object, without groups.

    Raises ``InputError`` if it is invalid.
    """
    problems: list[Problem] = []
    found = validate_document(_table_type(), table, problems)
    if found is None:
        raise InputError.from_problems("the table of a result", problems)
    return found


def _describe_table(table: Table) -> str:
    if table.native is None or table.scaled is None:
        return "no predictions"
    note = "" if table.ranked else ", not ranked"
    error = "" if table.rank_error is None else f"rank error {table.rank_error:.4g}, "
    return f"{error}AbsRel {table.native.abs_rel:.4g} native, {table.scaled.abs_rel:.4g} scaled{note}"
