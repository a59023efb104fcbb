"""Selection of the rows of a page: filters, order and page number, as the address states them.

Rows are selected on the server, so that an address shows the same rows to everyone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar
from urllib.parse import urlencode

from leaderboard.db.rankings import LeaderboardEntry
from rebar_depth_bench.scoring import columns
from rebar_depth_bench.scoring.columns import Column
from rebar_depth_bench.submission.declaration import INPUTS

PAGE_ROWS = 50
"""Number of submitted rows on a page."""
RANK, METHOD = "rank", "method"
_MAX_QUERY_CHARACTERS = 100

T = TypeVar("T")


@dataclass(frozen=True)
class SortedColumn:
    """A sortable column and its name in URLs."""

    name: str
    column: Column

    def value(self, table: Mapping[str, Any]) -> float | None:
        """Return the value in the JSON of a table, or None if it is undefined or hidden."""
        found = self.column.value(table)
        return found if isinstance(found, int | float) else None

    def interval(self, table: Mapping[str, Any]) -> tuple[float, float] | None:
        """Return the 95 % interval of the value, or None if there is none."""
        found = self.column.value(table.get("ci95", {}))
        return (found[0], found[1]) if isinstance(found, list) and len(found) == 2 and None not in found else None


def _sorted(columns: Sequence[Column]) -> tuple[SortedColumn, ...]:
    return tuple(
        SortedColumn(column.name.removeprefix("native_").removesuffix("_cm").removesuffix("_median"), column)
        for column in columns
    )


NATIVE, SCALED, WITHIN = map(_sorted, (columns.NATIVE, columns.SCALED, columns.WITHIN))
_OTHERS = _sorted((columns.RANK_ERROR, columns.SCALE, columns.COVERAGE))
COLUMNS = {column.name: column for column in (_OTHERS[0], *NATIVE, *SCALED, _OTHERS[1], *WITHIN, _OTHERS[2])}


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
        is_better = self.order in COLUMNS and COLUMNS[self.order].column.better == "higher"
        return is_better != self.inverted

    def heading(self, name: str) -> str | None:
        """Return the ``aria-sort`` value of a column's heading, or None if the rows are not sorted by it."""
        if name != self.order:
            return None
        return "descending" if self.is_descending else "ascending"

    def sorted_by(self, name: str) -> Selection:
        """Return the selection of a column's link: best first, or inverted if the rows are sorted by it."""
        return self.but(order=name, inverted=name == self.order and not self.inverted)

    def but(self, **changes: Any) -> Selection:
        """Return the selection with other values, on its first page unless ``changes`` name one."""
        return replace(self, **{"page": 1, **changes})

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

    def sorted(self, entries: Sequence[LeaderboardEntry]) -> list[LeaderboardEntry]:
        """Return the rows in order; rows without a value come last in both directions."""
        keyed = [(self._key(entry), entry) for entry in entries]
        present = [pair for pair in keyed if pair[0] is not None]
        present.sort(key=lambda pair: pair[0], reverse=self.is_descending)
        return [entry for _, entry in present] + [entry for key, entry in keyed if key is None]

    def _key(self, entry: LeaderboardEntry) -> Any:
        if self.order == METHOD:
            return entry.method.casefold()
        return entry.rank if self.order == RANK else COLUMNS[self.order].value(entry.table)

    def page_of(self, rows: Sequence[T], page_rows: int = PAGE_ROWS) -> tuple[Sequence[T], Selection, int]:
        """Return the rows of the page, the selection with the page's number in range, and the number of pages."""
        pages = max(1, -(-len(rows) // page_rows))
        selection = replace(self, page=min(self.page, pages))
        start = (selection.page - 1) * page_rows
        return rows[start : start + page_rows], selection, pages


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
