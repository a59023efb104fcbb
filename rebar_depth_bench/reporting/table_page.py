"""Pages of figures and tables: as HTML, and their tables for the terminal.

The HTML is self-contained, without scripts or requests, and the same bytes for the same input. All text passes
through Jinja's escaping; text from a submission or a dataset must pass through ``errors.printable`` before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from markupsafe import Markup
from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.tables import plain_text, print_unwrapped


@dataclass(frozen=True)
class PageFigure:
    """Figure of a page: an SVG from ``reporting.charts.lines``, its title and caption."""

    svg: Markup
    title: str
    caption: str


@dataclass(frozen=True)
class PageTable:
    """Table of a page: headings (name, unit), and rows with as many cells.

    The first cell of a row is its name. Raises ``ValueError`` if a row has another number of cells.
    """

    caption: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        wrong_lengths = [len(row) for row in self.rows if len(row) != len(self.heads)]
        if wrong_lengths:
            raise ValueError(
                f"table {self.caption!r}: a row has {wrong_lengths[0]} cells, expected {len(self.heads)}"
            )


T = TypeVar("T")
Columns = Sequence[tuple[str, str, Callable[[T], str]]]
"""Columns of a table: name, unit, and the function that returns the cell of a row's item."""


def page_table(caption: str, columns: Columns[T], items: Iterable[T]) -> PageTable:
    """Return the table with one row per item."""
    rows = [[cell(item) for _, _, cell in columns] for item in items]
    return PageTable(caption, [(name, unit) for name, unit, _ in columns], rows)


@dataclass(frozen=True)
class TablePage:
    """Contents of a page on a ``subject``; ``stamps`` are (name, value) pairs."""

    subject: str
    title: str
    lead: str
    stamps: Sequence[tuple[str, str]]
    figures: Sequence[PageFigure]
    tables: Sequence[PageTable]
    notes: Sequence[str]


def render_page(page: TablePage) -> str:
    """Return the page as HTML; it follows the reader's light or dark mode and needs no network."""
    return environment().get_template("table_page.html.j2").render(page=page)


def print_page(page: TablePage, console: Console) -> None:
    """Print title, stamps, tables and notes.

    Numbers are never truncated: on a narrow console, lines become longer than the console.
    """
    console.print(plain_text(page.title, style="bold"))
    console.print(plain_text("; ".join(f"{label}: {value}" for label, value in page.stamps), style="dim"))
    for table in page.tables:
        console.print()
        console.print(plain_text(table.caption, style="italic"))
        print_unwrapped(console, _rich_table(table))
    console.print()
    for note in page.notes:
        console.print(plain_text(note))


def _rich_table(table: PageTable) -> RichTable:
    rich_table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for index, (name, unit) in enumerate(table.heads):
        justify: Any = "left" if index == 0 else "right"
        rich_table.add_column(plain_text(f"{name}\n{unit}"), justify=justify, no_wrap=True)
    for row in table.rows:
        rich_table.add_row(*(plain_text(cell) for cell in row))
    return rich_table
