"""Table rows of configs, views and groups of views: cells with their text and sort value."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.columns import (
    ARROWS,
    COVERAGE,
    METRICS,
    NATIVE,
    ONE_PIXEL,
    RANK_ERROR,
    SCALE,
    SCALED,
    SCALED_CONSTANT,
    WITHIN,
    Column,
    with_reference,
)
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.table import Table, ViewScore

METRIC_HEADS = tuple((metric.title, metric.unit, ARROWS[metric.better]) for metric in METRICS.values())
"""Name, unit and better direction of each metric, for the headings of tables."""


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
    return ScoreRow(
        name=formatting.config_title(name, table.split),
        views=Cell(table.scored_of_views, table.views_scored),
        coverage=cell(COVERAGE, table),
        rank_error=cell(RANK_ERROR, table),
        ranked=table.ranked,
        notes=formatting.table_notes(table),
        findings=formatting.reference_findings(table),
        native=cells(NATIVE, table),
        scaled=cells(SCALED, table),
        scale=cell(SCALE, table),
        within=cells(WITHIN, table),
    )


def view_row(view: ViewScore) -> ScoreRow:
    """Return the row of a view; its ``views`` cell holds the number of scored pixels."""
    return ScoreRow(
        name=printable(view.view_id),
        views=Cell(f"{view.scored_px:,}".replace(",", "\N{NARROW NO-BREAK SPACE}"), view.scored_px),
        coverage=cell(COVERAGE, view),
        rank_error=cell(RANK_ERROR, view),
        ranked=True,
        notes=[],
        findings=[],
        native=cells(NATIVE, view),
        scaled=cells(SCALED, view),
        scale=cell(SCALE, view),
        within=cells(WITHIN, view),
    )


def cells(columns: Sequence[Column], scores: Table | ViewScore) -> list[Cell]:
    """Return the cell of each column."""
    return [cell(column, scores) for column in columns]


def cell(column: Column, scores: Table | ViewScore) -> Cell:
    """Return the cell of a number of a config, with its interval, or of a view."""
    if isinstance(scores, ViewScore):
        value, interval = column.view_value(scores), ""
    else:
        value, interval = column.value(scores), column.interval_text(scores.intervals.get(column.path))
    return Cell(column.text(value), value if value is not None and math.isfinite(value) else None, interval)


@dataclass(frozen=True)
class GroupRow:
    """Cells of a group; the lists have the errors ``columns.REFERENCE_ERRORS``."""

    row: ScoreRow
    native: list[Cell]
    one_pixel: list[Cell]
    scaled: list[Cell]
    constant: list[Cell]


@dataclass(frozen=True)
class GroupTable:
    """Table of the groups of one grouping; ``definition`` is empty if a later version has defined the grouping."""

    title: str
    definition: str
    rows: list[GroupRow]


@dataclass(frozen=True)
class ConfigGroups:
    """Tables of the groups of a config with splits."""

    name: str
    tables: list[GroupTable]


def config_groups(tables: Mapping[str, Table]) -> list[ConfigGroups]:
    """Return the tables of groups of each config that has any."""
    return [
        ConfigGroups(
            formatting.config_title(config, table.split),
            [_group_table(grouping, groups) for grouping, groups in table.groups.items() if groups],
        )
        for config, table in tables.items()
        if any(table.groups.values())
    ]


def _group_table(grouping: str, groups: Mapping[str, Table]) -> GroupTable:
    definition = GROUPINGS[grouping].definition if grouping in GROUPINGS else ""
    rows = [_group_row(group, table) for group, table in groups.items()]
    return GroupTable(formatting.grouping_title(grouping), definition, rows)


def _group_row(group: str, table: Table) -> GroupRow:
    return GroupRow(
        table_row(group, replace(table, split=None)),
        native=cells(with_reference(NATIVE), table),
        one_pixel=cells(ONE_PIXEL, table),
        scaled=cells(with_reference(SCALED), table),
        constant=cells(SCALED_CONSTANT, table),
    )
