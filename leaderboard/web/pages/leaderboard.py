"""A config's board as its table and plot show it: the group's rows, and the paper's below them, never ranked.

The board's columns: what a link ``?sort=NAME`` sorts by where there is no JavaScript.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from markupsafe import Markup

from leaderboard.db.engine import Database
from leaderboard.db.rankings import Stamp, Standing, stamp_of, standings
from leaderboard.web.pages.rendering import Link, Moment, link, moment
from rebar_depth_bench.reporting.charts.scatter import ScatterPoint, scatter_chart
from rebar_depth_bench.reporting.formatting import printable
from rebar_depth_bench.reporting.html.published import PaperRow, finite_ends, published_row
from rebar_depth_bench.reporting.html.rows import Row, table_row
from rebar_depth_bench.reporting.published import Published, load_published, paper_scene
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Table
from rebar_depth_bench.scoring.result_io import read_table

Value = float | str | None


@dataclass(frozen=True)
class Column:
    """A column: its name in addresses, and whether its best value is the largest."""

    name: str
    largest_first: bool
    value: Callable[[Row], Value]


def _native(place: int) -> Callable[[Row], Value]:
    return lambda row: row.native[place].value


def _scaled(place: int) -> Callable[[Row], Value]:
    return lambda row: row.scaled[place].value


def _within(place: int) -> Callable[[Row], Value]:
    return lambda row: row.within[place].value


NATIVE = tuple(
    Column(name, name == "delta1", _native(k)) for k, name in enumerate(("abs_rel", "rmse", "mae", "delta1"))
)
SCALED = tuple(Column(f"scaled_{one.name}", one.largest_first, _scaled(k)) for k, one in enumerate(NATIVE))
SCALE = Column("scale", False, lambda row: row.scale.value)
WITHIN = tuple(Column(f"within_{t}mm", True, _within(k)) for k, t in enumerate(WITHIN_MM))
COVERAGE = Column("coverage", True, lambda row: row.coverage.value)
METHOD = Column("method", False, lambda row: row.name.casefold())
COLUMNS = {one.name: one for one in (METHOD, *NATIVE, *SCALED, SCALE, *WITHIN, COVERAGE)}
RANK = "rank"


@dataclass(frozen=True)
class Order:
    """The rows' order: by a column of ``COLUMNS``, best first or ``turned``; by rank where ``name`` is that."""

    name: str = RANK
    turned: bool = False

    @property
    def falling(self) -> bool:
        """Whether values fall from top to bottom."""
        return (self.name != RANK and COLUMNS[self.name].largest_first) != self.turned

    def link(self, name: str) -> str:
        """Return what ``?sort=`` says in the heading of a column: best first, or turned where it is so already."""
        return f"-{name}" if name == self.name and not self.turned else name

    def heading(self, name: str) -> str | None:
        """Return the heading's ``aria-sort``, None where the rows are not in this column's order."""
        if name != self.name:
            return None
        return "descending" if self.falling else "ascending"


def read_order(text: str | None) -> Order:
    """Return the order that ``?sort=`` asks for; by rank for what names no column."""
    name = (text or RANK).removeprefix("-")
    return Order(name, bool(text) and text != name) if name == RANK or name in COLUMNS else Order()


def ordered(rows: Sequence[tuple[int | None, Row]], order: Order) -> list[int]:
    """Return the places of (rank, row) in an order; missing values come last whichever way it runs."""
    keys = [rank if order.name == RANK else COLUMNS[order.name].value(row) for rank, row in rows]
    present = [(key, place) for place, key in enumerate(keys) if key is not None]
    missing = [place for place, key in enumerate(keys) if key is None]
    present.sort(key=_key, reverse=order.falling)
    return [place for _, place in present] + missing


def _key(keyed: tuple[Any, int]) -> Any:
    """Return what is compared: the value alone, so that equal rows keep their order."""
    return keyed[0]


MOST_PLOTTED = 16
"""Rows of a config that its plot shows: more could not be told apart."""
_KEPT = 2048
_FIRST_CAPITAL, _FIRST_SMALL = ord("A"), ord("a")


@dataclass(frozen=True)
class Line:
    """A row of the group's; ``mark`` names its point in the plot, empty where it has none."""

    rank: int | None
    mark: str
    submission_id: str
    submitter: str
    link: Link | None
    when: Moment
    row: Row


