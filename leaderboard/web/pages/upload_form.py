"""Page with submission instructions, and its upload form."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlsplit

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from leaderboard.db.models import SubmissionModel
from leaderboard.db.tokens import find_token
from leaderboard.refusals import RefusedError
from leaderboard.service import Service
from leaderboard.uploads.accept import accept_upload
from leaderboard.uploads.multipart import UploadForm
from leaderboard.web.cache import NO_STORE, REVALIDATE
from leaderboard.web.dependencies import ServiceDep, check_length, page_url, service_of
from leaderboard.web.pages.rendering import clean_text, problem_lines, render
from rebar_depth_bench.base.names import TEST_SPLIT

router = APIRouter(include_in_schema=False)


@router.get("/how-to-submit", name="how_to_submit", response_class=HTMLResponse)
async def how_to_submit(request: Request) -> HTMLResponse:
    """Return the page with submission instructions and the upload form."""
    return _how_to_page(request)


@router.post("/submit", response_class=HTMLResponse)
async def submit(request: Request, service: ServiceDep) -> Response:
    """Accept an archive from the form, with the checks and errors of the API, and respond with a page.

    The form needs no CSRF token: there are no cookies or sessions, and other sites do not know the token in the
    form, which alone authenticates the request.
    """
    try:
        check_length(request)
        record = await _accept_form_upload(service, request)
    except RefusedError as error:
        return _how_to_page(request, error.status, error.detail, problem_lines(error.problems))
    # Path only: behind a proxy, Content-Security-Policy form-action rejects a scheme other than the browser's.
    return RedirectResponse(urlsplit(page_url(request, record)).path, 303)


def _how_to_page(
    request: Request, status: int = 200, message: str = "", problems: Sequence[str] = ()
) -> HTMLResponse:
    """Return the page; after a rejected upload with the error message, its problems and its HTTP status."""
    service = service_of(request)
    configs = service.folder.configs
    return render(
        request,
        "how_to.html.j2",
        status_code=status,
        cache=NO_STORE if message else REVALIDATE,
        headers={"WWW-Authenticate": "Bearer"} if status == 401 else None,
        refusal=clean_text(message),
        problems=[clean_text(problem) for problem in problems if problem != message],
        address=service.settings.public_url or str(request.base_url).rstrip("/"),
        dataset_configs=configs,
        first_view=next(iter(service.folder.expected_views(TEST_SPLIT)), ""),
    )


async def _accept_form_upload(service: Service, request: Request) -> SubmissionModel:
    """Accept the archive of the form; the token is checked before any of the archive is stored.

    Raises ``RefusedError``.
    """
    form = UploadForm(request.stream(), request.headers.get("content-type", ""))
    text = (await form.token()).strip()
    if not text:
        raise RefusedError(401, "no token, expected the token that you received from the operator")
    token = await to_thread.run_sync(find_token, service.database, text)
    if token is None:
        raise RefusedError(401, "the token is unknown")
    record, _ = await accept_upload(service, token, form.archive())
    return record
