"""The pages' addresses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from leaderboard.db.rankings import picture, ranks
from leaderboard.db.submissions import SCORED
from leaderboard.web.api.auth import ServiceDep, service_of
from leaderboard.web.api.submissions import SubmissionId, found
from leaderboard.web.cache import FRESH, PRIVATE, Made, answer, public_body, shelf_of
from leaderboard.web.pages.leaderboard import (
    NATIVE,
    SCALED,
    WITHIN,
    Board,
    make_board,
    published_numbers,
    read_order,
)
from leaderboard.web.pages.rendering import page_content, place, render
from leaderboard.web.pages.submission import submission_part
from leaderboard.web.pages.submit import how_to_page

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

HTML = "text/html; charset=utf-8"
MOST_AT_ONCE = 25
"""Rows of a config where the page shows several: the others are a link away."""

_Name = Annotated[str | None, Query(max_length=100)]
_Part = Annotated[str, Path(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


@router.get("/", name="board_page")
async def board_page(request: Request, config: _Name = None, sort: _Name = None) -> Response:
    """Show the boards of all configs, or the one that is asked for, in the order that is asked for."""
    service = service_of(request)
    known = service.folder.configs
    if config is not None and config not in known:
        raise HTTPException(404, f"the dataset has no config {config!r}, expected one of {', '.join(known)}")
    shown = known if config is None else (config,)
    most = MOST_AT_ONCE if len(shown) > 1 else None
    order = read_order(sort)
    asked = (board_page, place(request), config, order)

    def make() -> Made:
        boards = [make_board(service.database, name, order, most) for name in shown]
        return (*asked, *(board.stamp for board in boards)), _board_content(request, known, config, boards)

    body = await public_body(request, shown, asked, make)
    return answer(request, body, HTML, {"Cache-Control": FRESH})


router.add_api_route("/", board_page, methods=["HEAD"])


@router.get("/submissions/{submission_id}", name="submission_page")
def submission_page(
    submission_id: SubmissionId, request: Request, service: ServiceDep, views: _Name = None
) -> Response:
    """Show a submission to whoever has its address; ``views`` names the config whose views are all listed."""
    record = found(service, submission_id)
    if record.status != SCORED:
        return render(request, "submission.html.j2", cache=PRIVATE, **submission_part(service, record, views))
    placed = ranks(service.database, record)
    seen = (record.id, record.finished_at, record.public, *sorted(placed.items()))
    views = views if views in service.folder.configs else None
    key = (submission_page, place(request), views, *seen)

    def make() -> Made:
        shown = submission_part(service, record, views, placed)
        return key, page_content(request, "submission.html.j2", **shown)

    body = shelf_of(request).bodies.get(key, make)
    return answer(request, body, HTML, {"Cache-Control": _cache(record.public)})


@router.get("/submissions/{submission_id}/error-maps/{config}/{number}.webp", response_class=Response)
def error_map(submission_id: SubmissionId, config: _Part, number: _Part, service: ServiceDep) -> Response:
    """Return a view's error map, where the service keeps it."""
    record = found(service, submission_id)
    webp = picture(service.database, submission_id, f"{config}/{number}")
    if webp is None:
        raise HTTPException(404, "no error map of this view is kept")
    return Response(webp, media_type="image/webp", headers={"Cache-Control": _cache(record.public)})


@router.get("/how-to-submit", name="how_to_submit")
def how_to_submit(request: Request) -> HTMLResponse:
    """Show how to submit, and a form to do it with."""
    return how_to_page(request)


def _board_content(request: Request, known: Sequence[str], chosen: str | None, boards: Sequence[Board]) -> bytes:
    published = published_numbers()
    return page_content(
        request,
        "board.html.j2",
        configs=known,
        chosen=chosen,
        boards=boards,
        columns={"native": NATIVE, "scaled": SCALED, "within": WITHIN},
        paper_title=published.title,
        paper_part=published.parts["synthetic"],
    )


def _cache(public: bool) -> str:
    return FRESH if public else PRIVATE