@dataclass(frozen=True)
class Board:
    """A config's table and plot; ``rows`` is how many there are, of which ``lines`` are shown.

    ``stamp`` is that of the rows it was made of.
    """

    stamp: Stamp
    config: str
    order: Order
    rows: int
    lines: list[Line]
    published: list[PaperRow]
    distance: str
    chart: Markup | None
    plotted: int

    @property
    def unranked(self) -> bool:
        """Whether a row is shown that is not ranked."""
        return any(line.rank is None for line in self.lines)

    @property
    def interval(self) -> bool:
        """Whether a number is shown with its interval."""
        return any(line.row.has_interval() for line in self.lines)

    @property
    def dash(self) -> bool:
        """Whether a number is shown as undefined."""
        return any(line.row.has_dash() for line in self.lines)

    @property
    def dagger(self) -> bool:
        """Whether a published row took its scale from the ground truth."""
        return any(row.dagger for row in self.published)


@dataclass(frozen=True)
class _Spelled:
    table: Table
    row: Row


def make_board(database: Database, config: str, order: Order, most: int | None = None) -> Board:
    """Return a config's board in an order, its first ``most`` rows."""
    found = standings(database, config)
    spelled = [_spelled(one.method, one.table) for one in found]
    marks = _marks(found, spelled)
    places = ordered([(one.rank, both.row) for one, both in zip(found, spelled, strict=True)], order)[:most]
    published, distance = _published(config)
    points = tuple(_point(marks[place], spelled[place]) for place in marks)
    return Board(
        stamp=stamp_of(found),
        config=printable(config),
        order=order,
        rows=len(found),
        lines=[_line(found[place], marks.get(place, ""), spelled[place].row) for place in places],
        published=published,
        distance=distance,
        chart=_chart(printable(config), points, tuple(_published_points(published))) if points else None,
        plotted=len(points),
    )


@lru_cache(maxsize=1)
def published_numbers() -> Published:
    """Return the paper's numbers, read once: they come with the package."""
    return load_published()


@lru_cache(maxsize=_KEPT)
def _spelled(method: str, table_json: str) -> _Spelled:
    """Return a row's numbers as text: the same for the same JSON, so each is spelled once."""
    table = read_table(json.loads(table_json))
    return _Spelled(table, table_row(method, table))


@lru_cache(maxsize=64)
def _chart(config: str, own: tuple[ScatterPoint, ...], published: tuple[ScatterPoint, ...]) -> Markup:
    return scatter_chart(f"{config}: native and scaled AbsRel", [*own, *published])


def _line(one: Standing, mark: str, row: Row) -> Line:
    return Line(
        rank=one.rank,
        mark=mark,
        submission_id=one.submission_id,
        submitter=printable(one.submitter),
        link=link(one.url),
        when=moment(one.created_at),
        row=row,
    )


def _marks(found: Sequence[Standing], spelled: Sequence[_Spelled]) -> dict[int, str]:
    """Return the plot's marks by place: ranks, then small letters for rows that are not ranked."""
    marks: dict[int, str] = {}
    small = 0
    for place, (one, both) in enumerate(zip(found, spelled, strict=True)):
        if len(marks) == MOST_PLOTTED:
            break
        if both.row.native[0].value is None or both.row.scaled[0].value is None:
            continue
        marks[place] = str(one.rank) if one.rank else chr(_FIRST_SMALL + small)
        small += one.rank is None
    return marks


def _point(mark: str, both: _Spelled) -> ScatterPoint:
    native, scaled = both.row.native[0].value, both.row.scaled[0].value
    assert native is not None
    assert scaled is not None
    intervals = both.table.intervals
    ends = [finite_ends(intervals.get(name)) for name in ("native.abs_rel", "scaled.abs_rel")]
    return ScatterPoint(mark, both.row.name, native, scaled, False, *ends)


def _published(config: str) -> tuple[list[PaperRow], str]:
    scene = published_numbers().scenes.get(paper_scene(config) or "")
    if scene is None:
        return [], ""
    rows = [published_row(chr(_FIRST_CAPITAL + k), row) for k, row in enumerate(scene.rows)]
    return rows, scene.distance


def _published_points(rows: Sequence[PaperRow]) -> list[ScatterPoint]:
    points = []
    for row in rows:
        native, scaled = row.cells[1].value, row.cells[2].value
        if native is not None and scaled is not None:
            points.append(ScatterPoint(row.mark, row.name, native, scaled, True))
    return points
