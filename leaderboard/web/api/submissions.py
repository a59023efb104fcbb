"""Endpoints of ``/api/v1/submissions``: upload, look up, publish, delete.

The docstrings of the endpoints are part of the OpenAPI document.
"""

from __future__ import annotations

import json
from typing import Any

from fastapi import APIRouter, HTTPException, Request, Response

from leaderboard.changes import (
    SubmissionChange,
    delete_submission,
    edit_submission,
    get_own_submission,
    get_submission,
)
from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import ShownResult, result_content, shown_results
from leaderboard.uploads import UploadForm, accept_upload
from leaderboard.web.api.errors import Responses, errors
from leaderboard.web.dependencies import (
    MAX_PATCH_BYTES,
    WITHOUT_TOKEN,
    OptionalToken,
    RequiredToken,
    ServiceDep,
    SubmissionId,
    check_length,
    page_url,
    service_of,
)
from rebar_depth_bench.remote.models import Submission, SubmissionList

router = APIRouter(prefix="/api/v1/submissions", tags=["submissions"], responses=errors(503))

_BINARY = {"type": "string", "format": "binary"}
_UPLOAD_REQUEST_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {"type": "object", "required": ["archive"], "properties": {"archive": _BINARY}}
            }
        },
    }
}
_ACCEPTED_RESPONSE: Responses = {
    200: {
        "description": "the token has sent this archive before; its submission is returned, unless it is outdated "
        "and its archive is gone"
    },
    202: {
        "description": "accepted; the archive and its database row are stored on disk",
        "headers": {"Location": {"description": "URL path of the submission", "schema": {"type": "string"}}},
    },
}


@router.put(
    "",
    status_code=202,
    responses={**_ACCEPTED_RESPONSE, **errors(401, 413, 422, 429)},
    openapi_extra={
        "requestBody": {"required": True, "content": {"application/zip": {"schema": _BINARY}}},
    },
)
async def upload(request: Request, response: Response, service: ServiceDep, token: RequiredToken) -> Submission:
    """Upload an archive as the body. It is checked before it is accepted, and stored durably before 202 is sent.

    If the token has sent the same archive before, status 200 and that submission are returned. Predictions that
    are not metric (`prediction` in `submission.json`) are refused with 422, as all problems of an archive, which
    do not count against the quota.
    """
    check_length(request)
    return _accepted(request, response, await accept_upload(service, token, request.stream()))


@router.post(
    "",
    status_code=202,
    responses={**_ACCEPTED_RESPONSE, **errors(401, 413, 422, 429)},
    openapi_extra=_UPLOAD_REQUEST_BODY,
)
async def upload_form(
    request: Request, response: Response, service: ServiceDep, token: RequiredToken
) -> Submission:
    """Upload an archive as the field `archive` of a form, with the checks and responses of `PUT`."""
    check_length(request)
    form = UploadForm(request.stream(), request.headers.get("content-type", ""))
    return _accepted(request, response, await accept_upload(service, token, form.archive()))


@router.get("", responses=errors(401))
def list_own(request: Request, service: ServiceDep, token: RequiredToken) -> SubmissionList:
    """Return the submissions of the token, newest first, without their results."""
    records = submissions.of_token(service.database, token)
    shown = shown_results(service.database, records, service.folder.digest)
    return SubmissionList(submissions=[_schema(request, record, shown.get(record.id)) for record in records])


@router.get("/{submission_id}", responses=errors(401, 404, 422), openapi_extra=WITHOUT_TOKEN)
def look_up(submission_id: SubmissionId, request: Request, service: ServiceDep, _: OptionalToken) -> Submission:
    """Return a submission. Its id cannot be guessed and gives read access without a token."""
    record = get_submission(service, submission_id)
    shown = shown_results(service.database, [record], service.folder.digest).get(record.id)
    content = shown and result_content(service.database, record.id, shown)
    return _schema(request, record, shown, json.loads(content[0]) if content else None)


@router.get(
    "/{submission_id}/result.json",
    responses={**errors(404, 422), 200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
    response_class=Response,
)
def result(submission_id: SubmissionId, service: ServiceDep) -> Response:
    """Return the result, byte for byte as `rebar-bench score ARCHIVE --data ROOT --json FILE` writes it.

    It is the result on the dataset that is served, or else the newest one, which names its dataset.
    """
    record = get_submission(service, submission_id)
    shown = shown_results(service.database, [record], service.folder.digest).get(record.id)
    content = None if shown is None else result_content(service.database, record.id, shown)
    if content is None:
        raise HTTPException(404, "the submission has no result")
    return Response(content[0], media_type="application/json")


@router.patch(
    "/{submission_id}",
    responses=errors(400, 401, 403, 404, 422),
    max_body_size=MAX_PATCH_BYTES,
)
def edit(
    submission_id: SubmissionId,
    change: SubmissionChange,
    request: Request,
    service: ServiceDep,
    token: RequiredToken,
) -> Submission:
    """Publish a submission's rows, withdraw them, or change what is said about the method; only as the owner."""
    record = get_own_submission(service, submission_id, token)
    edit_submission(service, record, change)
    shown = shown_results(service.database, [record], service.folder.digest).get(record.id)
    return _schema(request, get_submission(service, submission_id), shown)


@router.delete("/{submission_id}", status_code=204, responses=errors(401, 403, 404, 422))
def delete(submission_id: SubmissionId, service: ServiceDep, token: RequiredToken) -> None:
    """Delete a submission with its archive and results; only the owner may do this. The quota is not restored."""
    delete_submission(service, get_own_submission(service, submission_id, token))


def _accepted(request: Request, response: Response, accepted: tuple[SubmissionModel, bool]) -> Submission:
    record, is_new = accepted
    response.status_code = 202 if is_new else 200
    response.headers["Location"] = request.url_for("look_up", submission_id=record.id).path
    service = service_of(request)
    return _schema(
        request, record, shown_results(service.database, [record], service.folder.digest).get(record.id)
    )


def _schema(
    request: Request, record: SubmissionModel, shown: ShownResult | None, result: dict[str, Any] | None = None
) -> Submission:
    """Return the answer on a submission; ``shown`` is its result, ``result`` the JSON object if included."""
    details = json.loads(record.details)
    return Submission.model_validate(
        {
            **{column.key: getattr(record, column.key) for column in SubmissionModel.__table__.columns},
            **details,
            "url": page_url(request, record),
            "method_url": details.get("url"),
            "archive_kept": record.archive_deleted_at is None,
            "outdated": shown and shown.outdated,
            "result": result,
        }
    )
