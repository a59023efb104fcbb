"""Parser of result JSON.

The models ignore unknown keys, because results of later versions have more of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Self

from pydantic import BeforeValidator, ConfigDict, FailFast, Field, Strict, model_validator

from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.names import SPLITS, config_of
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.published_match import PublishedMatch
from rebar_depth_bench.scoring.reference import Reference
from rebar_depth_bench.scoring.result import Result, Table
from rebar_depth_bench.scoring.view_score import VIEW_METRICS, ViewScore
from rebar_depth_bench.submission.declaration import INPUTS, Declaration
from rebar_depth_bench.validation import Expected, StrictModel, field_error, one_of, text, validate_table


def read_result(data: bytes, where: str) -> Result:
    """Return the result in ``data`` without extended measures; ``where`` names the source in error messages.

    Raises ``InputError`` with all problems if ``data`` is not a result of ``PROTOCOL``.
    """
    if len(data) > JSON_BYTES.value():
        problem = Problem("size", "", f"the result has {len(data)} bytes", JSON_BYTES.allowed())
        raise InputError.from_problems(where, [problem])
    document, problems = parse_json(data)
    content = None if problems else validate_table(_ResultJson, document, problems)
    if content is None:
        raise InputError.from_problems(f"{where}: is not a rebar-bench result", problems)
    return Result(
        protocol=content.protocol,
        method=content.submission.method,
        declared=Declaration(content.submission.inputs, content.submission.uses_ground_truth),
        submission_sha256=content.submission.sha256,
        dataset_digest=content.dataset.digest,
        dataset_version=content.dataset.version,
        software_version=content.software.version,
        tables={config: table.content() for config, table in content.tables.items()},
        views=[view.content() for view in content.views],
        intervals=None if content.intervals is None else vars(content.intervals),
    )


def read_table(table: Mapping[str, Any]) -> Table:
    """Return the table of a config from its JSON object, without groups.

    Raises ``InputError`` if it is invalid.
    """
    problems: list[Problem] = []
    content = validate_table(_TableJson, table, problems)
    if content is None:
        raise InputError.from_problems("the table of a result", problems)
    return content.content()


class StoredModel(StrictModel):
    """Base class of the objects of a result."""

    model_config = ConfigDict(extra="ignore")


_NAME_CHARACTERS = 300
_MAX_ENTRIES = 5000
"""Largest number of entries of a JSON object whose keys are names."""
Name = Annotated[str, text(_NAME_CHARACTERS)]
# Constraints of pydantic's core are checked without Python code: the leaderboard reads a table for each row.
_Count = Annotated[int, Field(ge=0, lt=1 << 53)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Size = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Bound = Annotated[float, Field(allow_inf_nan=False)] | None
_Interval = Annotated[tuple[_Bound, _Bound], Strict(False)] | None
_TOLERANCES = {str(tolerance_mm): tolerance_mm for tolerance_mm in WITHIN_MM}
_VIEW_METRIC_KEYS = [(name, *name.partition(".")[::2]) for name in VIEW_METRICS]


def _check_length(table: object) -> object:
    """Return ``table``; raise the error of a field if it has so many entries that their errors take minutes."""
    if isinstance(table, dict) and len(table) > _MAX_ENTRIES:
        raise field_error(f"got {len(table)} entries", f"at most {_MAX_ENTRIES}", "size")
    return table


LIMITED = BeforeValidator(_check_length)
"""Annotation of a JSON object whose keys are names."""
_Intervals = Annotated[dict[str, _Interval], LIMITED]


def _has_tolerances(within_mm: Mapping[str, object]) -> bool:
    return within_mm.keys() >= _TOLERANCES.keys()


_WITHIN = Expected(f"a share for each of {', '.join(_TOLERANCES)} mm", _has_tolerances)


class _MetricsJson(StoredModel):
    """Metrics of a view or table; null where a metric overflowed, or all of them without predictions."""

    abs_rel: _Size | None
    rmse_cm: _Size | None
    mae_cm: _Size | None
    delta1: _Share | None

    def content(self) -> DepthMetrics:
        """Return the metrics; null is an overflow (``inf``)."""
        values = (self.abs_rel, self.rmse_cm, self.mae_cm, self.delta1)
        return DepthMetrics(*[math.inf if value is None else value for value in values])


class _AlignedJson(StoredModel):
    """Metrics of both alignments, which may be null without predictions."""

    coverage: _Share | None
    native: _MetricsJson | None
    scaled: _MetricsJson | None

    @property
    def is_predicted(self) -> bool:
        """Whether there is a prediction."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _check_metrics(self) -> Self:
        if self.is_predicted and (self.native is None or self.scaled is None):
            raise field_error("native or scaled is null", "metrics where there is a prediction", "conflict")
        return self

    def metrics(self, values: _MetricsJson | None) -> DepthMetrics | None:
        """Return metrics, None without predictions."""
        return values.content() if self.is_predicted and values is not None else None


class _ErrorsJson(StoredModel):
    """Reference errors of one kind."""

    abs_rel: _Size | None = None
    rmse_cm: _Size | None = None


class _ReferenceJson(StoredModel):
    """Reference errors of a config."""

    constant: _ErrorsJson = _ErrorsJson()
    one_pixel: _ErrorsJson = _ErrorsJson()
    scaled_constant: _ErrorsJson = _ErrorsJson()

    def content(self) -> Reference:
        """Return the reference errors."""
        constant, one_pixel = self.constant, self.one_pixel
        return Reference(constant.abs_rel, constant.rmse_cm, one_pixel.abs_rel, one_pixel.rmse_cm)


