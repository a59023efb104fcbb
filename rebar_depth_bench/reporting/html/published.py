"""A result beside the paper's published rows of the same scene: shown together, never ranked together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from markupsafe import Markup

from rebar_depth_bench.reporting.charts.scatter import ScatterPoint, scatter_chart
from rebar_depth_bench.reporting.html.rows import Cell, table_row
from rebar_depth_bench.reporting.published import PublishedRow, PublishedScene, load_published, paper_scene
from rebar_depth_bench.scoring.result import Result, Table

_FIRST_LETTER = ord("A")


@dataclass(frozen=True)
class PaperRow:
    """One line of a scene's table: RMSE cm, AbsRel, AbsRel_s, s; ``mark`` names its point in the chart."""

    mark: str
    name: str
    published: bool
    dagger: bool
    cells: list[Cell]


@dataclass(frozen=True)
class PaperScene:
    """A scene of both: this archive's configs first, then the published rows, measured at ``distance``."""

    heading: str
    distance: str
    chart: Markup
    rows: list[PaperRow]


def paper_scenes(result: Result) -> list[PaperScene]:
    """Return the scenes of Table I that the result has configs of, in the paper's order."""
    own: dict[str, dict[str, Table]] = {}
    for config, table in result.tables.items():
        own.setdefault(paper_scene(config) or "", {})[config] = table
    scenes = load_published().scenes
    return [_paper_scene(name, scene, own[name]) for name, scene in scenes.items() if name in own]


def _paper_scene(name: str, scene: PublishedScene, tables: Mapping[str, Table]) -> PaperScene:
    letters = [_letters(index) for index in range(len(tables))]
    numbers = [str(index + 1) for index in range(len(scene.rows))]
    rows = [_own_row(*both) for both in zip(letters, tables.items(), strict=True)]
    rows += [published_row(*both) for both in zip(numbers, scene.rows, strict=True)]
    heading = scene.title if scene.title.lower() == name else f"{scene.title} ({name})"
    chart = scatter_chart(f"{heading}: native and scaled AbsRel", _points(rows, tables))
    return PaperScene(heading, scene.distance, chart, rows)


def _letters(index: int) -> str:
    return chr(_FIRST_LETTER + index) if index < 26 else f"A{index - 25}"


def _own_row(mark: str, config: tuple[str, Table]) -> PaperRow:
    row = table_row(*config)
    return PaperRow(mark, row.name, False, False, [row.native[1], row.native[0], row.scaled[0], row.scale])


def published_row(mark: str, row: PublishedRow) -> PaperRow:
    """Return a published row as it is printed; ``mark`` names its point in a chart."""
    texts = (row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale)
    return PaperRow(mark, row.method, True, row.median_anchored, [Cell(text, float(text)) for text in texts])


def _points(rows: Iterable[PaperRow], tables: Mapping[str, Table]) -> list[ScatterPoint]:
    """Return the rows that have both values; the first rows are the tables', in their order."""
    intervals = [table.intervals for table in tables.values()]
    points = []
    for index, row in enumerate(rows):
        found = {} if row.published else intervals[index]
        native, scaled = row.cells[1].value, row.cells[2].value
        if native is not None and scaled is not None:
            ends = finite_ends(found.get("native.abs_rel")), finite_ends(found.get("scaled.abs_rel"))
            points.append(ScatterPoint(row.mark, row.name, native, scaled, row.published, *ends))
    return points


def finite_ends(interval: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return an interval that can be drawn, else None."""
    return interval if interval and all(map(math.isfinite, interval)) else None
