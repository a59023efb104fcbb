"""Table rows of configs and views: cells with their text and sort value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.metrics import METRIC_NAMES, DepthMetrics
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.scoring.view_score import ViewScore


@dataclass(frozen=True)
class Cell:
    """Table cell: formatted number, sort value (None if missing, sorted last), and interval text or ""."""

    text: str
    value: float | None
    interval: str = ""


@dataclass(frozen=True)
class ScoreRow:
    """Formatted cells of one config or view, for the tables of errors and of coverage.

    ``notes`` say why a row is not ranked or compared, ``findings`` set its errors beside the reference errors.
    """

    name: str
    views: Cell
    coverage: Cell
    rank_error: Cell
    ranked: bool
    notes: list[str]
    findings: list[str]
    native: list[Cell]
    scaled: list[Cell]
    scale: Cell
    within: list[Cell]

    def has_dash(self) -> bool:
        """Return whether any number of the row is undefined."""
        return formatting.has_dash([[cell.text for cell in self._cells]])

    def has_interval(self) -> bool:
        """Return whether any number of the row has an interval."""
        return any(cell.interval for cell in self._cells)

    @property
    def _cells(self) -> list[Cell]:
        return [self.rank_error, *self.native, *self.scaled, self.scale, self.coverage, *self.within]


def table_row(name: str, table: Table) -> ScoreRow:
    """Return the row of a config, with a printable name and intervals."""
    intervals = table.intervals
    within_intervals = [formatting.interval_cell(intervals.get(f"within_mm.{t}"), 1, 100.0) for t in WITHIN_MM]
    return ScoreRow(
        name=formatting.config_title(name, table.split),
        views=Cell(f"{table.views_scored}/{table.views}", table.views_scored),
        coverage=_cell(
            formatting.coverage_percent(table.coverage),
            table.coverage,
            formatting.coverage_interval_cell(intervals.get("coverage")),
        ),
        rank_error=_cell(
            formatting.rank_error_cell(table.rank_error),
            table.rank_error,
            formatting.interval_cell(intervals.get("rank_error"), 4),
        ),
        ranked=table.ranked,
        notes=formatting.table_notes(table),
        findings=formatting.reference_findings(table),
        native=_metric_cells(table.native, formatting.metric_interval_cells(intervals, "native")),
        scaled=_metric_cells(table.scaled, formatting.metric_interval_cells(intervals, "scaled")),
        scale=_cell(
            formatting.scale_cell(table.scale_median),
            table.scale_median,
            formatting.interval_cell(intervals.get("scale_median"), 3),
        ),
        within=_cells(
            formatting.within_cells(table.within_mm), [table.within_mm[t] for t in WITHIN_MM], within_intervals
        ),
    )


def view_row(view: ViewScore) -> ScoreRow:
    """Return the row of a view; its ``views`` cell holds the number of scored pixels."""
    no_intervals = [""] * len(METRIC_NAMES)
    return ScoreRow(
        name=printable(view.view_id),
        views=Cell(f"{view.scored_px:,}".replace(",", "\N{NARROW NO-BREAK SPACE}"), view.scored_px),
        coverage=_cell(formatting.coverage_percent(view.coverage), view.coverage),
        rank_error=_cell(formatting.rank_error_cell(view.rank_error), view.rank_error),
        ranked=True,
        notes=[],
        findings=[],
        native=_metric_cells(view.native, no_intervals),
        scaled=_metric_cells(view.scaled, no_intervals),
        scale=_cell(formatting.scale_cell(view.scale), view.scale),
        within=_cells(
            formatting.within_cells(view.within_mm), [view.within_mm[t] for t in WITHIN_MM], [""] * len(WITHIN_MM)
        ),
    )


def number_cells(texts: Sequence[str], values: Sequence[float | None]) -> list[Cell]:
    """Return cells of numbers without intervals."""
    return _cells(texts, values, [""] * len(texts))


def _metric_cells(metrics: DepthMetrics | None, intervals: Sequence[str]) -> list[Cell]:
    values = [getattr(metrics, name, None) for name in METRIC_NAMES]
    return _cells(formatting.metric_cells(metrics), values, intervals)


def _cells(texts: Sequence[str], values: Sequence[float | None], intervals: Sequence[str]) -> list[Cell]:
    return [_cell(*parts) for parts in zip(texts, values, intervals, strict=True)]


def _cell(text: str, value: float | None, interval: str = "") -> Cell:
    return Cell(text, value if value is not None and math.isfinite(value) else None, interval)
