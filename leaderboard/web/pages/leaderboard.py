"""Ranking of a config as shown in its table and plot: submitted rows, and the paper's rows, which are unranked.

The columns define what ``?sort=NAME`` sorts by on the server, for clients without JavaScript.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter

from markupsafe import Markup

from leaderboard.db.engine import Database
from leaderboard.db.rankings import (
    LeaderboardEntry,
    RankingVersion,
    entries_of_class,
    leaderboard_entries,
    ranking_version,
)
from leaderboard.web.pages.disclosed import disclosed_row
from leaderboard.web.pages.rendering import DisplayTime, Link, format_time, link
from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.charts.scatter import ScatterPoint, scatter_chart
from rebar_depth_bench.reporting.formatting import reference_rows
from rebar_depth_bench.reporting.html.published import PaperRow, finite_interval, published_row, scatter_points
from rebar_depth_bench.reporting.html.rows import ScoreRow, table_row
from rebar_depth_bench.reporting.published import OTHER_OPTICS_NOTE, PublishedNumbers, load_published
from rebar_depth_bench.scoring.disclosure import DisclosedTable
from rebar_depth_bench.scoring.metrics import METRICS
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.scoring.result_io import read_table

Value = float | str | None


@dataclass(frozen=True)
class Column:
    """A sortable column: its name in URLs, whether larger values are better, and its value of a row."""

    name: str
    largest_first: bool
    value: Callable[[ScoreRow], Value]


def _value(group: str, index: int) -> Callable[[ScoreRow], Value]:
    """Return a function of a row that returns a value of its ``native``, ``scaled`` or ``within`` numbers."""
    return lambda row: getattr(row, group)[index].value


NATIVE = tuple(
    Column(name.removesuffix("_cm"), info.higher_is_better, _value("native", k))
    for k, (name, info) in enumerate(METRICS.items())
)
SCALED = tuple(
    Column(f"scaled_{column.name}", column.largest_first, _value("scaled", k)) for k, column in enumerate(NATIVE)
)
RANK_ERROR = Column("rank_error", False, lambda row: row.rank_error.value)
SCALE = Column("scale", False, lambda row: row.scale.value)
WITHIN = tuple(Column(f"within_{t}mm", True, _value("within", k)) for k, t in enumerate(WITHIN_MM))
COVERAGE = Column("coverage", True, lambda row: row.coverage.value)
METHOD = Column("method", False, lambda row: row.name.casefold())
COLUMNS = {column.name: column for column in (METHOD, RANK_ERROR, *NATIVE, *SCALED, SCALE, *WITHIN, COVERAGE)}
RANK = "rank"


@dataclass(frozen=True)
class Order:
    """Row order: by rank or by the column ``name`` of ``COLUMNS``; best first, or worst first if ``inverted``."""

    name: str = RANK
    inverted: bool = False

    @property
    def is_descending(self) -> bool:
        """Whether values decrease from top to bottom."""
        return (self.name != RANK and COLUMNS[self.name].largest_first) != self.inverted

    def link(self, name: str) -> str:
        """Return the ``?sort=`` value of a column's link: best first, or inverted if it is active."""
        return f"-{name}" if name == self.name and not self.inverted else name

    def heading(self, name: str) -> str | None:
        """Return the ``aria-sort`` value of a column's heading, or None if the rows are not sorted by it."""
        if name != self.name:
            return None
        return "descending" if self.is_descending else "ascending"


def parse_order(text: str | None) -> Order:
    """Return the order for a ``?sort=`` value; by rank if it is not a column name."""
    name = (text or RANK).removeprefix("-")
    return Order(name, bool(text) and text != name) if name == RANK or name in COLUMNS else Order()


def sort_indices(rows: Sequence[tuple[int | None, ScoreRow]], order: Order) -> list[int]:
    """Return the indices that sort (rank, row) pairs; missing values come last in both directions."""
    keys = [rank if order.name == RANK else COLUMNS[order.name].value(row) for rank, row in rows]
    present = [(key, index) for index, key in enumerate(keys) if key is not None]
    missing = [index for index, key in enumerate(keys) if key is None]
    present.sort(key=itemgetter(0), reverse=order.is_descending)
    return [index for _, index in present] + missing


MAX_PLOTTED = 16
"""Maximum number of submitted rows in a plot; more would not be distinguishable."""
_FORMAT_CACHE_SIZE = 2048
_FIRST_UPPERCASE, _FIRST_LOWERCASE = ord("A"), ord("a")


@dataclass(frozen=True)
class RankingLine:
    """A submitted row as displayed; ``mark`` labels its point in the plot and is empty if it is not plotted."""

    rank: int | None
    class_rank: int | None
    mark: str
    submission_id: str
    submitter: str
    inputs: str | None
    uses_ground_truth: bool | None
    link: Link | None
    when: DisplayTime
    row: ScoreRow


