"""The list of numbers: where each stands in the JSON, how it is summarised over views, and how it is shown.

A number has one name everywhere, its place in the JSON, such as ``"native.abs_rel"`` or ``"within_mm.5"``. The
numbers of a view or a table are a flat mapping of places to floats: NaN where a number is undefined, inf where it
overflowed; both are null in the JSON. JSON, frames, CSV, intervals and comparisons have all columns of a kind of
predictions; terminal, LaTeX and HTML show their groups. A number of a new kind needs a column in ``DISTRIBUTION``
and its computation in ``view_numbers``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import ROUND_FLOOR, Decimal
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Literal

from rebar_depth_bench.base.errors import InputError, escape_text
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from rebar_depth_bench.scoring.bootstrap import Interval
    from rebar_depth_bench.scoring.table import Table, ViewScore

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
    """Return a share in per cent, rounded to one decimal; a dash if undefined."""
    return DASH if share is None or math.isnan(share) else f"{share * 100:.1f}"


def coverage_percent(share: float | None) -> str:
    """Return a coverage, or another share with a threshold, in per cent with one decimal, rounded down.

    Incomplete coverage is therefore never shown as 100 %, and coverage below the threshold never as reaching it.
    """
    if share is None or math.isnan(share):
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

    ``place`` is its place in the JSON of a table, keys joined by dots; ``view_place`` is its place in a view if
    that differs. ``title`` names it, ``unit`` belongs to the shown value, which is the value times ``factor`` with
    ``decimals``. ``as_text``, if set, makes the text of the value. ``head`` is a heading of three lines for narrow
    columns. ``statistic`` makes the number of a table from the numbers of its views: mean, median, or the count of
    views for which it is true. ``has_interval`` states whether it has a 95 % interval. Values are from 0 to
    ``most``. Views without predictions have only numbers that are ``of_all_views``.
    """

    place: str
    title: str
    unit: str = ""
    better: Better = ""
    decimals: int = 4
    factor: float = 1.0
    as_text: Callable[[float | None], str] | None = None
    head: str = ""
    view_place: str = ""
    of_all_views: bool = False
    statistic: Literal["mean", "median", "count"] = "mean"
    has_interval: bool = True
    most: float = math.inf

    @property
    def name(self) -> str:
        """Name of the column in frames and CSV."""
        return _frame_name(self.place)

    @property
    def view_name(self) -> str:
        """Name of the column in frames of views."""
        return _frame_name(self.place_in_view)

    @property
    def place_in_view(self) -> str:
        """Place of the number in the JSON of a view."""
        return self.view_place or self.place

    @property
    def heading(self) -> str:
        """Title with unit and better direction."""
        arrow = ARROWS[self.better]
        return f"{self.title}{f', {self.unit}' if self.unit else ''}{f' {arrow}' if arrow else ''}"

    def cell(self, scores: Table | ViewScore) -> Cell:
        """Return the cell of a number of a table, with its interval, or of a view, which has none."""
        return self.value_cell(scores.number(self), scores.interval(self))

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
        return "" if ends is None else separator.join(map(self.text, ends))

    def json_value(self, table: Table) -> float | None:
        """Return the number of a table as it is written in JSON and CSV; None if it is undefined or not finite."""
        value = rounded(table[self.place])
        return int(value) if self.statistic == "count" and value is not None else value

    def view_json_value(self, view: ViewScore) -> float | bool | None:
        """Return the number of a view as it is written in JSON and CSV; None if undefined or not finite."""
        value = rounded(view[self.place_in_view])
        return bool(value) if self.statistic == "count" and value is not None else value


def _frame_name(place: str) -> str:
    parts = place.removeprefix("reference.").split(".")
    if parts[-2:-1] == ["within_mm"]:
        parts[-2:] = [f"within_{parts[-1]}mm"]
    return "_".join(parts)


