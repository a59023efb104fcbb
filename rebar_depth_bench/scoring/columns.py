"""Columns of tables: one description of every number of a result, from which all of its forms are made.

CSV, data frames, comparisons and intervals have all of ``VIEW_COLUMNS`` and ``TABLE_COLUMNS``, or of
``RELATIVE_COLUMNS`` for predictions that are not metric; terminal, LaTeX and HTML show their groups. A number of a
new kind needs a column in ``OTHERS``, a field of the classes in ``table`` and its computation in ``score``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import ROUND_FLOOR, Decimal
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import Field, GetPydanticSchema, PlainSerializer, Strict
from pydantic_core import core_schema

from rebar_depth_bench.scoring.bootstrap import Interval, Resampling, interval, resample_views
from rebar_depth_bench.scoring.protocol import WITHIN_MM

DASH = "–"
"""Text of an undefined number, which is null in the JSON."""

SIGNIFICANT_DIGITS = 12
"""Significant digits of written numbers; the last bits of sums may differ between processors."""

INTERVAL_DIGITS = 6
"""Significant digits of interval bounds, which are estimates from resamples and have no more accuracy."""

Better = Literal["lower", "higher", ""]
ARROWS: Mapping[Better, str] = {"lower": "↓", "higher": "↑", "": ""}


def rounded(value: float | None, digits: int = SIGNIFICANT_DIGITS) -> float | None:
    """Return ``value`` rounded to ``digits`` significant digits; None if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


def rounded_interval(ends: Interval | None) -> list[float | None] | None:
    """Return both ends of an interval rounded to ``INTERVAL_DIGITS``; None if the interval is None."""
    return None if ends is None else [rounded(end, INTERVAL_DIGITS) for end in ends]


def json_as(json_type: Any, read: Callable[[Any], Any], write: Callable[[Any], Any]) -> GetPydanticSchema:
    """Return the annotation of a value whose JSON is a ``json_type``, with functions from and to that JSON."""
    return GetPydanticSchema(
        lambda _, handler: core_schema.no_info_after_validator_function(
            read, handler(json_type), serialization=core_schema.plain_serializer_function_ser_schema(write)
        )
    )


# Constraints of pydantic's core are checked without Python code: the leaderboard reads a table for each row.
Share = Annotated[float, Strict(), Field(ge=0, le=1), PlainSerializer(rounded)]
Size = Annotated[float, Strict(), Field(ge=0), PlainSerializer(rounded)]
"""Types of numbers in JSON, which are written rounded."""


def _overflow(value: float | None) -> float:
    return math.inf if value is None else value


MetricShare = Annotated[float, json_as(Share | None, _overflow, rounded)]
MetricSize = Annotated[float, json_as(Size | None, _overflow, rounded)]
"""Types of metrics of valid predictions, for which null is an overflow (``inf``)."""


def number(value: float | None, decimals: int) -> str:
    """Return a number with fixed decimals, in scientific notation if these would hide it, a dash if undefined.

    Scientific notation is used below half a unit of the last decimal and from 1e6 on.
    """
    if value is None or not math.isfinite(value):
        return DASH
    if value != 0 and not 0.5 * 10**-decimals <= abs(value) < 1e6:
        return f"{value:.1e}"
    return f"{value:.{decimals}f}"


def percent(share: float | None) -> str:
    """Return a share in per cent, rounded to one decimal."""
    return DASH if share is None else f"{share * 100:.1f}"


def coverage_percent(share: float | None) -> str:
    """Return a coverage, or another share with a threshold, in per cent with one decimal, rounded down.

    Incomplete coverage is therefore never shown as 100 %, and coverage below the threshold never as reaching it.
    """
    if share is None:
        return DASH
    return str((Decimal(repr(float(share))) * 100).quantize(Decimal("0.1"), rounding=ROUND_FLOOR))


@dataclass(frozen=True)
class Cell:
    """Number of a table as text, its value (None if undefined or not finite), and its interval as text or ""."""

    text: str
    value: float | None = None
    interval: str = ""


