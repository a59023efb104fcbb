"""Pages for the owner of a token: upload an archive; list, publish, withdraw, edit and delete submissions.

The token is a field of every form, and nothing is stored in the browser: there are no cookies or sessions. Other
sites do not know the token, so the forms need no further protection against forged requests.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from pydantic import ValidationError

from leaderboard.changes import SubmissionChange, delete_submission, edit_submission, get_own_submission
from leaderboard.db import submissions
from leaderboard.db.models import TokenModel
from leaderboard.db.tokens import find_token
from leaderboard.refusals import RefusedError
from leaderboard.service import Service
from leaderboard.uploads import UploadForm, accept_upload
from leaderboard.web.dependencies import MAX_PATCH_BYTES, ServiceDep, check_length, page_url, service_of
from leaderboard.web.middleware import NO_STORE, REVALIDATE
from leaderboard.web.pages.rendering import clean_text, problem_lines, render
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.submission.declaration import MethodDetails

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

EDITABLE = tuple(MethodDetails.model_fields)
_CHALLENGE = {"WWW-Authenticate": "Bearer"}


@router.get("/account", name="account_page")
async def account_page(request: Request) -> HTMLResponse:
    """Return the form that asks for the token."""
    return render(request, "account.html.j2", token="", message="")


@router.post("/account", max_body_size=MAX_PATCH_BYTES)
async def account(request: Request) -> HTMLResponse:
    """Make the change of a form, if any, and return the list of the token's submissions."""
    fields = dict(parse_qsl((await request.body()).decode(errors="replace"), keep_blank_values=True))
    return await to_thread.run_sync(_account, request, fields)


def _account(request: Request, fields: Mapping[str, str]) -> HTMLResponse:
    service, template, text = service_of(request), "account.html.j2", fields.get("token", "").strip()
    token = find_token(service.database, text)
    if token is None:
        page = {"token": "", "message": "The token is unknown."}
        return render(request, template, status_code=401, cache=NO_STORE, headers=_CHALLENGE, **page)
    status, message = _change(service, token, fields)
    with service.database.read() as session:
        used = submissions.quota_used(session, token)
    rankings = {config: service.rankings.of(config, token) for config in service.folder.configs}
    own = []
    for record in submissions.of_token(service.database, token):
        rows = {name: ranking.by_id[record.id] for name, ranking in rankings.items() if record.id in ranking.by_id}
        own.append((record, json.loads(record.details), rows))
    return render(
        request,
        template,
        status_code=status,
        cache=NO_STORE,
        token=text,
        name=token.name,
        message=message,
        left=max(0, service.settings.quota - used.submissions),
        bytes_left=max(0, service.settings.quota_bytes - used.size),
        own=own,
        editable=EDITABLE,
    )


def _change(service: Service, token: TokenModel, fields: Mapping[str, str]) -> tuple[int, str]:
    """Make the change that a form asks for; return the status and a message, which is empty without a change."""
    action = fields.get("action")
    if not action:
        return 200, ""
    try:
        record = get_own_submission(service, fields.get("id", ""), token)
        if action == "delete":
            delete_submission(service, record)
            return 200, f"{printable(record.method)} is deleted."
        if action in ("publish", "withdraw"):
            change = SubmissionChange(public=action == "publish")
        elif action == "edit":
            values: dict[str, Any] = {name: fields[name].strip() or None for name in EDITABLE if name in fields}
            change = SubmissionChange.model_validate(values)
        else:
            raise RefusedError(422, "there is no such action")
        edit_submission(service, record, change)
    except RefusedError as error:
        return error.status, f"Not changed: {error.detail}."
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        return 422, f"Not changed: {printable(wrong, 500)}."
    return 200, f"{printable(record.method)} is changed."


# Submission instructions, and the upload form.


@router.get("/how-to-submit", name="how_to_submit")
async def how_to_submit(request: Request) -> HTMLResponse:
    """Return the page with submission instructions and the upload form."""
    return _how_to_page(request)


@router.post("/submit")
async def submit(request: Request, service: ServiceDep) -> Response:
    """Accept an archive from the form, with the checks and errors of the API, and respond with a page.

    The token is checked before any of the archive is stored.
    """
    try:
        check_length(request)
        form = UploadForm(request.stream(), request.headers.get("content-type", ""))
        text = (await form.token()).strip()
        if not text:
            raise RefusedError(401, "no token, expected the token that you received from the operator")
        token = await to_thread.run_sync(find_token, service.database, text)
        if token is None:
            raise RefusedError(401, "the token is unknown")
        record, _ = await accept_upload(service, token, form.archive())
    except RefusedError as error:
        return _how_to_page(request, error.status, error.detail, problem_lines(error.problems))
    # Path only: behind a proxy, Content-Security-Policy form-action rejects a scheme other than the browser's.
    return RedirectResponse(urlsplit(page_url(request, record)).path, 303)


def _how_to_page(
    request: Request, status: int = 200, message: str = "", problems: Sequence[str] = ()
) -> HTMLResponse:
    """Return the page; after a rejected upload with the error message, its problems and its HTTP status."""
    service = service_of(request)
    return render(
        request,
        "how_to.html.j2",
        status_code=status,
        cache=NO_STORE if message else REVALIDATE,
        headers=_CHALLENGE if status == 401 else None,
        refusal=clean_text(message),
        problems=[clean_text(problem) for problem in problems if problem != message],
        address=service.settings.public_url or str(request.base_url).rstrip("/"),
        first_view=next(iter(service.folder.expected_views(TEST_SPLIT)), ""),
    )
