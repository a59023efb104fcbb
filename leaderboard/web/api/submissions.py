"""Endpoints of ``/api/v1/submissions``: upload, look up, publish, delete.

The docstrings of the endpoints are part of the OpenAPI document.
"""

from __future__ import annotations

import json
from typing import Annotated

import structlog
from fastapi import APIRouter, HTTPException, Path, Request, Response

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.service import Service
from leaderboard.uploads.accept import accept_upload
from leaderboard.web.api.auth import WITHOUT_TOKEN, OptionalToken, RequiredToken, ServiceDep
from leaderboard.web.api.schemas import (
    COMMON_RESPONSES,
    MALFORMED_RESPONSE,
    MISSING_TOKEN_RESPONSE,
    UNKNOWN_TOKEN_RESPONSE,
    ErrorResponse,
    Publication,
    RejectedResponse,
    Responses,
    Submission,
    submission_schema,
)

MAX_PATCH_BYTES = 1 << 10
_LOG = structlog.get_logger("submissions")
router = APIRouter(prefix="/api/v1/submissions", tags=["submissions"], responses=COMMON_RESPONSES)

SubmissionId = Annotated[str, Path(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_-]+$")]
_UPLOAD_REQUEST_BODY = {
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
_ERROR_RESPONSES: Responses = {
    **MISSING_TOKEN_RESPONSE,
    408: {"model": ErrorResponse, "description": "the client sent nothing for too long"},
    413: {"model": ErrorResponse, "description": "the archive is too large"},
    422: {"model": RejectedResponse, "description": "the archive is invalid; it does not count against the quota"},
    429: {"model": ErrorResponse, "description": "too many requests, or the daily quota is used up"},
}
_NOT_FOUND_RESPONSES: Responses = {
    404: {"model": ErrorResponse, "description": "no such submission"},
    **MALFORMED_RESPONSE,
}
_OWNER_ERROR_RESPONSES: Responses = {
    **MISSING_TOKEN_RESPONSE,
    403: {"model": ErrorResponse, "description": "you are not the owner of this submission"},
    **_NOT_FOUND_RESPONSES,
}
_ACCEPTED_RESPONSE: Responses = {
    202: {
        "description": "accepted; the archive and its database row are stored on disk",
        "headers": {"Location": {"description": "URL path of the submission", "schema": {"type": "string"}}},
    }
}
_UNREADABLE_RESPONSE: Responses = {400: {"model": ErrorResponse, "description": "the body is not valid UTF-8"}}


@router.post(
    "", status_code=202, responses={**_ACCEPTED_RESPONSE, **_ERROR_RESPONSES}, openapi_extra=_UPLOAD_REQUEST_BODY
)
async def upload(request: Request, response: Response, service: ServiceDep, token: RequiredToken) -> Submission:
    """Upload an archive. It is validated before it is accepted, and stored durably before 202 is sent."""
    record = await accept_upload(service, token, request.stream(), request.headers)
    response.headers["Location"] = request.url_for("look_up", submission_id=record.id).path
    return submission_schema(record, page_url(request, record))


@router.get(
    "/{submission_id}", responses={**UNKNOWN_TOKEN_RESPONSE, **_NOT_FOUND_RESPONSES}, openapi_extra=WITHOUT_TOKEN
)
def look_up(submission_id: SubmissionId, request: Request, service: ServiceDep, _: OptionalToken) -> Submission:
    """Return a submission. Its id cannot be guessed and gives read access without a token."""
    record = get_submission(service, submission_id)
    result = submissions.result_json(service.database, submission_id)
    return submission_schema(record, page_url(request, record), None if result is None else json.loads(result))


@router.get(
    "/{submission_id}/result.json",
    responses={**_NOT_FOUND_RESPONSES, 200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
    response_class=Response,
)
def result(submission_id: SubmissionId, service: ServiceDep) -> Response:
    """Return the result, byte for byte as `rebar-bench score ARCHIVE --data ROOT --json FILE` writes it.

    If the ground truth is hidden, it is only the rank error and the coverage of each config, rounded.
    """
    get_submission(service, submission_id)
    content = submissions.result_json(service.database, submission_id)
    if content is None:
        raise HTTPException(404, "the submission has no result")
    return Response(content, media_type="application/json")


@router.patch(
    "/{submission_id}", responses={**_UNREADABLE_RESPONSE, **_OWNER_ERROR_RESPONSES}, max_body_size=MAX_PATCH_BYTES
)
def publish(
    submission_id: SubmissionId, change: Publication, request: Request, service: ServiceDep, token: RequiredToken
) -> Submission:
    """Publish a submission's rows on the leaderboard, or withdraw them; only the owner may do this."""
    record = get_own_submission(service, submission_id, token)
    if service.settings.default_visibility == "always" and not change.public:
        raise HTTPException(403, "every submission of this leaderboard is public")
    submissions.publish(service.database, submission_id, change.public)
    record.public = change.public
    return submission_schema(record, page_url(request, record))


@router.delete("/{submission_id}", status_code=204, responses=_OWNER_ERROR_RESPONSES)
def delete(submission_id: SubmissionId, service: ServiceDep, token: RequiredToken) -> None:
    """Delete a submission with its archive and results; only the owner may do this. The quota is not restored."""
    get_own_submission(service, submission_id, token)
    submissions.remove(service.database, submission_id)
    try:
        service.archives.delete(submission_id)
    except OSError as error:  # Storage unavailable: the orphaned archive is removed at a later startup.
        _LOG.warning("archive not deleted", submission=submission_id[:6], error=str(error))


def get_submission(service: Service, submission_id: str) -> SubmissionModel:
    """Return the row of a submission. Raises status 404 if it does not exist."""
    record = submissions.find(service.database, submission_id)
    if record is None:
        raise HTTPException(404, "no such submission")
    return record


def get_own_submission(service: Service, submission_id: str, token: TokenModel) -> SubmissionModel:
    """Return the row of a submission. Raises status 404 if it does not exist, 403 if another token owns it."""
    record = get_submission(service, submission_id)
    if record.token_id != token.id:
        raise HTTPException(403, "you are not the owner of this submission")
    return record


def page_url(request: Request, record: SubmissionModel) -> str:
    """Return the URL of a submission's page."""
    return str(request.url_for("submission_page", submission_id=record.id))
