"""Routes of the HTML pages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, HTTPException, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from leaderboard.db.rankings import error_map_webp, ranks
from leaderboard.db.submissions import SCORED
from leaderboard.web.api.auth import ServiceDep, service_of
from leaderboard.web.api.submissions import SubmissionId, get_submission
from leaderboard.web.cache import (
    NO_STORE,
    REVALIDATE,
    RenderedBody,
    cache_state_of,
    cached_public_body,
    conditional_response,
    get_or_render,
)
from leaderboard.web.pages.leaderboard import (
    NATIVE,
    SCALED,
    WITHIN,
    ConfigRanking,
    make_config_ranking,
    parse_order,
    published_numbers,
)
from leaderboard.web.pages.rendering import page_content, render, root_path
from leaderboard.web.pages.submission import submission_context
from leaderboard.web.pages.submit import how_to_page
from rebar_depth_bench.submission.metadata import INPUTS

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

HTML = "text/html; charset=utf-8"
MAX_OVERVIEW_ROWS = 25
"""Rows shown per config on a page of several configs, which links to the full rankings."""

_NameQuery = Annotated[str | None, Query(max_length=100)]
_PathPart = Annotated[str, Path(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


@router.get("/", name="board_page")
async def leaderboard_page(
    request: Request, config: _NameQuery = None, sort: _NameQuery = None, inputs: _NameQuery = None
) -> Response:
    """Return the page with the rankings of all configs, or of ``config`` only, in the order ``sort``.

    With ``inputs``, only the rows of this input class are shown.
    """
    service = service_of(request)
    all_configs = service.folder.configs
    if config is not None and config not in all_configs:
        raise HTTPException(404, f"the dataset has no config {config!r}, expected one of {', '.join(all_configs)}")
    configs = all_configs if config is None else (config,)
    max_rows = MAX_OVERVIEW_ROWS if len(configs) > 1 else None
    order, inputs = parse_order(sort), inputs if inputs in INPUTS else None
    key_prefix = (leaderboard_page, root_path(request), config, order, inputs)

    def make() -> RenderedBody:
        rankings = [make_config_ranking(service.database, name, order, inputs, max_rows) for name in configs]
        return (*key_prefix, *(ranking.version for ranking in rankings)), _leaderboard_content(
            request, all_configs, config, inputs, rankings
        )

    body = await cached_public_body(request, configs, key_prefix, make)
    return conditional_response(request, body, HTML, {"Cache-Control": REVALIDATE})


@router.get("/submissions/{submission_id}", name="submission_page")
async def submission_page(
    submission_id: SubmissionId, request: Request, service: ServiceDep, views: _NameQuery = None
) -> Response:
    """Return the page of a submission, which anyone who knows its URL may read.

    All views of the config ``views`` are listed, and the worst views of the others.
    """
    record = await to_thread.run_sync(get_submission, service, submission_id)
    if record.status != SCORED:
        context = await to_thread.run_sync(submission_context, service, record, views)
        return render(request, "submission.html.j2", cache=NO_STORE, **context)
    views = views if views in service.folder.configs else None
    cache_state = cache_state_of(request)
    # The ranks on the page depend on the public rows of all configs.
    versions = tuple(sorted((await cache_state.versions.get()).items()))
    version = (record.id, record.finished_at, record.public, versions)
    key = (submission_page, root_path(request), views, *version)

    def make() -> RenderedBody:
        context = submission_context(service, record, views, ranks(service.database, record))
        return key, page_content(request, "submission.html.j2", **context)

    body = await get_or_render(cache_state, key, make)
    return conditional_response(request, body, HTML, {"Cache-Control": _cache_control(record.public)})


@router.get("/submissions/{submission_id}/error-maps/{config}/{number}.webp", response_class=Response)
def error_map(submission_id: SubmissionId, config: _PathPart, number: _PathPart, service: ServiceDep) -> Response:
    """Return the error map of a view. Raises status 404 if none is stored."""
    record = get_submission(service, submission_id)
    webp = error_map_webp(service.database, submission_id, f"{config}/{number}")
    if webp is None:
        raise HTTPException(404, "there is no error map of this view")
    return Response(webp, media_type="image/webp", headers={"Cache-Control": _cache_control(record.public)})


@router.get("/how-to-submit", name="how_to_submit")
def how_to_submit(request: Request) -> HTMLResponse:
    """Return the page with submission instructions and the upload form."""
    return how_to_page(request)


def _leaderboard_content(
    request: Request,
    all_configs: Sequence[str],
    chosen: str | None,
    inputs: str | None,
    rankings: Sequence[ConfigRanking],
) -> bytes:
    published = published_numbers()
    return page_content(
        request,
        "board.html.j2",
        configs=all_configs,
        chosen=chosen,
        inputs=inputs,
        rankings=rankings,
        columns={"native": NATIVE, "scaled": SCALED, "within": WITHIN},
        paper_title=published.title,
        paper_part=published.parts["synthetic"],
    )


def _cache_control(public: bool) -> str:
    return REVALIDATE if public else NO_STORE
