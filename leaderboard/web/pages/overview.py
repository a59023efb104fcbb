"""Overview of the ranks of all submissions across configs: one submission per row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from leaderboard.db.rankings import LeaderboardEntry
from leaderboard.db.versions import CurrentRankings
from leaderboard.web.pages.leaderboard import PAGE_ROWS, RANK, Selection
from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.formatting import number
from rebar_depth_bench.scoring.disclosure import DECIMALS as DISCLOSED_DECIMALS

MISSING_ERROR = 1.0
"""Rank error that counts where a submission lacks a config: that of no prediction at all."""
_DECIMALS, _SIGNIFICANT_DIGITS = 4, 12


@dataclass(frozen=True)
class OverviewCell:
    """Rank and rank error of a submission in a config; both are empty if it lacks the config."""

    rank: str
    error: str


@dataclass(frozen=True)
class OverviewLine:
    """A submission's ranks in all configs, and its mean rank error over them; ``rank`` is None if not ranked."""

    rank: int | None
    submission_id: str
    name: str
    submitter: str
    inputs: str | None
    mean: str
    cells: list[OverviewCell]


@dataclass(frozen=True)
class Overview:
    """Rows of a page of the overview, and the number of rows that pass the filters."""

    selection: Selection
    row_count: int
    pages: int
    lines: list[OverviewLine]


_Row = tuple[float, LeaderboardEntry, dict[str, LeaderboardEntry]]
"""Mean rank error of a submission, one of its entries, and its entries by config."""


def make_overview(
    rankings: CurrentRankings, configs: Sequence[str], selection: Selection, hidden_truth: bool
) -> Overview:
    """Return the overview, ordered by the mean rank error over ``configs``.

    A config that a submission lacks counts ``MISSING_ERROR``; results of different submissions are not combined.
    """
    decimals = DISCLOSED_DECIMALS if hidden_truth else _DECIMALS
    by_id: dict[str, dict[str, LeaderboardEntry]] = {}
    for config in configs:
        for entry in rankings.of(config).entries:
            by_id.setdefault(entry.submission_id, {})[config] = entry
    ranked: list[_Row] = []
    unranked: list[_Row] = []
    for entries in by_id.values():
        first = next(iter(entries.values()))
        mean = sum(_error(entries.get(config)) for config in configs) / len(configs)
        is_ranked = any(entry.rank is not None for entry in entries.values())
        (ranked if is_ranked else unranked).append((float(f"{mean:.{_SIGNIFICANT_DIGITS}g}"), first, entries))
    ranked.sort(key=lambda row: (row[0], row[1].created_at))
    means = [mean for mean, _, _ in ranked]
    rows: list[tuple[int | None, _Row]] = [(1 + means.index(row[0]), row) for row in ranked]
    rows += [(None, row) for row in unranked]
    if selection.order == RANK and selection.inverted:
        rows.reverse()
    rows = [row for row in rows if selection.matches(row[1][1])]
    pages = max(1, -(-len(rows) // PAGE_ROWS))
    selection = selection.at_page(min(selection.page, pages))
    start = (selection.page - 1) * PAGE_ROWS
    lines = [
        OverviewLine(
            rank=rank,
            submission_id=first.submission_id,
            name=printable(first.method),
            submitter=printable(first.submitter),
            inputs=first.inputs,
            mean=number(mean, decimals),
            cells=[_cell(entries.get(config), decimals) for config in configs],
        )
        for rank, (mean, first, entries) in rows[start : start + PAGE_ROWS]
    ]
    return Overview(selection, len(rows), pages, lines)


def _error(entry: LeaderboardEntry | None) -> float:
    return MISSING_ERROR if entry is None or entry.rank_error is None else entry.rank_error


def _cell(entry: LeaderboardEntry | None, decimals: int) -> OverviewCell:
    if entry is None:
        return OverviewCell("", "")
    return OverviewCell("–" if entry.rank is None else str(entry.rank), number(entry.rank_error, decimals))
