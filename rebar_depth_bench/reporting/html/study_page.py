"""A study as one self-contained HTML page: no scripts, no requests, the same bytes for the same input.

Every text passes jinja's escaping; what comes from an archive or a dataset passes ``wording.printable`` before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from rebar_depth_bench.reporting.html.assets import environment


@dataclass(frozen=True)
class PageFigure:
    """An SVG from ``study_charts``, its title and what to see in it."""

    svg: Markup
    title: str
    caption: str


@dataclass(frozen=True)
class PageTable:
    """A table: headings of (name, unit), and rows of as many cells; the first cell names its row."""

    caption: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[str]]

    def __post_init__(self) -> None:
        wrong = [len(row) for row in self.rows if len(row) != len(self.heads)]
        if wrong:
            raise ValueError(f"table {self.caption!r}: a row has {wrong[0]} cells, expected {len(self.heads)}")


@dataclass(frozen=True)
class StudyPage:
    """One study's page; ``title`` states the alignment, ``stamps`` are ``Stamp.lines()``."""

    study: str
    title: str
    lead: str
    stamps: Sequence[tuple[str, str]]
    figures: Sequence[PageFigure]
    tables: Sequence[PageTable]
    notes: Sequence[str]


def render_study(page: StudyPage) -> str:
    """Return the page as HTML; it follows the reader's light or dark and needs no network."""
    return environment().get_template("study.html.j2").render(page=page)
