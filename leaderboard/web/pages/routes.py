"""Routes of the HTML pages."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from leaderboard.db.rankings import picture_webp
from leaderboard.db.submissions import SCORED
from leaderboard.web.api.auth import ServiceDep
from leaderboard.web.api.submissions import SubmissionId, get_submission
from leaderboard.web.cache import NO_STORE, REVALIDATE
from leaderboard.web.pages.comparison import comparison_context
from leaderboard.web.pages.leaderboard import (
    NATIVE,
    PAGE_ROWS,
    SCALED,
    WITHIN,
    make_config_ranking,
    parse_selection,
)
from leaderboard.web.pages.overview import make_overview
from leaderboard.web.pages.rendering import render
from leaderboard.web.pages.scenes import scene_webp
from leaderboard.web.pages.submission import submission_context
from leaderboard.web.pages.submit import how_to_page
from rebar_depth_bench.reporting.published import load_published

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

OVERVIEW_LIMITS = (10, 300)
"""Rows and plotted points per config on the page of several configs, which links to the full rankings."""

SCENE_AGE_S = 3600
"""Time for which browsers keep the picture of a config, seconds."""

_NameQuery = Annotated[str | None, Query(max_length=100)]
_IdQuery = Annotated[str, Query(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_-]+$")]
_PageQuery = Annotated[int | None, Query(ge=1, le=1_000_000)]
_PathPart = Annotated[str, Path(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


@router.get("/", name="board_page")
def leaderboard_page(
    request: Request,
    service: ServiceDep,
    config: _NameQuery = None,
    sort: _NameQuery = None,
    inputs: _NameQuery = None,
    q: _NameQuery = None,
    page: _PageQuery = None,
) -> HTMLResponse:
    """Return the page with an overview and the first rows of all configs, or with the rows of ``config``.

    The other parameters are those of ``parse_selection``.
    """
    all_configs = service.folder.configs
    if config is not None and config not in all_configs:
        raise HTTPException(404, f"the dataset has no config {config!r}, expected one of {', '.join(all_configs)}")
    configs = all_configs if config is None else (config,)
    selection = parse_selection(sort, inputs, q, page)
    several = len(configs) > 1
    shown, *limits = (selection.at_page(1), *OVERVIEW_LIMITS) if several else (selection, PAGE_ROWS, None)
    hidden_truth = service.settings.hidden_truth
    return render(
        request,
        "board.html.j2",
        configs=all_configs,
        chosen=config,
        selection=selection,
        overview=make_overview(service.rankings, configs, selection, hidden_truth) if several else None,
        rankings=[
            make_config_ranking(service.rankings.of(name), name, shown, hidden_truth, *limits) for name in configs
        ],
        columns={"native": NATIVE, "scaled": SCALED, "within": WITHIN},
        paper_part=load_published().parts["synthetic"],
    )


@router.get("/submissions/{submission_id}", name="submission_page")
def submission_page(
    submission_id: SubmissionId, request: Request, service: ServiceDep, views: _NameQuery = None
) -> HTMLResponse:
    """Return the page of a submission, which anyone who knows its URL may read.

    All views of the config ``views`` are listed, and the worst views of the others.
    """
    record = get_submission(service, submission_id)
    views = views if views in service.folder.configs else None
    cache = _cache_control(record.public and record.status == SCORED)
    return render(request, "submission.html.j2", cache=cache, **submission_context(service, record, views))


@router.get("/submissions/{submission_id}/pictures/{kind}/{config}/{number}.webp", response_class=Response)
def picture(
    submission_id: SubmissionId,
    kind: Literal["colour", "truth", "prediction", "error"],
    config: _PathPart,
    number: _PathPart,
    service: ServiceDep,
) -> Response:
    """Return a picture of a view. Raises status 404 if it is not stored."""
    record = get_submission(service, submission_id)
    webp = picture_webp(service.database, submission_id, f"{config}/{number}", kind)
    if webp is None:
        raise HTTPException(404, "there is no such picture of this view")
    return Response(webp, media_type="image/webp", headers={"Cache-Control": _cache_control(record.public)})


@router.get("/scenes/{config}.webp", response_class=Response)
def scene(config: _PathPart, service: ServiceDep) -> Response:
    """Return a picture of a config. Raises status 404 if the config is unknown or has no colour."""
    if config not in service.folder.configs:
        raise HTTPException(404, "the dataset has no such config")
    if config not in service.scenes:
        service.scenes[config] = scene_webp(service.folder, config)
    webp = service.scenes[config]
    if webp is None:
        raise HTTPException(404, "the config has no colour")
    return Response(webp, media_type="image/webp", headers={"Cache-Control": f"public, max-age={SCENE_AGE_S}"})


@router.get("/compare")
def compare_page(request: Request, service: ServiceDep, a: _IdQuery, b: _IdQuery) -> HTMLResponse:
    """Return the comparison of two scored submissions, which anyone who knows their ids may read."""
    public = all(get_submission(service, submission_id).public for submission_id in (a, b))
    context = comparison_context(service, a, b)
    return render(request, "comparison.html.j2", cache=_cache_control(public), **context)


@router.get("/how-to-submit", name="how_to_submit")
async def how_to_submit(request: Request) -> HTMLResponse:
    """Return the page with submission instructions and the upload form."""
    return how_to_page(request)


def _cache_control(public: bool) -> str:
    return REVALIDATE if public else NO_STORE