def check_place(place: str) -> None:
    """Raise ``InputError`` unless a number has this place in a table or view."""
    if place not in _PLACES:
        close = get_close_matches(place, _PLACES, n=1)
        raise InputError(f"{escape_text(place)} is no number, expected {close[0] if close else 'native.abs_rel'}")


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by place as a JSON object: a place that has dots stands in objects of their own."""
    document: dict[str, Any] = {}
    for place, value in values.items():
        *groups, key = place.split(".")
        inner = document
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[key] = value
    return document


def at_place(document: Any, place: str) -> Any:
    """Return the value at a place of a JSON object; None where it is missing."""
    for key in place.split("."):
        document = document.get(key) if isinstance(document, dict) else None
    return document


def range_text(ends: Interval | None, as_text: Callable[[float], str]) -> str:
    """Return an interval as text, a dash if it is undefined."""
    return DASH if ends is None else " to ".join(map(as_text, ends))


METRICS: Mapping[str, Column] = {
    "abs_rel": Column("abs_rel", "AbsRel", better="lower", decimals=4),
    "rmse_cm": Column("rmse_cm", "RMSE", "cm", "lower", 2),
    "mae_cm": Column("mae_cm", "MAE", "cm", "lower", 2),
    "delta1": Column("delta1", "δ1", "", "higher", 3, most=1.0),
}
"""Presentation of each field of ``DepthMetrics``, in order, in all tables and pages."""


def _aligned(alignment: str, column: Column) -> Column:
    return replace(
        column,
        place=f"{alignment}.{column.place}",
        title=f"{alignment} {column.title}".replace("_", " "),
        head=f"{alignment.removeprefix('aligned_')}\n{column.title} {ARROWS[column.better]}\n{column.unit}",
        has_interval=not column.place.startswith("within_mm"),
    )


def _reference(kind: str, name: str) -> Column:
    metric = METRICS[name]
    return Column(
        place=f"reference.{kind}.{name}",
        title=f"{metric.title} of {kind}",
        unit=metric.unit,
        decimals=metric.decimals,
        head=f"{'1 pixel' if kind == 'one_pixel' else 'const.'}\n{metric.title}\n{metric.unit}",
        has_interval=False,
    )


# Columns of metric predictions.

COVERAGE = Column(
    "coverage",
    "coverage",
    unit="%",
    better="higher",
    decimals=1,
    factor=100.0,
    as_text=coverage_percent,
    head="cover-\nage ↑\n%",
    of_all_views=True,
    most=1.0,
)
RANK_ERROR = Column(
    "rank_error", "rank error", better="lower", head="rank\nerror ↓\n", of_all_views=True, most=1.0
)
NATIVE, SCALED = (
    tuple(_aligned(alignment, one) for one in METRICS.values()) for alignment in ("native", "scaled")
)
SCALE = Column(
    "scale_median", "scale s, median", decimals=3, head="scale\ns\n", view_place="scale", statistic="median"
)
WITHIN = tuple(
    Column(
        f"within_mm.{tolerance_mm}",
        f"within {tolerance_mm} mm",
        unit="%",
        better="higher",
        decimals=1,
        factor=100.0,
        as_text=percent,
        head=f"within\n{tolerance_mm} mm\n% ↑",
        of_all_views=True,
        most=1.0,
    )
    for tolerance_mm in WITHIN_MM
)
DISTRIBUTION: tuple[Column, ...] = WITHIN
"""Columns of the distribution of native errors over the pixels of a view, which tables and pages show together."""

REFERENCE_ERRORS = ("abs_rel", "rmse_cm")
"""Metrics that have reference errors."""
CONSTANT, ONE_PIXEL, SCALED_CONSTANT = (
    tuple(_reference(kind, name) for name in REFERENCE_ERRORS)
    for kind in ("constant", "one_pixel", "scaled_constant")
)
REFERENCES = (*CONSTANT, *ONE_PIXEL, *SCALED_CONSTANT)
"""Columns of the reference errors of a config."""

PAPER_COLUMNS = (NATIVE[1], NATIVE[0], SCALED[0], SCALE)
"""Columns of the paper's Table I: RMSE and AbsRel native, AbsRel scaled, and the median s."""

TABLE_COLUMNS = (RANK_ERROR, COVERAGE, WITHIN[WITHIN_MM.index(5)])
"""Columns of tables of several methods before those of the paper's Table I."""

# Columns of predictions that are not metric.

ALIGNED_METRICS = (
    Column("error", "error", better="lower", of_all_views=True, most=1.0),
    *METRICS.values(),
    *WITHIN,
)
"""Columns of the numbers of an alignment, whose places begin at it."""
RELATIVE_ALIGNMENTS = ("aligned", "aligned_robust", "constant")
"""Alignments of predictions that are not metric: by their kind, its robust variant, and its constant."""
ALIGNED, ALIGNED_ROBUST, ALIGNED_CONSTANT = (
    tuple(_aligned(alignment, one) for one in ALIGNED_METRICS) for alignment in RELATIVE_ALIGNMENTS
)
"""Columns of these: the error over all scored pixels, the metrics, and the shares within a tolerance."""
FLAT_VIEWS = Column(
    "flat_views", "views without positive slope", view_place="is_flat", statistic="count", has_interval=False
)

# The list, by kind of predictions, in the order of the JSON.

METRIC_COLUMNS = (COVERAGE, RANK_ERROR, *NATIVE, *SCALED, SCALE, *DISTRIBUTION)
RELATIVE_COLUMNS = (COVERAGE, *ALIGNED, *ALIGNED_ROBUST, *ALIGNED_CONSTANT)
_METRIC_VIEW_COLUMNS = (COVERAGE, RANK_ERROR, SCALE, *NATIVE, *SCALED, *DISTRIBUTION)
_BY_PLACE: Mapping[str, Column] = {
    one.place: one for one in (*METRIC_COLUMNS, *REFERENCES, *RELATIVE_COLUMNS, FLAT_VIEWS)
}

_PLACES = {"scored_px", *_BY_PLACE, *(one.place_in_view for one in _BY_PLACE.values())}


def table_columns(kind: str) -> tuple[Column, ...]:
    """Return the columns of a table of a kind of predictions, without those of reference errors."""
    return METRIC_COLUMNS if kind == METRIC else (*RELATIVE_COLUMNS, FLAT_VIEWS)


def view_columns(kind: str) -> tuple[Column, ...]:
    """Return the columns of a view of a kind of predictions."""
    return _METRIC_VIEW_COLUMNS if kind == METRIC else (*RELATIVE_COLUMNS, FLAT_VIEWS)


def interval_columns(kind: str) -> tuple[Column, ...]:
    """Return the columns of a table that have intervals."""
    return tuple(column for column in table_columns(kind) if column.has_interval)


def columns_at(*places: str) -> tuple[Column, ...]:
    """Return the columns of a config's table at ``places``, such as ``native.abs_rel``."""
    return tuple(_BY_PLACE[place] for place in places)


def with_reference(columns: Sequence[Column]) -> list[Column]:
    """Return the columns of the metrics that have reference errors."""
    return [column for column in columns if column.place.rpartition(".")[2] in REFERENCE_ERRORS]


def texts(columns: Sequence[Column], table: Table) -> list[str]:
    """Return the numbers of a table as text."""
    return [column.text(table.number(column)) for column in columns]
