"""Ranking of a config as shown in its table and plot: submitted rows, and the paper's rows, which are unranked.

Rows are filtered, sorted and divided into pages on the server, so that an address shows the same rows to everyone.
The columns define what ``?sort=NAME`` sorts by.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import itemgetter
from typing import Any
from urllib.parse import urlencode

from markupsafe import Markup

from leaderboard.db.rankings import LeaderboardEntry, Ranking
from leaderboard.names import confused_scripts
from leaderboard.web.pages.disclosed import disclosed_row
from leaderboard.web.pages.rendering import MAX_INTERVALS_PLOTTED, DisplayTime, Link, format_time, link
from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.charts.scatter import ScatterPoint, scatter_chart
from rebar_depth_bench.reporting.formatting import interval_note, reference_rows
from rebar_depth_bench.reporting.html.published import (
    PaperRow,
    finite_interval,
    published_mark,
    published_row,
    scatter_points,
)
from rebar_depth_bench.reporting.html.rows import ScoreRow, table_row
from rebar_depth_bench.reporting.published import OTHER_OPTICS_NOTE, load_published
from rebar_depth_bench.scoring.disclosure import DisclosedTable
from rebar_depth_bench.scoring.metrics import METRICS
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.scoring.result_io import read_table
from rebar_depth_bench.submission.metadata import INPUTS

PAGE_ROWS = 50
"""Number of submitted rows on a page of a config."""
RANK = "rank"
_MAX_QUERY_CHARACTERS = 100
TableJson = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A sortable column: its name in URLs, the path of its value in a table's JSON, whether more is better."""

    name: str
    path: tuple[str, ...]
    largest_first: bool

    def value(self, table: TableJson) -> float | None:
        """Return the value, or None if it is undefined or hidden."""
        found: Any = table
        for key in self.path:
            found = found.get(key) if isinstance(found, dict) else None
        return found if isinstance(found, int | float) else None


NATIVE = tuple(
    Column(name.removesuffix("_cm"), ("native", name), info.higher_is_better) for name, info in METRICS.items()
)
SCALED = tuple(
    Column(f"scaled_{column.name}", ("scaled", column.path[1]), column.largest_first) for column in NATIVE
)
WITHIN = tuple(Column(f"within_{t}mm", ("within_mm", str(t)), True) for t in WITHIN_MM)
RANK_ERROR, SCALE = Column("rank_error", ("rank_error",), False), Column("scale", ("scale_median",), False)
COVERAGE = Column("coverage", ("coverage",), True)
COLUMNS = {column.name: column for column in (RANK_ERROR, *NATIVE, *SCALED, SCALE, *WITHIN, COVERAGE)}
METHOD = "method"


@dataclass(frozen=True)
class Selection:
    """Rows of a page: their order (a name of ``COLUMNS``, ``rank`` or ``method``), filters, and the page's number.

    Best first, or worst first if ``inverted``. ``text`` is searched in the names of methods and submitters.
    """

    order: str = RANK
    inverted: bool = False
    inputs: str | None = None
    text: str = ""
    page: int = 1

    @property
    def is_descending(self) -> bool:
        """Whether values decrease from top to bottom."""
        return (self.order in COLUMNS and COLUMNS[self.order].largest_first) != self.inverted

    def heading(self, name: str) -> str | None:
        """Return the ``aria-sort`` value of a column's heading, or None if the rows are not sorted by it."""
        if name != self.order:
            return None
        return "descending" if self.is_descending else "ascending"

    def sorted_by(self, name: str) -> Selection:
        """Return the selection of a column's link: best first, or inverted if the rows are sorted by it."""
        inverted = name == self.order and not self.inverted
        return replace(self, order=name, inverted=inverted, page=1)

    def of_class(self, inputs: str | None) -> Selection:
        """Return the selection of the rows that declare ``inputs``."""
        return replace(self, inputs=inputs, page=1)

    def at_page(self, page: int) -> Selection:
        """Return the selection of another page."""
        return replace(self, page=page)

    def query(self, **others: str | None) -> str:
        """Return the URL query of the selection, after the parameters ``others``."""
        sort = f"{'-' * self.inverted}{self.order}"
        values = {
            **others,
            "inputs": self.inputs,
            "q": self.text,
            "sort": "" if sort == RANK else sort,
            "page": "" if self.page == 1 else str(self.page),
        }
        return urlencode({name: value for name, value in values.items() if value})

    def matches(self, entry: LeaderboardEntry) -> bool:
        """Return whether a row passes the filters."""
        text = self.text.casefold()
        return (self.inputs is None or entry.inputs == self.inputs) and (
            text in entry.method.casefold() or text in entry.submitter.casefold()
        )


