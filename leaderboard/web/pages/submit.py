"""How to submit, and the form: the API's upload for people."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from urllib.parse import urlsplit

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from leaderboard.db.models import SubmissionRecord
from leaderboard.db.tokens import find_token
from leaderboard.uploads.accept import RefusedError, take_in
from leaderboard.uploads.multipart import UploadError, leading_field
from leaderboard.web.api.auth import ServiceDep
from leaderboard.web.api.submissions import page_url
from leaderboard.web.cache import FRESH, PRIVATE
from leaderboard.web.context import Service
from leaderboard.web.pages.rendering import lines, render, service_address, size

router = APIRouter(include_in_schema=False)

TOKEN_FIELD = "token"


@router.post("/submit", response_class=HTMLResponse)
async def submit(request: Request, service: ServiceDep) -> Response:
    """Take an archive from the form: the checks and refusals are the API's, the answers are pages.

    There is no cookie and no session: the token in the form is all that lets a request in, and another site's
    page does not know it. That is why the form needs no further token against forged requests.
    """
    try:
        record = await _take_in(service, request.stream(), request)
    except RefusedError as refusal:
        return how_to_page(request, refusal.status, refusal.detail, refusal.problems or ())
    # A path alone: behind a proxy the form's policy would refuse another scheme than the browser's.
    return RedirectResponse(urlsplit(page_url(request, record)).path, 303)


def how_to_page(
    request: Request, status: int = 200, refusal: str = "", problems: Sequence[str] = ()
) -> HTMLResponse:
    """Return the page; after a ``refusal`` with why, every problem a line, and the refusal's status."""
    service: Service = request.app.state.service
    settings = service.settings
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else {}
    return render(
        request,
        "how_to.html.j2",
        status_code=status,
        cache=PRIVATE if refusal else FRESH,
        headers=headers,
        refusal=lines(refusal),
        problems=[lines(problem) for problem in problems if problem != refusal],
        address=service_address(request),
        quota=settings.quota,
        most=size(settings.max_upload),
        most_bytes=settings.max_upload,
        always_public=settings.public == "always",
        dataset_configs=service.folder.configs,
    )


async def _take_in(service: Service, body: AsyncIterator[bytes], request: Request) -> SubmissionRecord:
    """Accept the form's archive; a token that is wrong is told before any of the archive is kept."""
    try:
        text, whole = await leading_field(body, request.headers.get("content-type", ""), TOKEN_FIELD)
    except UploadError as error:
        raise RefusedError(error.status, error.detail) from None
    if not text.strip():
        raise RefusedError(401, "no token, expected the one that the operator gave you")
    token = await to_thread.run_sync(find_token, service.database, text.strip())
    if token is None:
        raise RefusedError(401, "the token is unknown")
    return await take_in(service, token, whole, request.headers)
