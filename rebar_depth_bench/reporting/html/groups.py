"""Section of the report with the tables of groups of views: by cage family, distance and bar width."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.rows import Cell, ScoreRow, cells, table_row
from rebar_depth_bench.scoring.columns import NATIVE, ONE_PIXEL, SCALED, SCALED_CONSTANT, with_reference
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.table import Table


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