def parse_selection(sort: str | None, inputs: str | None, text: str | None, page: int | None) -> Selection:
    """Return the selection of URL parameters; invalid values are replaced by their defaults."""
    name = (sort or RANK).removeprefix("-")
    if name not in (RANK, METHOD, *COLUMNS):
        sort, name = None, RANK
    return Selection(
        order=name,
        inverted=bool(sort) and sort != name,
        inputs=inputs if inputs in INPUTS else None,
        text=(text or "").strip()[:_MAX_QUERY_CHARACTERS],
        page=max(1, page or 1),
    )


def sort_indices(rows: Sequence[tuple[LeaderboardEntry, TableJson]], selection: Selection) -> list[int]:
    """Return the indices that sort the rows; missing values come last in both directions."""

    def key(entry: LeaderboardEntry, table: TableJson) -> float | str | None:
        if selection.order == METHOD:
            return entry.method.casefold()
        return entry.rank if selection.order == RANK else COLUMNS[selection.order].value(table)

    keys = [key(entry, table) for entry, table in rows]
    present = [(value, index) for index, value in enumerate(keys) if value is not None]
    missing = [index for index, value in enumerate(keys) if value is None]
    present.sort(key=itemgetter(0), reverse=selection.is_descending)
    return [index for _, index in present] + missing


_CACHED_ROWS = 4096


@dataclass(frozen=True)
class RankingLine:
    """A submitted row as displayed; ``scripts`` are those that its name mixes and that resemble each other."""

    rank: int | None
    rank_range: tuple[int, int] | None
    class_rank: int | None
    submission_id: str
    submitter: str
    inputs: str | None
    uses_ground_truth: bool | None
    link: Link | None
    when: DisplayTime
    scripts: list[str]
    row: ScoreRow


@dataclass(frozen=True)
class ConfigRanking:
    """Table and plot of a config.

    ``row_count`` is the number of rows that pass the filters, ``lines`` the rows of the page, ``references`` the
    rows of reference errors (name, native and scaled cells), ``published`` the rows of the paper and ``distance``
    their camera distance. ``plotted`` is the number of points of submissions. ``interval_note`` explains the
    confidence intervals.
    """

    config: str
    selection: Selection
    row_count: int
    pages: int
    references: list[tuple[str, list[str], list[str]]]
    lines: list[RankingLine]
    published: list[PaperRow]
    distance: str
    chart: Markup | None
    plotted: int
    interval_note: str

    @property
    def interval(self) -> bool:
        """Whether any number is shown with a confidence interval."""
        return any(line.row.has_interval() for line in self.lines)

    @property
    def dash(self) -> bool:
        """Whether any number is shown as undefined."""
        return any(line.row.has_dash() for line in self.lines)

    @property
    def rank_ranges(self) -> bool:
        """Whether any rank is shown with its range."""
        return any(line.rank_range for line in self.lines)

    @property
    def dagger(self) -> bool:
        """Whether any published row took its scale from the ground truth."""
        return any(row.dagger for row in self.published)


@dataclass(frozen=True)
class _FormattedRow:
    """A row, and its table unless the ground truth is hidden."""

    table: Table | None
    row: ScoreRow


