"""``/api/v1/submissions``: upload, look up, publish, delete."""

from __future__ import annotations

import json
from typing import Annotated

import structlog
from fastapi import APIRouter, HTTPException, Path, Request, Response

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionRecord, TokenRecord
from leaderboard.uploads.accept import take_in
from leaderboard.web.api.auth import WITHOUT_TOKEN, OptionalToken, RequiredToken, ServiceDep
from leaderboard.web.api.schemas import (
    ANY_TIME,
    MALFORMED,
    NO_TOKEN,
    UNKNOWN_TOKEN,
    Answers,
    Problem,
    Problems,
    Publication,
    Submission,
    submission_model,
)
from leaderboard.web.context import Service

MOST_CHANGE = 1 << 10
_LOG = structlog.get_logger("submissions")
router = APIRouter(prefix="/api/v1/submissions", tags=["submissions"], responses=ANY_TIME)

SubmissionId = Annotated[str, Path(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_-]+$")]
_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["archive"],
                    "properties": {"archive": {"type": "string", "format": "binary"}},
                }
            }
        },
    }
}
_REFUSALS: Answers = {
    **NO_TOKEN,
    413: {"model": Problem, "description": "the archive is too large"},
    422: {"model": Problems, "description": "the archive is refused; the quota is not charged"},
    429: {"model": Problem, "description": "too many requests, or the quota of the day is spent"},
}
_NOT_FOUND: Answers = {404: {"model": Problem, "description": "no such submission"}, **MALFORMED}
_OWNERS: Answers = {**NO_TOKEN, 403: {"model": Problem, "description": "another's submission"}, **_NOT_FOUND}
_ACCEPTED: Answers = {
    202: {
        "description": "accepted: file and row are on disk",
        "headers": {"Location": {"description": "where to ask what became of it", "schema": {"type": "string"}}},
    }
}
_UNREADABLE: Answers = {400: {"model": Problem, "description": "the body is no UTF-8"}}


@router.post("", status_code=202, responses={**_ACCEPTED, **_REFUSALS}, openapi_extra=_BODY)
async def upload(request: Request, response: Response, service: ServiceDep, token: RequiredToken) -> Submission:
    """Upload an archive. It is checked before it is accepted; once 202 is sent it is never lost."""
    record = await take_in(service, token, request.stream(), request.headers)
    response.headers["Location"] = request.url_for("look_up", submission_id=record.id).path
    return submission_model(record, page_url(request, record))


@router.get("/{submission_id}", responses={**UNKNOWN_TOKEN, **_NOT_FOUND}, openapi_extra=WITHOUT_TOKEN)
def look_up(submission_id: SubmissionId, request: Request, service: ServiceDep, _: OptionalToken) -> Submission:
    """Return a submission. Its id cannot be guessed: whoever has it may read, token or not."""
    record = found(service, submission_id)
    result = submissions.result_json(service.database, submission_id)
    return submission_model(record, page_url(request, record), None if result is None else json.loads(result))


@router.get(
    "/{submission_id}/result.json",
    responses={**_NOT_FOUND, 200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
    response_class=Response,
)
def result(submission_id: SubmissionId, service: ServiceDep) -> Response:
    """Return the result, byte for byte what `rebar-bench score ARCHIVE --data ROOT --json FILE` writes."""
    found(service, submission_id)
    content = submissions.result_json(service.database, submission_id)
    if content is None:
        raise HTTPException(404, "the submission has no result")
    return Response(content, media_type="application/json")


@router.patch("/{submission_id}", responses={**_UNREADABLE, **_OWNERS}, max_body_size=MOST_CHANGE)
def publish(
    submission_id: SubmissionId, change: Publication, request: Request, service: ServiceDep, token: RequiredToken
) -> Submission:
    """Put a submission's rows on the board, or take them off; its owner only."""
    record = owned(service, submission_id, token)
    if service.settings.public == "always" and not change.public:
        raise HTTPException(403, "every submission is public here")
    submissions.publish(service.database, submission_id, change.public)
    record.public = change.public
    return submission_model(record, page_url(request, record))


@router.delete("/{submission_id}", status_code=204, responses=_OWNERS)
def delete(submission_id: SubmissionId, service: ServiceDep, token: RequiredToken) -> None:
    """Delete a submission with its archive and results; its owner only. The quota is not given back."""
    owned(service, submission_id, token)
    submissions.remove(service.database, submission_id)
    try:
        service.archives.delete(submission_id)
    except OSError as error:  # the place does not answer: an archive of nobody is cleared at a later start
        _LOG.warning("archive not deleted", submission=submission_id[:6], error=str(error))


def found(service: Service, submission_id: str) -> SubmissionRecord:
    """Return a submission's record; 404 where there is none."""
    record = submissions.find(service.database, submission_id)
    if record is None:
        raise HTTPException(404, "no such submission")
    return record


def owned(service: Service, submission_id: str, token: TokenRecord) -> SubmissionRecord:
    """Return a submission's record; 403 where it is another's."""
    record = found(service, submission_id)
    if record.token_id != token.id:
        raise HTTPException(403, "another's submission")
    return record


def page_url(request: Request, record: SubmissionRecord) -> str:
    """Return the address of a submission's page."""
    return str(request.url_for("submission_page", submission_id=record.id))
