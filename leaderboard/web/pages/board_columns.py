"""Columns of a config's table on the page: headings, cells, sorting and spans all follow the list ``COLUMNS``.

The other numbers of a result are in the CSV, and on the page of the submission.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from leaderboard.db.rankings import LeaderboardEntry
from rebar_depth_bench.scoring import columns
from rebar_depth_bench.scoring.columns import Cell, Column, at_place

RANK, METHOD = "rank", "method"


def seconds_text(seconds: float | None) -> str:
    """Return a time with at least three significant digits; empty if there is none."""
    if seconds is None:
        return ""
    return f"{seconds:.3g}" if seconds < 100 else columns.number(seconds, 0)


RUNTIME = Column("seconds_per_view", "runtime", "s", "lower", as_text=seconds_text)
"""Runtime per view, which the submitter declares."""


@dataclass(frozen=True)
class BoardColumn:
    """Column of a config's table.

    ``name`` sorts by it in addresses, ``unit`` is the second line of its heading, and ``style`` its CSS class.
    ``number`` is what a row of reference errors or of the paper may have, too; it is None for rank and method.
    """

    name: str
    heading: str
    unit: str = ""
    number: Column | None = None
    style: str = ""

    def value(self, entry: LeaderboardEntry) -> Any:
        """Return the value of a submission's row by which rows are sorted; None if it has none."""
        if self.number is not None:
            return at_place(entry.declared if self.number is RUNTIME else entry.table, self.number.place)
        return entry.rank if self.name == RANK else entry.method.casefold()

    def cell(self, entry: LeaderboardEntry) -> Cell:
        """Return the cell of the number of a submission's row; that of the rank error has an interval."""
        assert self.number is not None, "the template writes the cells of rank and method"
        has_interval = self.number is columns.RANK_ERROR
        return self.number.value_cell(
            self.value(entry), entry.table.get("ci95", {}).get("rank_error") if has_interval else None
        )


COLUMNS = (
    BoardColumn(RANK, "Rank", style="rank"),
    BoardColumn(METHOD, "Method", "submitter, date", style="name"),
    BoardColumn("rank_error", "Rank error", "", columns.RANK_ERROR),
    BoardColumn("coverage", "Coverage", "%", columns.COVERAGE),
    BoardColumn("abs_rel", "AbsRel", "native", columns.NATIVE[0], "native"),
    BoardColumn("rmse", "RMSE", "native, cm", columns.NATIVE[1], "native"),
    BoardColumn("scaled_abs_rel", "AbsRel", "scaled", columns.SCALED[0], "scaled"),
    BoardColumn("scaled_rmse", "RMSE", "scaled, cm", columns.SCALED[1], "scaled"),
    BoardColumn("scale", "s", "median", columns.SCALE),
    BoardColumn("within_5mm", "Within", "5 mm, %", columns.WITHIN[1]),
    BoardColumn("runtime", "Runtime", "s per view", RUNTIME),
)
COLUMNS_BY_NAME = {column.name: column for column in COLUMNS}
