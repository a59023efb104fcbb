"""Configs and views as rows of cells: what the tables of the page show and what they sort by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Table, ViewScore


@dataclass(frozen=True)
class Cell:
    """A number as it is spelled, as it sorts (None: missing, always last), and its interval (empty: none)."""

    text: str
    value: float | None
    interval: str = ""


@dataclass(frozen=True)
class Row:
    """One config or one view, spelled: the cells of both tables."""

    name: str
    views: Cell
    coverage: Cell
    ranked: bool
    reasons: str
    native: list[Cell]
    scaled: list[Cell]
    scale: Cell
    within: list[Cell]

    def has_dash(self) -> bool:
        """Return whether any number of the row is undefined."""
        cells = [*self.native, *self.scaled, self.scale, self.coverage, *self.within]
        return formatting.has_dash([[cell.text for cell in cells]])

    def has_interval(self) -> bool:
        """Return whether any number of the row has an interval."""
        return any(cell.interval for cell in [*self.native, *self.scaled, self.scale, self.coverage, *self.within])


def table_row(name: str, table: Table) -> Row:
    """Return a config's row; names come out printable, numbers with their intervals."""
    found = table.intervals
    within = [formatting.interval_cell(found.get(f"within_mm.{t}"), 1, 100.0) for t in WITHIN_MM]
    return Row(
        name=formatting.printable(name),
        views=Cell(f"{table.views_scored}/{table.views}", table.views_scored),
        coverage=_cell(
            formatting.coverage_percent(table.coverage),
            table.coverage,
            formatting.coverage_interval_cell(found.get("coverage")),
        ),
        ranked=table.ranked,
        reasons="; ".join(formatting.unranked_reasons(table)),
        native=_metric_cells(table.native, formatting.metric_interval_cells(found, "native")),
        scaled=_metric_cells(table.scaled, formatting.metric_interval_cells(found, "scaled")),
        scale=_cell(
            formatting.scale_cell(table.scale_median),
            table.scale_median,
            formatting.interval_cell(found.get("scale_median"), 3),
        ),
        within=_cells(formatting.within_cells(table.within_mm), [table.within_mm[t] for t in WITHIN_MM], within),
    )


def view_row(view: ViewScore) -> Row:
    """Return a view's row; its ``views`` cell holds the number of scored pixels."""
    none = [""] * len(formatting.METRIC_HEADS)
    return Row(
        name=formatting.printable(view.view_id),
        views=Cell(f"{view.scored_px:,}".replace(",", "\N{NARROW NO-BREAK SPACE}"), view.scored_px),
        coverage=_cell(formatting.coverage_percent(view.coverage), view.coverage),
        ranked=True,
        reasons="",
        native=_metric_cells(view.native, none),
        scaled=_metric_cells(view.scaled, none),
        scale=_cell(formatting.scale_cell(view.scale), view.scale),
        within=_cells(formatting.within_cells(view.within_mm), [view.within_mm[t] for t in WITHIN_MM], none),
    )


def _metric_cells(metrics: DepthMetrics | None, intervals: Sequence[str]) -> list[Cell]:
    values = [metrics.abs_rel, metrics.rmse_cm, metrics.mae_cm, metrics.delta1] if metrics else [None] * 4
    return _cells(formatting.metric_cells(metrics), values, intervals)


def _cells(texts: Sequence[str], values: Sequence[float | None], intervals: Sequence[str]) -> list[Cell]:
    return [_cell(*parts) for parts in zip(texts, values, intervals, strict=True)]


def _cell(text: str, value: float | None, interval: str = "") -> Cell:
    return Cell(text, value if value is not None and math.isfinite(value) else None, interval)