@dataclass(frozen=True)
class Column:
    """Number of a table or view.

    ``path`` is its place in the JSON, keys joined by dots; ``of_view`` is its place in a view if that differs.
    ``title`` names it, ``unit`` is that of the shown value, which is the value times ``factor`` with ``decimals``.
    ``as_text``, if set, makes the text of the value. ``head`` is a heading of three lines for narrow columns.
    ``statistic`` makes the number of a table from those of its views. Views without predictions have only numbers
    that are ``of_all_views``.
    """

    path: str
    title: str
    unit: str = ""
    better: Better = ""
    decimals: int = 4
    factor: float = 1.0
    as_text: Callable[[float | None], str] | None = None
    head: str = ""
    of_view: str = ""
    of_all_views: bool = False
    statistic: Literal["mean", "median"] = "mean"

    @property
    def name(self) -> str:
        """Name of the column in frames and CSV."""
        parts = self.path.removeprefix("reference.").split(".")
        if parts[-2:-1] == ["within_mm"]:
            parts[-2:] = [f"within_{parts[-1]}mm"]
        return "_".join(parts)

    @property
    def heading(self) -> str:
        """Title with unit and better direction."""
        arrow = ARROWS[self.better]
        return f"{self.title}{f', {self.unit}' if self.unit else ''}{f' {arrow}' if arrow else ''}"

    def value(self, source: Any) -> Any:
        """Return the number of a table, or of the JSON object of one; None where it is undefined or missing."""
        return value_at(source, self.path)

    def view_value(self, view: Any) -> float | None:
        """Return the number of a view; None where it is undefined."""
        found: float | None = value_at(view, self.of_view or self.path)
        return found

    def interval(self, table: Any) -> Interval | None:
        """Return the interval of the number of a table; None where it is undefined or not finite."""
        ends: Interval | None = table.intervals.get(self.path)
        return ends if ends is not None and all(map(math.isfinite, ends)) else None

    def cell(self, scores: Any) -> Cell:
        """Return the cell of a number of a table, with its interval, or of a view, which has none."""
        if not hasattr(scores, "intervals"):
            return self.value_cell(self.view_value(scores))
        return self.value_cell(self.value(scores), self.interval(scores))

    def value_cell(self, value: float | None, ends: Interval | None = None) -> Cell:
        """Return the cell of a value and its interval."""
        finite = value if value is not None and math.isfinite(value) else None
        return Cell(self.text(value), finite, self.interval_text(ends))

    def text(self, value: float | None) -> str:
        """Return a value as text, a dash if it is undefined."""
        return self.number_text(value) if self.as_text is None else self.as_text(value)

    def number_text(self, value: float | None) -> str:
        """Return a value in its unit and with its decimals, also of a difference."""
        if value is not None and self.better == "lower" and abs(value) < 1e-12:
            value = 0.0  # Rounding errors of exact predictions.
        return number(None if value is None else self.factor * value, self.decimals)

    def signed_text(self, value: float | None) -> str:
        """Return a difference as text, with its sign."""
        text = self.number_text(value)
        return f"+{text}" if value is not None and value > 0 and text != DASH else text

    def interval_text(self, ends: Interval | None, separator: str = " – ") -> str:
        """Return an interval as text; empty if it is undefined."""
        if ends is None or not all(math.isfinite(end) for end in ends):
            return ""
        as_text = self.number_text if self.as_text is None or self.as_text is percent else self.as_text
        return separator.join(as_text(end) for end in ends)


def range_text(ends: Interval | None, as_text: Callable[[float], str]) -> str:
    """Return an interval as text, a dash if it is undefined."""
    return DASH if ends is None else " to ".join(map(as_text, ends))


def value_at(source: Any, path: str) -> Any:
    """Return the value at a path of attributes and keys; None where one of them is None or missing."""
    for key in path.split("."):
        if isinstance(source, Mapping):
            source = source.get(key, source.get(int(key)) if key.isdecimal() else None)
        else:
            source = getattr(source, key, None)
    return source


