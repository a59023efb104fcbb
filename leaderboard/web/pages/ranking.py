"""Page of the leaderboard: tables, plots and pictures of configs, and the overview of ranks across them.

A table has submitted rows, and the paper's rows, which are unranked.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import HTMLResponse
from markupsafe import Markup
from PIL import Image

from leaderboard.db.rankings import CurrentRankings, LeaderboardEntry, OverallEntry, Ranking, overall_ranking
from leaderboard.web.dependencies import ServiceDep, check_config
from leaderboard.web.pages.rendering import MAX_INTERVALS_PLOTTED, render
from leaderboard.web.pages.selection import (
    NATIVE,
    PAGE_ROWS,
    RANK,
    SCALED,
    WITHIN,
    Selection,
    parse_selection,
)
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts import ScatterPoint, scatter_chart
from rebar_depth_bench.reporting.published import (
    OTHER_OPTICS_NOTE,
    PaperRow,
    load_published,
    published_table,
    scatter_points,
)
from rebar_depth_bench.scoring.columns import COVERAGE, RANK_ERROR, VIEW_COLUMNS, Cell
from rebar_depth_bench.scoring.result import DECIMALS as DISCLOSED_DECIMALS
from rebar_depth_bench.scoring.result import DisclosedTable
from rebar_depth_bench.scoring.table import Table, read_table

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

NameQuery = Annotated[str | None, Query(max_length=100)]
_PageQuery = Annotated[int | None, Query(ge=1, le=1_000_000)]
_FIRST_ROWS, _FIRST_PLOTTED = 10, 300
"""Rows and plotted points per config on the page of several configs, which links to the full rankings."""
_CACHED_ROWS = 4096
_DECIMALS = 4
_SCENE_WIDTH, _SCENE_AGE_S = 480, 3600
"""Width of the pictures of configs in pixels, and the time for which browsers keep them in seconds."""
DISCLOSED_COLUMNS = (replace(RANK_ERROR, decimals=DISCLOSED_DECIMALS), COVERAGE)
"""Columns of the numbers that are shown if the ground truth is hidden."""


@router.get("/", name="board_page")
def leaderboard_page(
    request: Request,
    service: ServiceDep,
    config: NameQuery = None,
    sort: NameQuery = None,
    inputs: NameQuery = None,
    q: NameQuery = None,
    page: _PageQuery = None,
) -> HTMLResponse:
    """Return the page with an overview and the first rows of all configs, or with the rows of ``config``.

    The other parameters are those of ``parse_selection``.
    """
    all_configs, rankings = service.folder.configs, service.rankings
    if config is not None:
        check_config(service, config)
    configs = all_configs if config is None else (config,)
    selection = parse_selection(sort, inputs, q, page)
    several, hidden_truth = len(configs) > 1, service.settings.hidden_truth
    shown = selection.but() if several else selection
    limits = (_FIRST_ROWS, _FIRST_PLOTTED) if several else (PAGE_ROWS, None)
    return render(
        request,
        "board.html.j2",
        configs=all_configs,
        chosen=config,
        selection=selection,
        overview=make_overview(rankings, configs, selection, hidden_truth) if several else None,
        rankings=[make_config_ranking(rankings.of(name), name, shown, hidden_truth, *limits) for name in configs],
        sortable={"native": NATIVE, "scaled": SCALED, "within": WITHIN},
        paper_part=load_published().parts["synthetic"],
    )


@dataclass(frozen=True)
class RankingLine:
    """A submitted row, its table (None if the ground truth is hidden), and the cells of its numbers by path."""

    entry: LeaderboardEntry
    table: Table | None
    cells: Mapping[str, Cell]


@dataclass(frozen=True)
class ConfigRanking:
    """Table and plot of a config.

    ``row_count`` is the number of rows that pass the filters, ``lines`` the rows of the page, ``references`` the
    rows of reference errors (name, texts by path), ``published`` the rows of the paper and ``distance``
    their camera distance. ``plotted`` is the number of points of submissions.
    """

    config: str
    selection: Selection
    row_count: int
    pages: int
    references: list[tuple[str, dict[str, str]]]
    lines: list[RankingLine]
    published: list[PaperRow]
    distance: str
    chart: Markup | None
    plotted: int

    @property
    def interval(self) -> bool:
        """Whether any number is shown with a confidence interval."""
        return any(cell.interval for line in self.lines for cell in line.cells.values())

    @property
    def interval_note(self) -> str:
        """Explanation of the confidence intervals."""
        return formatting.interval_note(line.table for line in self.lines if line.table)

    @property
    def dash(self) -> bool:
        """Whether any number is shown as undefined."""
        return any(cell.value is None for line in self.lines for cell in line.cells.values())


def make_config_ranking(
    ranking: Ranking,
    config: str,
    selection: Selection,
    hidden_truth: bool,
    page_rows: int = PAGE_ROWS,
    max_plotted: int | None = None,
) -> ConfigRanking:
    """Return the selected rows of a config, ``page_rows`` on a page.

    The chart has a point for every selected row; there is none if that makes more than ``max_plotted`` points.
    """
    rows = [entry for entry in ranking.entries if selection.matches(entry)]
    shown, selection, pages = selection.page_of(selection.sorted(rows), page_rows)
    lines = [RankingLine(entry, *_row(entry.table_json, hidden_truth)) for entry in shown]
    tables = [(line.entry.method, line.table) for line in lines if line.table]
    published, distance = _published([table for _, table in tables])
    points = _plot_points(rows)
    chart = None
    if points and (max_plotted is None or len(points) <= max_plotted):
        title = f"{printable(config)}: native and scaled AbsRel"
        chart = scatter_chart(title, [*points, *scatter_points(published)])
    return ConfigRanking(
        config=printable(config),
        selection=selection,
        row_count=len(rows),
        pages=pages,
        references=formatting.reference_rows(tables),
        lines=lines,
        published=published,
        distance=distance,
        chart=chart,
        plotted=len(points),
    )


@lru_cache(maxsize=_CACHED_ROWS)
def _row(table_json: str, hidden_truth: bool) -> tuple[Table | None, Mapping[str, Cell]]:
    """Return table and cells of a row as in ``RankingLine``; cached, because they depend on the arguments only."""
    if hidden_truth:
        disclosed = DisclosedTable.model_validate_json(table_json)
        return None, {column.path: column.cell(disclosed) for column in DISCLOSED_COLUMNS}
    table = read_table(json.loads(table_json))
    return table, {column.path: column.cell(table) for column in VIEW_COLUMNS}


def _plot_points(rows: Sequence[LeaderboardEntry]) -> list[ScatterPoint]:
    """Return the points of all rows with both errors; each is labelled by its rank, "–" if it is not ranked."""
    points = []
    for entry in rows:
        native, scaled = (column.value(entry.table) for column in (NATIVE[0], SCALED[0]))
        if native is None or scaled is None:
            continue
        intervals = [
            column.interval(entry.table) if len(rows) <= MAX_INTERVALS_PLOTTED else None
            for column in (NATIVE[0], SCALED[0])
        ]
        mark = "–" if entry.rank is None else str(entry.rank)
        points.append(ScatterPoint(mark, entry.method, native, scaled, False, *intervals))
    return points


def _published(tables: Sequence[Table]) -> tuple[list[PaperRow], str]:
    """Return the paper's rows of the scene that the config shows, and their camera distance."""
    match = next((table.published for table in tables if table.published), None)
    scene = load_published().scenes.get(match.scene) if match else None
    if match is None or scene is None:
        return [], ""
    return published_table(scene), scene.distance if match.same_optics else f"{scene.distance} {OTHER_OPTICS_NOTE}"


