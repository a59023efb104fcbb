"""Result of scoring one submission: identities, tables, the numbers of views, and their JSON, frames and text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from html import escape
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, Strict

from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.base.validation import one_of
from rebar_depth_bench.scoring.bootstrap import INTERVALS
from rebar_depth_bench.scoring.columns import (
    ALIGNED,
    ALIGNED_CONSTANT,
    COVERAGE,
    METRIC_COLUMNS,
    RELATIVE_COLUMNS,
    Column,
)
from rebar_depth_bench.scoring.formatting import result_notes, summary
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.spreadsheet import tables_sheet, views_sheet
from rebar_depth_bench.scoring.table import Frame, Name, Table, ViewScore
from rebar_depth_bench.submission.declaration import INPUTS, METRIC, Declaration

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.extended.estimates import ExtendedResult

_MAX_CONFIGS_SHOWN = 10


@dataclass(frozen=True)
class DatasetIdentity:
    """Identity of the dataset."""

    digest: Annotated[str, Strict(), Field(pattern="^sha256:[0-9a-f]{64}$")]
    version: Name


@dataclass(frozen=True)
class SubmissionIdentity:
    """Method name of a submission, SHA-256 of its archive in hexadecimal, and what it declares.

    ``sha256`` is None if the predictions were not written to an archive.
    """

    method: Name
    sha256: Annotated[str, Strict(), Field(pattern="^[0-9a-f]{64}$")] | None
    inputs: Annotated[str, Strict(), one_of(*INPUTS)] | None = None
    uses_ground_truth: Annotated[bool, Strict()] | None = None


@dataclass(frozen=True)
class SoftwareIdentity:
    """Version of the software that scored."""

    version: Name


@dataclass(frozen=True)
class IntervalMethod:
    """How intervals were computed."""

    method: Name
    draws: Annotated[int, Strict(), Field(ge=0, lt=1 << 53)]
    level: Annotated[float, Strict(), Field(ge=0, le=1)]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Result:
    """Result of scoring one submission, with the digests and versions of its inputs.

    ``tables`` and ``frames`` have the numbers of each config and of its views. ``prediction`` is the kind of
    predictions that are not metric, ``declared_prediction`` the kind of an archive which was scored as another.
    ``intervals`` states how the intervals were computed; None in a file of an earlier
    version. ``extended`` are the extended measures, None in a result that was read from a file.
    """

    dataset: DatasetIdentity
    submission: SubmissionIdentity
    software: SoftwareIdentity
    tables: Mapping[str, Table]
    frames: Mapping[str, Frame]
    protocol: str = PROTOCOL
    prediction: str | None = None
    declared_prediction: str | None = None
    intervals: IntervalMethod | None = field(default_factory=lambda: IntervalMethod(**INTERVALS))
    extended: ExtendedResult | None = None

    def __eq__(self, other: object) -> bool:
        """Return whether another result has the same JSON."""
        return self.to_dict() == other.to_dict() if isinstance(other, Result) else NotImplemented

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
        """Columns of its metrics, those without a robust alignment for predictions up to a scale."""
        if self.kind == METRIC:
            return METRIC_COLUMNS
        return (COVERAGE, *ALIGNED, *ALIGNED_CONSTANT) if self.kind == "scale" else RELATIVE_COLUMNS

    @property
    def views(self) -> list[ViewScore]:
        """Numbers of all views."""
        return [view for frame in self.frames.values() for view in frame.views()]

    @property
    def declared(self) -> Declaration:
        """What the submission declares about its inputs and its use of ground truth."""
        return Declaration(self.submission.inputs, self.submission.uses_ground_truth)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-compatible object; extended measures, if computed, are its last entry."""
        document = {
            "protocol": self.protocol,
            "prediction": self.prediction,
            "declared_prediction": self.declared_prediction,
            "dataset": asdict(self.dataset),
            "submission": asdict(self.submission),
            "software": asdict(self.software),
            "intervals": None if self.intervals is None else asdict(self.intervals),
            "tables": {name: table.to_dict() for name, table in self.tables.items()},
            "views": [view.to_dict(self.kind) for view in self.views],
            "extended": None if self.extended is None else self.extended.to_dict(),
        }
        return {key: value for key, value in document.items() if value is not None}

    def to_pandas(
        self,
        rows: Literal["tables", "groups", "views", "extended", "bars", "spacings", "crossings"] = "tables",
    ) -> DataFrame:
        """Return the numbers of the JSON as a frame.

        ``"tables"`` has one row per config, with the 95 % interval of each metric in the columns
        ``<metric>_low`` and ``<metric>_high``; ``"groups"`` has one row per group of views of each config with
        splits, with the same columns; ``"views"`` has one row per view.

        Of a result with extended measures, ``"extended"`` has one row per config, alignment and measure; and of
        native predictions, ``"bars"`` has one row per judged straight part of a bar and view, ``"spacings"`` one
        per pair of judged neighbours, and ``"crossings"`` one per judged crossing (``extended.frames``). Raises
        ``InputError`` for these if there are no extended measures, and ``ValueError`` for other rows.
        """
        if rows in ("tables", "groups"):
            return tables_sheet([self], groups=rows == "groups").to_pandas()
        if rows == "views":
            return views_sheet(self).to_pandas()
        if rows not in ("extended", "bars", "spacings", "crossings"):
            expected = "'tables', 'groups', 'views', 'extended', 'bars', 'spacings' or 'crossings'"
            raise ValueError(f"rows is {rows!r}, expected {expected}")
        if self.extended is None:
            found = f"rows is {rows} and the result has no extended measures"
            raise InputError(f"{found}, expected one of score(..., extended=True) or evaluate(..., extended=True)")
        sheet = self.extended.to_sheet() if rows == "extended" else self.extended.to_samples_sheet(rows)
        return sheet.to_pandas()

    @property
    def metrics(self) -> dict[str, float]:
        """Numbers of the tables by config and place in the JSON, as "lattice/native/abs_rel"; NaN if undefined."""
        return {
            f"{name}/{column.place.replace('.', '/')}": table[column.place]
            for name, table in self.tables.items()
            for column in self.columns
        }

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


def _describe_table(table: Table) -> str:
    if table.kind != METRIC:
        return f"aligned error {table['aligned.error']:.4g}, constant {table['constant.error']:.4g}, not ranked"
    if not table.views_scored:
        return "no predictions"
    errors = f"AbsRel {table['native.abs_rel']:.4g} native, {table['scaled.abs_rel']:.4g} scaled"
    return f"rank error {table['rank_error']:.4g}, {errors}{'' if table.ranked else ', not ranked'}"