METRICS: Mapping[str, Column] = {
    "abs_rel": Column("abs_rel", "AbsRel", better="lower", decimals=4),
    "rmse_cm": Column("rmse_cm", "RMSE", "cm", "lower", 2),
    "mae_cm": Column("mae_cm", "MAE", "cm", "lower", 2),
    "delta1": Column("delta1", "δ1", "", "higher", 3),
}
"""Presentation of each field of ``DepthMetrics``, in order, in all tables and pages."""


def _aligned(alignment: str, metric: Column) -> Column:
    return replace(
        metric,
        path=f"{alignment}.{metric.path}",
        title=f"{alignment} {metric.title}".replace("_", " "),
        head=f"{alignment.removeprefix('aligned_')}\n{metric.title} {ARROWS[metric.better]}\n{metric.unit}",
    )


def _reference(kind: str, name: str) -> Column:
    metric = METRICS[name]
    return Column(
        path=f"reference.{kind}.{name}",
        title=f"{metric.title} of {kind}",
        unit=metric.unit,
        decimals=metric.decimals,
        head=f"{'1 pixel' if kind == 'one_pixel' else 'const.'}\n{metric.title}\n{metric.unit}",
    )


ALIGNMENTS = ("native", "scaled")
REFERENCE_ERRORS = ("abs_rel", "rmse_cm")
"""Metrics that have reference errors."""

COVERAGE = Column(
    "coverage",
    "coverage",
    "%",
    "higher",
    1,
    100.0,
    coverage_percent,
    "cover-\nage ↑\n%",
    of_all_views=True,
)
RANK_ERROR = Column("rank_error", "rank error", better="lower", head="rank\nerror ↓\n", of_all_views=True)
NATIVE, SCALED = (tuple(_aligned(alignment, one) for one in METRICS.values()) for alignment in ALIGNMENTS)
SCALE = Column(
    "scale_median", "scale s, median", decimals=3, head="scale\ns\n", of_view="scale", statistic="median"
)
WITHIN = tuple(
    Column(
        f"within_mm.{tolerance_mm}",
        f"within {tolerance_mm} mm",
        "%",
        "higher",
        1,
        100.0,
        percent,
        f"within\n{tolerance_mm} mm\n% ↑",
        of_all_views=True,
    )
    for tolerance_mm in WITHIN_MM
)
OTHERS: tuple[Column, ...] = ()
"""Columns of further numbers that every view has; tables and pages show them behind those within a tolerance."""
VIEW_COLUMNS = (COVERAGE, RANK_ERROR, *NATIVE, *SCALED, SCALE, *WITHIN, *OTHERS)
"""Columns of the numbers that every view has, and a table with an interval, in the order of the JSON."""
CONSTANT, ONE_PIXEL, SCALED_CONSTANT = (
    tuple(_reference(kind, name) for name in REFERENCE_ERRORS)
    for kind in ("constant", "one_pixel", "scaled_constant")
)
"""Columns of the reference errors of a config."""
_VIEWS, _SCORED, _RANKED = (Column(name, name.replace("_", " ")) for name in ("views", "views_scored", "ranked"))
VIEWS_SCORED = Column("scored_of_views", "views", as_text=str, head="views\nscored\n/all")
"""Column of the numbers of scored and of all views, as text; the JSON has the two numbers."""
TABLE_COLUMNS = (_VIEWS, _SCORED, COVERAGE, _RANKED, *VIEW_COLUMNS[1:], *CONSTANT, *ONE_PIXEL, *SCALED_CONSTANT)
"""Columns of a config's table in frames and CSV."""
PAPER_COLUMNS = (NATIVE[1], NATIVE[0], SCALED[0], SCALE)
"""Columns of the paper's Table I: RMSE and AbsRel native, AbsRel scaled, and the median s."""