def make_config_ranking(
    ranking: Ranking,
    config: str,
    selection: Selection,
    hidden_truth: bool,
    page_rows: int = PAGE_ROWS,
    max_plotted: int | None = None,
) -> ConfigRanking:
    """Return the selected rows of a config, ``page_rows`` on a page.

    The chart has a point for every selected row; there is none if that makes more than ``max_plotted`` points.
    """
    rows = [(entry, _parse_table(entry.table_json)) for entry in ranking.entries if selection.matches(entry)]
    pages = max(1, -(-len(rows) // page_rows))
    selection = selection.at_page(min(selection.page, pages))
    start = (selection.page - 1) * page_rows
    shown = [rows[index][0] for index in sort_indices(rows, selection)[start : start + page_rows]]
    formatted = [_format_row(entry.method, entry.table_json, hidden_truth) for entry in shown]
    published, distance = _published(formatted)
    points = _plot_points(rows)
    chart = None
    if points and (max_plotted is None or len(points) <= max_plotted):
        title = f"{printable(config)}: native and scaled AbsRel"
        chart = scatter_chart(title, [*points, *scatter_points(published, {})])
    return ConfigRanking(
        config=printable(config),
        selection=selection,
        row_count=len(rows),
        pages=pages,
        references=_references(formatted),
        lines=[_ranking_line(entry, numbers.row) for entry, numbers in zip(shown, formatted, strict=True)],
        published=published,
        distance=distance,
        chart=chart,
        plotted=len(points),
        interval_note=interval_note(row.table for row in formatted if row.table),
    )


def _references(formatted: Sequence[_FormattedRow]) -> list[tuple[str, list[str], list[str]]]:
    """Return the reference rows, which every table of the current protocol contains."""
    tables = (row.table for row in formatted if row.table)
    return next((rows for table in tables if (rows := reference_rows(table.reference))), [])


@lru_cache(maxsize=_CACHED_ROWS)
def _parse_table(table_json: str) -> TableJson:
    """Return a table's JSON object; cached, because most rows stay the same when the content changes."""
    table: TableJson = json.loads(table_json)
    return table


@lru_cache(maxsize=_CACHED_ROWS)
def _format_row(method: str, table_json: str, hidden_truth: bool) -> _FormattedRow:
    """Return the formatted numbers of a row; cached, because they depend on the arguments only."""
    if hidden_truth:
        return _FormattedRow(None, disclosed_row(method, DisclosedTable.model_validate_json(table_json)))
    table = read_table(json.loads(table_json))
    return _FormattedRow(table, table_row(method, replace(table, split=None)))


def _ranking_line(entry: LeaderboardEntry, row: ScoreRow) -> RankingLine:
    return RankingLine(
        rank=entry.rank,
        rank_range=entry.rank_range,
        class_rank=entry.class_rank,
        submission_id=entry.submission_id,
        submitter=printable(entry.submitter),
        inputs=entry.inputs,
        uses_ground_truth=entry.uses_ground_truth,
        link=link(entry.url),
        when=format_time(entry.created_at),
        scripts=confused_scripts(entry.method),
        row=row,
    )


def _plot_points(rows: Sequence[tuple[LeaderboardEntry, TableJson]]) -> list[ScatterPoint]:
    """Return the points of all rows with both errors; each is labelled by its rank, "–" if it is not ranked."""
    columns = (NATIVE[0], SCALED[0])
    points = []
    for entry, table in rows:
        native, scaled = (column.value(table) for column in columns)
        if native is None or scaled is None:
            continue
        intervals = [
            _interval(table, ".".join(column.path)) if len(rows) <= MAX_INTERVALS_PLOTTED else None
            for column in columns
        ]
        mark = "–" if entry.rank is None else str(entry.rank)
        points.append(ScatterPoint(mark, entry.method, native, scaled, False, *intervals))
    return points


def _interval(table: TableJson, name: str) -> tuple[float, float] | None:
    ends = table.get("ci95", {})
    for key in name.split("."):
        ends = ends.get(key) if isinstance(ends, dict) else None
    if not isinstance(ends, list) or len(ends) != 2 or not all(isinstance(end, int | float) for end in ends):
        return None
    return finite_interval((ends[0], ends[1]))


def _published(formatted: Sequence[_FormattedRow]) -> tuple[list[PaperRow], str]:
    """Return the paper's rows of the scene that the config shows, and their camera distance."""
    match = next((match for row in formatted if row.table and (match := row.table.published)), None)
    scene = load_published().scenes.get(match.scene) if match else None
    if match is None or scene is None:
        return [], ""
    rows = [published_row(published_mark(k), row) for k, row in enumerate(scene.rows)]
    return rows, scene.distance if match.same_optics else f"{scene.distance} {OTHER_OPTICS_NOTE}"