@dataclass(frozen=True)
class ConfigRanking:
    """Table and plot of a config.

    ``version`` is the version of the underlying rows, ``row_count`` the number of those with the declared
    ``inputs``, ``lines`` the rows shown, ``references`` the rows of reference errors (name, native and scaled
    cells), ``published`` the rows of the paper, ``distance`` their camera distance and ``plotted`` the number of
    points.
    """

    version: RankingVersion
    config: str
    order: Order
    inputs: str | None
    row_count: int
    references: list[tuple[str, list[str], list[str]]]
    lines: list[RankingLine]
    published: list[PaperRow]
    distance: str
    chart: Markup | None
    plotted: int

    @property
    def unranked(self) -> bool:
        """Whether any shown row is unranked."""
        return any(line.rank is None for line in self.lines)

    @property
    def interval(self) -> bool:
        """Whether any number is shown with a confidence interval."""
        return any(line.row.has_interval() for line in self.lines)

    @property
    def dash(self) -> bool:
        """Whether any number is shown as undefined."""
        return any(line.row.has_dash() for line in self.lines)

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
    database: Database, config: str, order: Order, inputs: str | None = None, max_rows: int | None = None
) -> ConfigRanking:
    """Return the ranking of a config in the given order, limited to the first ``max_rows`` rows.

    With ``inputs``, only rows of this class are shown.
    """
    all_rows = leaderboard_entries(database, config)
    rows = entries_of_class(all_rows, inputs)
    formatted = [_format_row(row.method, row.table_json, database.hidden_truth) for row in rows]
    marks = _plot_marks(rows, formatted)
    indices = sort_indices([(row.rank, numbers.row) for row, numbers in zip(rows, formatted, strict=True)], order)[
        :max_rows
    ]
    published, distance = _published(formatted)
    points = tuple(_plot_point(marks[index], formatted[index]) for index in marks)
    return ConfigRanking(
        version=ranking_version(all_rows),
        config=printable(config),
        order=order,
        inputs=inputs,
        references=_references(formatted),
        row_count=len(rows),
        lines=[_ranking_line(rows[index], marks.get(index, ""), formatted[index].row) for index in indices],
        published=published,
        distance=distance,
        chart=_chart(printable(config), points, tuple(scatter_points(published, {}))) if points else None,
        plotted=len(points),
    )


def _references(formatted: Sequence[_FormattedRow]) -> list[tuple[str, list[str], list[str]]]:
    """Return the reference rows, which every table of the current protocol contains."""
    tables = (row.table for row in formatted if row.table)
    return next((rows for table in tables if (rows := reference_rows(table.reference))), [])


@lru_cache(maxsize=1)
def published_numbers() -> PublishedNumbers:
    """Return the numbers of the paper, which are part of the package; they are read once."""
    return load_published()


@lru_cache(maxsize=_FORMAT_CACHE_SIZE)
def _format_row(method: str, table_json: str, hidden_truth: bool) -> _FormattedRow:
    """Return the formatted numbers of a row; cached, because they depend on the arguments only."""
    if hidden_truth:
        return _FormattedRow(None, disclosed_row(method, DisclosedTable.model_validate_json(table_json)))
    table = read_table(json.loads(table_json))
    return _FormattedRow(table, table_row(method, table))


@lru_cache(maxsize=64)
def _chart(config: str, own: tuple[ScatterPoint, ...], published: tuple[ScatterPoint, ...]) -> Markup:
    return scatter_chart(f"{config}: native and scaled AbsRel", [*own, *published])


def _ranking_line(entry: LeaderboardEntry, mark: str, row: ScoreRow) -> RankingLine:
    return RankingLine(
        rank=entry.rank,
        class_rank=entry.class_rank,
        mark=mark,
        submission_id=entry.submission_id,
        submitter=printable(entry.submitter),
        inputs=entry.inputs,
        uses_ground_truth=entry.uses_ground_truth,
        link=link(entry.url),
        when=format_time(entry.created_at),
        row=row,
    )


def _plot_marks(rows: Sequence[LeaderboardEntry], formatted: Sequence[_FormattedRow]) -> dict[int, str]:
    """Return the plot labels by row index: ranks, or lowercase letters for unranked rows."""
    marks: dict[int, str] = {}
    unranked = 0
    for index, (row, numbers) in enumerate(zip(rows, formatted, strict=True)):
        if len(marks) == MAX_PLOTTED:
            break
        if numbers.row.native[0].value is None or numbers.row.scaled[0].value is None:
            continue
        marks[index] = str(row.rank) if row.rank else chr(_FIRST_LOWERCASE + unranked)
        unranked += row.rank is None
    return marks


def _plot_point(mark: str, numbers: _FormattedRow) -> ScatterPoint:
    native, scaled = numbers.row.native[0].value, numbers.row.scaled[0].value
    assert numbers.table is not None
    assert native is not None
    assert scaled is not None
    intervals = numbers.table.intervals
    ends = [finite_interval(intervals.get(name)) for name in ("native.abs_rel", "scaled.abs_rel")]
    return ScatterPoint(mark, numbers.row.name, native, scaled, False, *ends)


def _published(formatted: Sequence[_FormattedRow]) -> tuple[list[PaperRow], str]:
    """Return the paper's rows of the scene that the config shows, and their camera distance."""
    match = next((match for row in formatted if row.table and (match := row.table.published)), None)
    scene = published_numbers().scenes.get(match.scene) if match else None
    if match is None or scene is None:
        return [], ""
    rows = [published_row(chr(_FIRST_UPPERCASE + k), row) for k, row in enumerate(scene.rows)]
    return rows, scene.distance if match.same_optics else f"{scene.distance} {OTHER_OPTICS_NOTE}"