ALIGNED_METRICS = (Column("error", "error", better="lower", of_all_views=True), *METRICS.values(), *WITHIN)
"""Columns of the numbers of an alignment, whose paths begin at it."""
RELATIVE_ALIGNMENTS = ("aligned", "aligned_robust", "constant")
"""Alignments of predictions that are not metric: that of their kind, its robust variant, and its constant."""
ALIGNED, ALIGNED_ROBUST, ALIGNED_CONSTANT = (
    tuple(_aligned(alignment, one) for one in ALIGNED_METRICS) for alignment in RELATIVE_ALIGNMENTS
)
"""Columns of these: the error over all scored pixels, the metrics, and the shares within a tolerance."""
RELATIVE_COLUMNS = (COVERAGE, *ALIGNED, *ALIGNED_ROBUST, *ALIGNED_CONSTANT)
"""Columns of the numbers of a view, and of a table, of predictions that are not metric."""
FLAT_VIEWS = Column("flat_views", "views without positive slope", of_view="is_flat")
RELATIVE_TABLE_COLUMNS = (_VIEWS, _SCORED, FLAT_VIEWS, COVERAGE, _RANKED, *RELATIVE_COLUMNS[1:])
"""Columns of a config's table of such predictions in frames and CSV."""
RELATIVE_INTERVALS = tuple(column for column in RELATIVE_COLUMNS if "within_mm" not in column.path)
"""Those of them that have intervals."""

_BY_PATH: Mapping[str, Column] = {column.path: column for column in (*TABLE_COLUMNS, *RELATIVE_COLUMNS)}


def columns_at(*paths: str) -> tuple[Column, ...]:
    """Return the columns of a config's table at ``paths``, such as ``native.abs_rel``."""
    return tuple(_BY_PATH[path] for path in paths)


def with_reference(columns: Sequence[Column]) -> list[Column]:
    """Return the columns of the metrics that have reference errors."""
    return [column for column in columns if column.path.rpartition(".")[2] in REFERENCE_ERRORS]


def has_dash(columns: Sequence[Column], scores: Any) -> bool:
    """Return whether any number of a table or view is undefined."""
    return any(column.cell(scores).value is None for column in columns)


def texts(columns: Sequence[Column], table: Any) -> list[str]:
    """Return the numbers of a table as text."""
    return [column.text(column.value(table)) for column in columns]


def view_intervals(
    views: Sequence[Any],
    columns: Sequence[Column] = VIEW_COLUMNS,
    *,
    by_scene: bool,
    views_per_distance: int | None,
) -> dict[str, Interval | None]:
    """Return the 95 % interval of each of ``columns`` by path; the keywords are those of ``resample_views``."""
    values = view_values(views, columns)
    view_ids = [view.view_id for view in views]
    resampling = resample_views(view_ids, by_scene=by_scene, views_per_distance=views_per_distance)
    return column_intervals(bootstrap_estimates(values, columns, resampling), values, columns, resampling)


def column_intervals(
    estimates: Float64[ndarray, "draws k"],
    values: Float64[ndarray, "n k"],
    columns: Sequence[Column],
    resampling: Resampling,
) -> dict[str, Interval | None]:
    """Return the interval of each of ``columns`` from its estimates; ``values`` is NaN where it has none."""
    return {
        column.path: interval(estimates[:, k], resampling.blocks(np.flatnonzero(~np.isnan(values[:, k]))))
        for k, column in enumerate(columns)
    }


def bootstrap_estimates(
    values: Float64[ndarray, "n k"], columns: Sequence[Column], resampling: Resampling
) -> Float64[ndarray, "draws k"]:
    """Return the table's ``columns`` in each resample of ``view_values``; NaN where undefined."""
    draws = resampling.means(values)
    for k, column in enumerate(columns):
        if column.statistic == "median":
            draws[:, k] = resampling.medians(values[:, k])
    return draws


def view_values(views: Sequence[Any], columns: Sequence[Column]) -> Float64[ndarray, "n k"]:
    """Return the ``columns`` of each view, one row per view; NaN where it has no value."""
    rows = [[column.view_value(view) for column in columns] for view in views]
    return np.array(rows, dtype=np.float64).reshape(len(views), len(columns))
