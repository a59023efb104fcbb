"""The board's columns: what a link ``?sort=NAME`` sorts by where there is no JavaScript."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rebar_depth_bench.protocol import WITHIN_MM
from rebar_depth_bench.report.rows import Row

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
