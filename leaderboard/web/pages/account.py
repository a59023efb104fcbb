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
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.tokens import find_token
from leaderboard.refusals import RefusedError
from leaderboard.service import Service
from leaderboard.uploads.accept import accept_upload
from leaderboard.uploads.multipart import UploadForm
from leaderboard.web.cache import NO_STORE, REVALIDATE
from leaderboard.web.dependencies import MAX_PATCH_BYTES, ServiceDep, check_length, page_url, service_of
from leaderboard.web.pages.rendering import clean_text, problem_lines, render
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.submission.declaration import MethodDetails

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

EDITABLE = tuple(MethodDetails.model_fields)


@router.get("/account", name="account_page")
async def account_page(request: Request) -> HTMLResponse:
    """Return the form that asks for the token."""
    return render(request, "account.html.j2", token="", message="")


@router.post("/account", max_body_size=MAX_PATCH_BYTES)
async def account(request: Request, service: ServiceDep) -> HTMLResponse:
    """Make the change of a form, if any, and return the list of the token's submissions."""
    fields = dict(parse_qsl((await request.body()).decode(errors="replace"), keep_blank_values=True))
    text = fields.get("token", "").strip()
    token = await to_thread.run_sync(find_token, service.database, text)
    if token is None:
        challenge, message = {"WWW-Authenticate": "Bearer"}, "The token is unknown."
        return render(
            request,
            "account.html.j2",
            status_code=401,
            cache=NO_STORE,
            headers=challenge,
            token="",
            message=message,
        )
    status, message = await to_thread.run_sync(_change, service, token, fields)
    records = await to_thread.run_sync(submissions.of_token, service.database, token)
    return render(
        request,
        "account.html.j2",
        status_code=status,
        cache=NO_STORE,
        token=text,
        name=token.name,
        message=message,
        own=[(record, json.loads(record.details)) for record in records],
        editable=EDITABLE,
    )


def _change(service: Service, token: TokenModel, fields: Mapping[str, str]) -> tuple[int, str]:
    """Make the change that a form asks for; return the status and a message, which is empty without a change."""
    action, submission_id = fields.get("action", ""), fields.get("id", "")
    if not action:
        return 200, ""
    try:
        record = get_own_submission(service, submission_id, token)
        if action == "delete":
            delete_submission(service, record)
            return 200, f"{printable(record.method)} is deleted."
        edit_submission(service, record, _change_of(action, fields))
    except RefusedError as error:
        return error.status, f"Not changed: {error.detail}."
    except ValidationError as error:
        wrong = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        return 422, f"Not changed: {printable(wrong, 500)}."
    return 200, f"{printable(record.method)} is changed."


def _change_of(action: str, fields: Mapping[str, str]) -> SubmissionChange:
    """Return the change of a form. Raises status 422 for an unknown action and ``ValidationError``."""
    if action in ("publish", "withdraw"):
        return SubmissionChange(public=action == "publish")
    if action != "edit":
        raise RefusedError(422, "there is no such action")
    values: dict[str, Any] = {name: fields[name].strip() or None for name in EDITABLE if name in fields}
    return SubmissionChange.model_validate(values)


# Submission instructions, and the upload form.


@router.get("/how-to-submit", name="how_to_submit")
async def how_to_submit(request: Request) -> HTMLResponse:
    """Return the page with submission instructions and the upload form."""
    return _how_to_page(request)


@router.post("/submit")
async def submit(request: Request, service: ServiceDep) -> Response:
    """Accept an archive from the form, with the checks and errors of the API, and respond with a page."""
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
