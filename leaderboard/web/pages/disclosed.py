"""Rows and context of pages if the ground truth is hidden: the disclosed numbers, and nothing else of a result."""

from __future__ import annotations

from typing import Any

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.rows import Cell, ScoreRow
from rebar_depth_bench.scoring.disclosure import DECIMALS, DisclosedTable, read_disclosed
from rebar_depth_bench.scoring.metrics import METRIC_NAMES
from rebar_depth_bench.scoring.protocol import WITHIN_MM

_EMPTY = Cell("", None)


def disclosed_row(name: str, table: DisclosedTable) -> ScoreRow:
    """Return the row of a config or submission; the cells of numbers that are not disclosed are empty."""
    metrics = [_EMPTY] * len(METRIC_NAMES)
    return ScoreRow(
        name=printable(name),
        views=_EMPTY,
        coverage=Cell(formatting.coverage_percent(table.coverage), table.coverage),
        rank_error=Cell(formatting.number(table.rank_error, DECIMALS), table.rank_error),
        ranked=table.ranked and table.rank_error is not None,
        notes=[],
        findings=[],
        native=metrics,
        scaled=metrics,
        scale=_EMPTY,
        within=[_EMPTY] * len(WITHIN_MM),
    )


def disclosed_context(data: bytes, where: str) -> dict[str, Any]:
    """Return the context of a submission's page from its disclosed result. Raises ``InputError`` if it is none."""
    result = read_disclosed(data, where)
    rows = [disclosed_row(name, table) for name, table in result.tables.items()]
    return {"scored": True, "result_protocol": result.protocol, "configs": rows}
