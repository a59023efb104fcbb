"""HTML pages of studies: self-contained, without scripts or requests, same bytes for the same input.

All text passes through Jinja's escaping; text from a submission or a dataset must pass through
``errors.printable`` before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from markupsafe import Markup

from rebar_depth_bench.reporting.html.assets import environment


@dataclass(frozen=True)
class PageFigure:
    """Figure of a study page: an SVG from ``reporting.charts.lines``, its title and caption."""

    svg: Markup
    title: str
    caption: str


@dataclass(frozen=True)
class PageTable:
    """Table of a study page: headings (name, unit), and rows with as many cells.

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
class StudyPage:
    """Contents of a study's page; ``title`` states the alignment, ``stamps`` are (name, value) pairs."""

    study: str
    title: str
    lead: str
    stamps: Sequence[tuple[str, str]]
    figures: Sequence[PageFigure]
    tables: Sequence[PageTable]
    notes: Sequence[str]


def render_study(page: StudyPage) -> str:
    """Return the page as HTML; it follows the reader's light or dark mode and needs no network."""
    return environment().get_template("study.html.j2").render(page=page)
