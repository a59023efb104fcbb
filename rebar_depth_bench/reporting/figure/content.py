"""Content of the figure: the points of each config, of the archives and of the paper, and the notes on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting.formatting import config_title, counted, rank_mark, scaled_constants
from rebar_depth_bench.reporting.published import (
    OTHER_OPTICS_MARK,
    OTHER_OPTICS_NOTE,
    load_published,
    published_rows,
)
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.reference import Reference
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, Table

ANCHORED_MARK = "†"


@dataclass(frozen=True)
class FigurePoint:
    """Native and scaled AbsRel of a method, and the marks of its row in the tables.

    ``hollow`` points are those of archives whose errors are not compared with others, since their archives chose
    the pixels that they are over.
    """

    method: str
    native: float
    scaled: float
    published: bool = False
    hollow: bool = False
    mark: str = ""


@dataclass(frozen=True)
class Panel:
    """Points of a config, those of the paper first, its reference errors, and AbsRel of constants by title."""

    config: str
    title: str
    points: tuple[FigurePoint, ...]
    reference: Reference
    constants: Mapping[str, float]


@dataclass(frozen=True)
class FigureContent:
    """Panels by config, the names in the legend, the notes below it, and what is left out for want of numbers."""

    panels: tuple[Panel, ...]
    archives: tuple[str, ...]
    published: tuple[str, ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...]


def figure_content(results: Sequence[Result], *, published: bool) -> FigureContent:
    """Return what the figure of results of one dataset shows; their method names differ.

    With ``published``, the paper's points of a config that shows one of its scenes come with it.
    """
    configs = dict.fromkeys(name for result in results for name in result.tables)
    panels = [_panel(config, results, published=published) for config in configs]
    points = [point for panel in panels for point in panel.points]
    left_out = [
        f"{printable(result.method)} has no errors of {printable(config)}: left out of --figure"
        for config in configs
        for result in results
        if config in result.tables and _errors(result.tables[config]) is None
    ]
    return FigureContent(
        panels=tuple(panels),
        archives=tuple(dict.fromkeys(_name(result) for result in results)),
        published=tuple(dict.fromkeys(point.method for point in points if point.published)),
        notes=tuple(_notes(results, points)),
        left_out=tuple(left_out),
    )


def _panel(config: str, results: Sequence[Result], *, published: bool) -> Panel:
    rows = [(result, result.tables[config]) for result in results if config in result.tables]
    first = rows[0][1]
    shown = _published_points(first.published) if published and first.published else []
    for result, table in rows:
        if errors := _errors(table):
            shown.append(FigurePoint(_name(result), *errors, hollow=not table.is_comparable))
    title = f"{config_title(printable(config, 40), first.split)}, {counted(first.views, 'view')}"
    if any(OTHER_OPTICS_MARK in point.mark for point in shown):
        title += f", paper {OTHER_OPTICS_MARK}"
    constants = scaled_constants([(_name(result), table) for result, table in rows])
    abs_rels = {title: abs_rel for title, (abs_rel, _) in constants.items()}
    return Panel(printable(config), title, tuple(shown), first.reference, abs_rels)


def _published_points(match: PublishedMatch) -> list[FigurePoint]:
    optics = "" if match.same_optics else OTHER_OPTICS_MARK
    return [
        FigurePoint(
            row.method,
            float(row.abs_rel),
            float(row.abs_rel_scaled),
            published=True,
            mark=(ANCHORED_MARK if row.median_anchored else "") + optics,
        )
        for row in published_rows(match.scene)
    ]


def _errors(table: Table) -> tuple[float, float] | None:
    """Return the native and scaled AbsRel, or None if either is undefined (null in the JSON)."""
    if table.native is None or table.scaled is None:
        return None
    errors = table.native.abs_rel, table.scaled.abs_rel
    return errors if all(map(_is_number, errors)) else None


def _is_number(value: float) -> bool:
    return 0 <= value < float("inf")


def _name(result: Result) -> str:
    """Return a method's name with the mark of its declaration, as the tables show it."""
    table = next((table for table in result.tables.values() if table.views), None)
    return printable(result.method) + (rank_mark(result.declared, table) if table else "")


def _notes(results: Sequence[Result], points: Sequence[FigurePoint]) -> list[str]:
    notes = ["AbsRel on scored steel pixels, mean over views. Scaled: oracle median scale per view."]
    if any(point.hollow for point in points):
        percent = f"{MIN_COMPARABLE_COVERAGE * 100:.0f} %"
        notes.append(f"Hollow: coverage below {percent} or a view without prediction; errors over chosen pixels.")
    if any(result.declared.uses_ground_truth for result in results):
        notes.append("‡: not ranked (declares the use of ground truth).")
    if any(result.declared.uses_ground_truth is None for result in results):
        notes.append("?: use of ground truth not declared.")
    if any(point.published for point in points):
        part = load_published().parts["synthetic"]
        notes.append(f"Paper: {part.place}, {part.mark}.")
    marks = "".join(point.mark for point in points)
    if ANCHORED_MARK in marks:
        notes.append(f"{ANCHORED_MARK}: median-anchored.")
    if OTHER_OPTICS_MARK in marks:
        notes.append(OTHER_OPTICS_NOTE)
    return notes