class _PublishedJson(StoredModel):
    """Scene of the paper's Table I."""

    scene: Name
    same_optics: bool


class _IntervalsJson(StoredModel):
    """95 % intervals, nested like the metrics; a missing interval is undefined."""

    coverage: _Interval = None
    rank_error: _Interval = None
    native: _Intervals = Field(default={})
    scaled: _Intervals = Field(default={})
    scale_median: _Interval = None
    within_mm: _Intervals = Field(default={})

    def content(self) -> dict[str, tuple[float, float] | None]:
        """Return the interval of each of ``VIEW_METRICS``."""
        values = vars(self)
        return {
            name: _defined(values[group].get(key) if key else values[group])
            for name, group, key in _VIEW_METRIC_KEYS
        }


def _defined(interval: tuple[float | None, float | None] | None) -> tuple[float, float] | None:
    if interval is None or interval[0] is None or interval[1] is None:
        return None
    return interval[0], interval[1]


class _TableJson(_AlignedJson):
    """Table of a config or of a group of its views."""

    views: _Count
    views_scored: _Count
    ranked: bool
    scale_median: _Size | None
    within_mm: Annotated[dict[str, _Share | None], _WITHIN, LIMITED]
    rank_error: _Share | None
    reference: _ReferenceJson
    published: _PublishedJson | None = None
    split: Annotated[str, one_of(*SPLITS)] | None = None
    truth_sigma_m: _Size | None = None
    ci95: _IntervalsJson = _IntervalsJson()

    @property
    def is_predicted(self) -> bool:
        """Whether a view has a prediction."""
        return self.views_scored > 0

    def content(self) -> Table:
        """Return the table."""
        return Table(
            views=self.views,
            views_scored=self.views_scored,
            coverage=self.coverage,
            ranked=self.ranked and self.rank_error is not None,
            rank_error=self.rank_error,
            reference=self.reference.content(),
            scaled_constant=(self.reference.scaled_constant.abs_rel, self.reference.scaled_constant.rmse_cm),
            published=None if self.published is None else PublishedMatch(**vars(self.published)),
            split=self.split,
            truth_sigma_m=self.truth_sigma_m,
            native=self.metrics(self.native),
            scaled=self.metrics(self.scaled),
            scale_median=self.scale_median,
            within_mm={tolerance_mm: self.within_mm[key] for key, tolerance_mm in _TOLERANCES.items()},
            intervals=self.ci95.content(),
        )


_Groups = dict[Name, dict[Name, _TableJson]]


class _ConfigTableJson(_TableJson):
    """Table of a config, with the tables of groups of its views, which have no groups of their own."""

    groups: _Groups = Field(default={})

    def content(self) -> Table:
        """Return the table."""
        groups = {
            grouping: {group: table.content() for group, table in tables.items()}
            for grouping, tables in self.groups.items()
        }
        return replace(super().content(), groups=groups)


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


class _ViewJson(_AlignedJson):
    """Scores of a view."""

    view_id: Name
    scored_px: _Count
    coverage: _Share
    rank_error: _Share
    scale: _Size | None
    within_mm: Annotated[dict[str, _Share], _WITHIN, LIMITED]

    @property
    def is_predicted(self) -> bool:
        """Whether the view has a prediction."""
        return self.coverage > 0

    def content(self) -> ViewScore:
        """Return the view's scores."""
        return ViewScore(
            view_id=self.view_id,
            scored_px=self.scored_px,
            coverage=self.coverage,
            rank_error=self.rank_error,
            scale=self.scale,
            native=self.metrics(self.native),
            scaled=self.metrics(self.scaled),
            within_mm={tolerance_mm: self.within_mm[key] for key, tolerance_mm in _TOLERANCES.items()},
        )


class DatasetJson(StoredModel):
    """Identity of the dataset."""

    digest: Annotated[str, Field(pattern="^sha256:[0-9a-f]{64}$")]
    version: Name


class SubmissionJson(StoredModel):
    """Identity of the submission."""

    method: Name
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    inputs: Annotated[str, one_of(*INPUTS)] | None = None
    uses_ground_truth: bool | None = None


class SoftwareJson(StoredModel):
    """Version of the software that scored."""

    version: Name


class _MethodJson(StoredModel):
    """How intervals were computed."""

    method: Name
    draws: _Count
    level: _Share


class _ResultJson(StoredModel):
    """Content of a result file."""

    protocol: Annotated[str, one_of(PROTOCOL)]
    dataset: DatasetJson
    submission: SubmissionJson
    software: SoftwareJson
    intervals: _MethodJson | None = None
    tables: Annotated[dict[Name, _ConfigTableJson], BeforeValidator(_check_tables)]
    views: Annotated[list[_ViewJson], FailFast()]

    @model_validator(mode="after")
    def _check_views(self) -> Self:
        view_ids = [view.view_id for view in self.views]
        if len(set(view_ids)) < len(view_ids):
            raise field_error("views: a view_id occurs twice", "each view once", "duplicate")
        if not {config_of(view_id) for view_id in view_ids} <= self.tables.keys():
            raise field_error("views: a view belongs to no config of the tables", "views of these", "conflict")
        groups = [
            table
            for tables in self.tables.values()
            for group in tables.groups.values()
            for table in group.values()
        ]
        if any(table.views and table.rank_error is None for table in (*self.tables.values(), *groups)):
            raise field_error("a table of views has no rank_error", "one in each of them", "missing")
        return self
