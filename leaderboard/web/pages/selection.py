"""Selection of the rows of a page: filters, order and page number, as the address states them.

Rows are selected on the server, so that an address shows the same rows to everyone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar
from urllib.parse import urlencode

from leaderboard.db.rankings import LeaderboardEntry
from leaderboard.web.pages.board_columns import COLUMNS_BY_NAME, RANK
from rebar_depth_bench.submission.declaration import INPUTS

_MAX_QUERY_CHARACTERS = 100
_MAX_PAGE_DIGITS = 6

T = TypeVar("T")


@dataclass(frozen=True)
class Selection:
    """Rows of a page: their order (the name of a column), filters, and the page's number.

    Best first, or worst first if ``inverted``. ``text`` is searched in the names of methods and submitters. Only
    the best row of each submitter and method name is shown, unless ``all_rows`` is true.
    """

    order: str = RANK
    inverted: bool = False
    inputs: str | None = None
    text: str = ""
    all_rows: bool = False
    page: int = 1

    @property
    def is_descending(self) -> bool:
        """Whether values decrease from top to bottom."""
        number = COLUMNS_BY_NAME[self.order].number
        return (number is not None and number.better == "higher") != self.inverted

    def sorted_by(self, name: str) -> Selection:
        """Return the selection of a column's link: best first, or inverted if the rows are sorted by it."""
        return self.but(order=name, inverted=name == self.order and not self.inverted)

    def but(self, **changes: Any) -> Selection:
        """Return the selection with other values, on its first page unless ``changes`` name one."""
        return replace(self, **{"page": 1, **changes})

    def parameters(self, config: str | None) -> dict[str, str]:
        """Return the parameters of the address of a page, without those that have their default."""
        values = {
            "config": config,
            "inputs": self.inputs,
            "q": self.text,
            "rows": "all" if self.all_rows else "",
            "sort": "" if (self.order, self.inverted) == (RANK, False) else "-" * self.inverted + self.order,
            "page": "" if self.page == 1 else str(self.page),
        }
        return {name: value for name, value in values.items() if value}

    def query(self, config: str | None) -> str:
        """Return the parameters of the address of a page as its query."""
        return urlencode(self.parameters(config))

    def matches(self, entry: LeaderboardEntry) -> bool:
        """Return whether a row passes the filters."""
        text = self.text.casefold()
        return (self.inputs is None or entry.inputs == self.inputs) and (
            text in entry.method.casefold() or text in entry.submitter.casefold()
        )

    def sorted(self, entries: Iterable[LeaderboardEntry]) -> list[LeaderboardEntry]:
        """Return the rows in order; rows without a value come last in both directions."""
        column = COLUMNS_BY_NAME[self.order]
        keyed = [(column.value(entry), entry) for entry in entries]
        present: list[tuple[Any, LeaderboardEntry]] = [pair for pair in keyed if pair[0] is not None]
        present.sort(key=lambda pair: pair[0], reverse=self.is_descending)
        return [entry for _, entry in present] + [entry for key, entry in keyed if key is None]

    def page_of(self, rows: Sequence[T], page_rows: int) -> PageOfRows[T]:
        """Return the rows of the page, or of the last one if there are fewer pages."""
        pages = max(1, -(-len(rows) // page_rows))
        page = min(self.page, pages)
        start = (page - 1) * page_rows
        return PageOfRows(rows[start : start + page_rows], replace(self, page=page), len(rows), pages)


@dataclass(frozen=True)
class PageOfRows(Generic[T]):
    """Rows of a page, its selection, and the numbers of rows and of pages that are selected."""

    rows: Sequence[T]
    selection: Selection
    row_count: int
    pages: int


def parse_selection(parameters: Mapping[str, str]) -> Selection:
    """Return the selection of URL parameters; values that are invalid are replaced by their defaults."""
    sort, inputs, page = (parameters.get(name, "") for name in ("sort", "inputs", "page"))
    order = sort.removeprefix("-")
    is_column = order in COLUMNS_BY_NAME
    return Selection(
        order=order if is_column else RANK,
        inverted=is_column and sort != order,
        inputs=inputs if inputs in INPUTS else None,
        text=parameters.get("q", "").strip()[:_MAX_QUERY_CHARACTERS],
        all_rows=parameters.get("rows") == "all",
        page=max(1, int(page)) if page.isdecimal() and len(page) <= _MAX_PAGE_DIGITS else 1,
    )
