"""Page of the leaderboard: the table of each config, and the overview of all of them.

A table has submitted rows, reference errors, and the paper's rows, which are unranked.
"""

from __future__ import annotations

import io
from typing import Any

from fastapi import APIRouter, HTTPException, Request, Response
from fastapi.responses import HTMLResponse
from PIL import Image

from leaderboard.db.rankings import Ranking, overall_ranking
from leaderboard.web.dependencies import ServiceDep, check_config
from leaderboard.web.pages.board_columns import COLUMNS
from leaderboard.web.pages.rendering import render
from leaderboard.web.pages.selection import Selection, parse_selection
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.reporting.published import OTHER_OPTICS_NOTE, load_published
from rebar_depth_bench.scoring.columns import PAPER_COLUMNS
from rebar_depth_bench.scoring.formatting import interval_note, reference_rows
from rebar_depth_bench.scoring.reading import read_table

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

PAGE_ROWS, FIRST_ROWS = 50, 10
"""Number of submitted rows on a page, and of each config on the page of several configs."""
_SCENE_WIDTH, _SCENE_AGE_S = 480, 3600
"""Width of the pictures of configs in pixels, and the time for which browsers keep them in seconds."""


@router.get("/", name="board_page")
def leaderboard_page(request: Request, service: ServiceDep, config: str | None = None) -> HTMLResponse:
    """Return the page with an overview and the first rows of all configs, or with the rows of ``config``.

    The other parameters are those of ``parse_selection``.
    """
    if config is not None:
        check_config(service, config)
    selection = parse_selection(request.query_params)
    configs = service.folder.configs if config is None else (config,)
    rankings = {name: service.rankings.of(name) for name in configs}
    shown = {name: one if selection.all_rows else one.best(selection.inputs) for name, one in rankings.items()}
    overview, of_config, page_rows = None, selection, PAGE_ROWS
    if len(configs) > 1:
        chosen = {name: Ranking(tuple(one.of_class(selection.inputs))) for name, one in rankings.items()}
        overall = overall_ranking([*chosen.items()], best=not selection.all_rows)
        overview = selection.page_of([one for one in overall if selection.matches(one.first)], PAGE_ROWS)
        of_config, page_rows = selection.but(), FIRST_ROWS
    return render(
        request,
        "board.html.j2",
        configs=service.folder.configs,
        chosen=config,
        selection=selection,
        overview=overview,
        shown=shown,
        tables=[config_table(ranking, name, of_config, page_rows) for name, ranking in shown.items()],
        board_columns=COLUMNS,
        paper_part=load_published().parts["synthetic"],
    )


def config_table(ranking: Ranking, config: str, selection: Selection, page_rows: int) -> dict[str, Any]:
    """Return the table of a config for the template: the selected rows, ``page_rows`` on a page, and the others.

    ``lines`` are the submitted rows with their parsed tables. ``references`` are the rows of reference errors and
    ``published`` those of the paper, each with its name and its texts by place of the number; ``distance`` is the
    paper's camera distance.
    """
    page = selection.page_of(selection.sorted(filter(selection.matches, ranking.entries)), page_rows)
    tables = [read_table(entry.table) for entry in page.rows]
    table: dict[str, Any] = {
        "config": config,
        "page": page,
        "lines": list(zip(page.rows, tables, strict=True)),
        "references": reference_rows([(line.method, one) for line, one in zip(page.rows, tables, strict=True)]),
        "published": [],
        "distance": "",
        "interval_note": interval_note(tables),
    }
    match = next((one.published for one in tables if one.published), None)
    scene = load_published().scenes.get(match.scene) if match else None
    if match is not None and scene is not None:
        table["distance"] = scene.distance if match.same_optics else f"{scene.distance} {OTHER_OPTICS_NOTE}"
        for row in scene.rows:
            texts = {column.place: text for column, text in zip(PAPER_COLUMNS, row.cells, strict=True)}
            anchor = " (median-anchored to ground truth)" if row.median_anchored else ""
            table["published"].append((row.method + anchor, texts))
    return table


@router.get("/scenes/{config}.webp")
def scene(config: str, service: ServiceDep) -> Response:
    """Return the left image of the first view of a config, reduced.

    Raises status 404 if the config is unknown or has no colour, and ``DatasetError`` if the shard cannot be read.
    """
    if config in service.folder.configs and config not in service.scenes:
        row = next(iterate_rows(service.folder.config(config), ("view_id", "left_rgb")), None)
        if row is None or row["left_rgb"] is None:
            service.scenes[config] = None
        else:
            image, out = Image.fromarray(row["left_rgb"]), io.BytesIO()
            image.thumbnail((_SCENE_WIDTH, _SCENE_WIDTH))
            image.save(out, "WEBP", quality=80)
            service.scenes[config] = out.getvalue()
    webp = service.scenes.get(config)
    if webp is None:
        raise HTTPException(404, "there is no such config, or it has no colour")
    headers = {"Cache-Control": f"public, max-age={_SCENE_AGE_S}"}
    return Response(webp, media_type="image/webp", headers=headers)