@dataclass(frozen=True)
class Overview:
    """Rows of a page of the overview, the number of rows that pass the filters, and the decimals of errors."""

    selection: Selection
    row_count: int
    pages: int
    lines: Sequence[OverallEntry]
    decimals: int


def make_overview(
    rankings: CurrentRankings, configs: Sequence[str], selection: Selection, hidden_truth: bool
) -> Overview:
    """Return the rows of the overview that are selected, in the order of ``overall_ranking``."""
    lines = overall_ranking([(config, rankings.of(config)) for config in configs])
    if selection.order == RANK and selection.inverted:
        lines.reverse()
    lines = [line for line in lines if selection.matches(line.first)]
    shown, selection, pages = selection.page_of(lines)
    decimals = DISCLOSED_DECIMALS if hidden_truth else _DECIMALS
    return Overview(selection, len(lines), pages, shown, decimals)


@router.get("/scenes/{config}.webp")
def scene(config: str, service: ServiceDep) -> Response:
    """Return a picture of a config. Raises status 404 if the config is unknown or has no colour."""
    if config in service.folder.configs and config not in service.scenes:
        service.scenes[config] = _scene_webp(service.folder, config)
    webp = service.scenes.get(config)
    if webp is None:
        raise HTTPException(404, "there is no such config, or it has no colour")
    headers = {"Cache-Control": f"public, max-age={_SCENE_AGE_S}"}
    return Response(webp, media_type="image/webp", headers=headers)


def _scene_webp(folder: DatasetFolder, config: str) -> bytes | None:
    """Return the left image of the first view, reduced, as WebP, or None if the config has no colour.

    Raises ``DatasetError`` if the shard cannot be read.
    """
    shown = folder.config(config)
    row = next(iterate_rows(shown, ("view_id", "left_rgb")), None)
    rgb = None if row is None else row["left_rgb"]
    if rgb is None:
        return None
    image = Image.fromarray(rgb)
    image.thumbnail((_SCENE_WIDTH, _SCENE_WIDTH))
    out = io.BytesIO()
    image.save(out, "WEBP", quality=80)
    return out.getvalue()
