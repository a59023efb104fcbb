"""Result of scoring one submission, written and read by the same classes.

The classes mirror the JSON. Unknown keys are ignored, because results of later versions have more of them.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, FailFast, Field, GetPydanticSchema, Strict, TypeAdapter
from pydantic_core import core_schema

from rebar_depth_bench.base.errors import InputError, Problem, printable
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.base.reading import parse_json
from rebar_depth_bench.base.validation import field_error, one_of, validate_document
from rebar_depth_bench.scoring import frames
from rebar_depth_bench.scoring.bootstrap import INTERVALS
from rebar_depth_bench.scoring.columns import (
    ALIGNED,
    ALIGNED_CONSTANT,
    COVERAGE,
    RELATIVE_ALIGNMENTS,
    RELATIVE_COLUMNS,
    VIEW_COLUMNS,
    Column,
    Share,
)
from rebar_depth_bench.scoring.formatting import result_notes, summary
from rebar_depth_bench.scoring.protocol import PROTOCOL, RELATIVE_PROTOCOL
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND
from rebar_depth_bench.scoring.table import (
    Count,
    Flag,
    Name,
    Table,
    TableJson,
    ViewJson,
    check_tables,
)
from rebar_depth_bench.submission.declaration import INPUTS, METRIC, Declaration

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.extended.result import ExtendedResult

_MAX_CONFIGS_SHOWN = 10
_ERRORS = ("rank_error", *RELATIVE_ALIGNMENTS)


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
    uses_ground_truth: Flag | None = None


@dataclass(frozen=True)
class SoftwareIdentity:
    """Version of the software that scored."""

    version: Name


@dataclass(frozen=True)
class IntervalMethod:
    """How intervals were computed."""

    method: Name
    draws: Count
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

    ``prediction`` is the kind of predictions that are not metric, ``declared_prediction`` that of an archive which
    was scored as another. ``intervals`` states how the intervals were computed; None in a file of an earlier
    version. ``extended`` are the extended measures, None in a result that was read from a file.
    """

    protocol: Annotated[str, Strict(), one_of(PROTOCOL, RELATIVE_PROTOCOL)] = PROTOCOL
    prediction: Annotated[str, Strict(), one_of(*ALIGNMENT_BY_KIND)] | None = None
    declared_prediction: Annotated[str, Strict(), one_of(METRIC)] | None = None
    dataset: DatasetIdentity
    submission: SubmissionIdentity
    software: SoftwareIdentity
    intervals: IntervalMethod | None = field(default_factory=lambda: IntervalMethod(**INTERVALS))
    tables: Annotated[dict[Name, TableJson], BeforeValidator(check_tables)]
    views: Annotated[list[ViewJson], FailFast()]
    extended: Annotated[ExtendedResult | None, _EXTENDED] = None

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.submission.method

    @property
    def kind(self) -> str:
        """Kind of its predictions, one of ``PREDICTION_KINDS``."""
        return self.prediction or METRIC

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the numbers of its views."""
        if self.prediction is None:
            return VIEW_COLUMNS
        return (COVERAGE, *ALIGNED, *ALIGNED_CONSTANT) if self.prediction == "scale" else RELATIVE_COLUMNS

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
            return frames.views_frame(self)
        if rows == "extended" and self.extended is not None:
            return self.extended.to_pandas()
        expected = "'tables', 'groups', 'views', or 'extended' for a result that has them"
        raise ValueError(f"rows is {rows!r}, expected {expected}")

    @property
    def metrics(self) -> dict[str, float]:
        """Numbers of the tables by config and place in the JSON, as "lattice/native/abs_rel"; NaN if undefined."""
        values = {
            f"{name}/{column.path.replace('.', '/')}": column.value(table)
            for name, table in self.tables.items()
            for column in self.columns
        }
        return {name: math.nan if value is None else float(value) for name, value in values.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the numbers."""
        return tuple(result_notes(self))

    def __str__(self) -> str:
        """Return the main numbers of each config as a table, what the submission declares, and the notes."""
        shown = summary(self)
        rows = [shown.heads, *shown.rows]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows
        ]
        return "\n".join([*lines, shown.declared, *shown.notes])

    def __repr__(self) -> str:
        """Return the method, the numbers of the first ten configs, and the number of views."""
        shown = [f"  {printable(name)}: {_describe_table(table)}" for name, table in self.tables.items()]
        omitted = [f"  ... and {len(shown) - _MAX_CONFIGS_SHOWN} more"] if len(shown) > _MAX_CONFIGS_SHOWN else []
        head = f"<Result of {printable(self.method)}: {len(shown)} configs, {len(self.views)} views"
        return "\n".join([head, *shown[:_MAX_CONFIGS_SHOWN], *omitted]) + ">"

    def _repr_html_(self) -> str:
        """Return the summary for notebooks."""
        shown = summary(self)
        head = "".join(f"<th>{escape(cell)}</th>" for cell in shown.heads)
        rows = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in shown.rows)
        body = "".join(f"<tr>{row}</tr>" for row in rows)
        lines = "".join(f"<p>{escape(line)}</p>" for line in (shown.declared, shown.provenance, *shown.notes))
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{lines}"

    def to_json(self) -> bytes:
        """Return the result as UTF-8 JSON; the same archive and dataset give the same bytes on every machine."""
        return (json.dumps(self.to_dict(), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


@cache
def _result_type() -> TypeAdapter[Result]:
    return TypeAdapter(Annotated[Result, AfterValidator(_check_views)])


def _check_views(result: Result) -> Result:
    view_ids = [view.view_id for view in result.views]
    if len(set(view_ids)) < len(view_ids):
        raise field_error("views: a view_id occurs twice", "each view once", "duplicate")
    if not {config_of(view_id) for view_id in view_ids} <= result.tables.keys():
        raise field_error("views: a view belongs to no config of the tables", "views of these", "conflict")
    if (result.protocol == RELATIVE_PROTOCOL) != (result.prediction is not None):
        found = f"the protocol is {result.protocol} and prediction is {result.prediction}"
        raise field_error(found, f"{RELATIVE_PROTOCOL} for predictions that are not metric", "conflict")
    if result.declared_prediction and result.prediction is None:
        raise field_error("declared_prediction without prediction", "the kind that was scored", "missing")
    by_kind = {None: "rank_error", "scale": "aligned, constant"}
    expected = by_kind.get(result.prediction, ", ".join(RELATIVE_ALIGNMENTS))
    groups = [one for table in result.tables.values() for group in table.groups.values() for one in group.values()]
    for one in (*result.tables.values(), *groups, *result.views):
        found = ", ".join(name for name in _ERRORS if getattr(one, name) is not None)
        if found != expected and not (isinstance(one, Table) and one.views == 0):
            raise field_error(f"a table or view has {found or 'no errors'}", expected, "conflict")
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


def _describe_table(table: Table) -> str:
    if table.aligned is not None and table.constant is not None:
        return f"aligned error {table.aligned.error:.4g}, constant {table.constant.error:.4g}, not ranked"
    if table.native is None or table.scaled is None:
        return "no predictions"
    note = "" if table.ranked else ", not ranked"
    error = "" if table.rank_error is None else f"rank error {table.rank_error:.4g}, "
    return f"{error}AbsRel {table.native.abs_rel:.4g} native, {table.scaled.abs_rel:.4g} scaled{note}"
