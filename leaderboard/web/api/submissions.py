"""Endpoints of ``/api/v1/submissions``: upload, look up, publish, delete.

The docstrings of the endpoints are part of the OpenAPI document.
"""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Path, Request, Response

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.service import Service
from leaderboard.storage.retention import delete_archives
from leaderboard.uploads.accept import accept_upload
from leaderboard.uploads.multipart import MAX_OVERHEAD_BYTES, UploadForm, too_large
from leaderboard.web.api.auth import WITHOUT_TOKEN, OptionalToken, RequiredToken, ServiceDep, service_of
from leaderboard.web.api.schemas import (
    Responses,
    Submission,
    SubmissionChange,
    SubmissionList,
    errors,
    outdated_note,
)

MAX_PATCH_BYTES = 32 << 10
router = APIRouter(prefix="/api/v1/submissions", tags=["submissions"], responses=errors(429, 503))

SubmissionId = Annotated[str, Path(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_-]+$")]
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
    200: {"description": "the token has sent this archive before; its submission is returned"},
    202: {
        "description": "accepted; the archive and its database row are stored on disk",
        "headers": {"Location": {"description": "URL path of the submission", "schema": {"type": "string"}}},
    },
}


@router.put(
    "",
    status_code=202,
    responses={**_ACCEPTED_RESPONSE, **errors(401, 408, 413, 422)},
    openapi_extra={
        "requestBody": {"required": True, "content": {"application/zip": {"schema": _BINARY}}},
    },
)
async def upload(request: Request, response: Response, service: ServiceDep, token: RequiredToken) -> Submission:
    """Upload an archive as the body. It is checked before it is accepted, and stored durably before 202 is sent.

    If the token has sent the same archive before, status 200 and that submission are returned.
    """
    check_length(request)
    return _accepted(request, response, await accept_upload(service, token, request.stream()))


@router.post(
    "",
    status_code=202,
    responses={**_ACCEPTED_RESPONSE, **errors(401, 408, 413, 422)},
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
    return SubmissionList(submissions=[_schema(request, record) for record in records])


@router.get("/{submission_id}", responses=errors(401, 404, 422), openapi_extra=WITHOUT_TOKEN)
def look_up(submission_id: SubmissionId, request: Request, service: ServiceDep, _: OptionalToken) -> Submission:
    """Return a submission. Its id cannot be guessed and gives read access without a token."""
    record = get_submission(service, submission_id)
    result = submissions.result_json(service.database, submission_id)
    return _schema(request, record, None if result is None else json.loads(result))


@router.get(
    "/{submission_id}/result.json",
    responses={**errors(404, 422), 200: {"content": {"application/json": {"schema": {"type": "object"}}}}},
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
    return _schema(request, get_submission(service, submission_id))


@router.delete("/{submission_id}", status_code=204, responses=errors(401, 403, 404, 422))
def delete(submission_id: SubmissionId, service: ServiceDep, token: RequiredToken) -> None:
    """Delete a submission with its archive and results; only the owner may do this. The quota is not restored."""
    delete_submission(service, get_own_submission(service, submission_id, token))


def edit_submission(service: Service, record: SubmissionModel, change: SubmissionChange) -> None:
    """Make the owner's change of a submission. Raises status 403 if the visibility cannot be changed."""
    values = change.model_dump(include=change.model_fields_set)
    if values.get("public") is False and service.settings.default_visibility == "always":
        raise HTTPException(403, "every submission of this leaderboard is public")
    columns: dict[str, Any] = {"public": values.pop("public")} if "public" in values else {}
    details = {**json.loads(record.details), **values}
    columns["details"] = json.dumps({name: value for name, value in details.items() if value is not None})
    submissions.change(service.database, record.id, columns)


def delete_submission(service: Service, record: SubmissionModel) -> None:
    """Delete a submission, its archive and its results."""
    submissions.remove(service.database, record.id)
    delete_archives(service.archives, [record.id])


def check_length(request: Request) -> None:
    """Raise ``UploadRejectedError`` (413) if the body is declared to be larger than that of any upload.

    A client that waits for 100 Continue then sends nothing of it.
    """
    length, max_upload = request.headers.get("content-length", ""), service_of(request).settings.max_upload
    if length.isdecimal() and int(length) > max_upload + MAX_OVERHEAD_BYTES:
        raise too_large(max_upload)


def _accepted(request: Request, response: Response, accepted: tuple[SubmissionModel, bool]) -> Submission:
    record, is_new = accepted
    response.status_code = 202 if is_new else 200
    response.headers["Location"] = request.url_for("look_up", submission_id=record.id).path
    return _schema(request, record)


def _schema(request: Request, record: SubmissionModel, result: dict[str, Any] | None = None) -> Submission:
    details = json.loads(record.details)
    return Submission.model_validate(
        {
            **{column.key: getattr(record, column.key) for column in SubmissionModel.__table__.columns},
            **details,
            "url": page_url(request, record),
            "method_url": details.get("url"),
            "archive_kept": record.archive_deleted_at is None,
            "outdated": outdated_note(record, service_of(request).folder.digest),
            "result": result,
        }
    )


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
    """Return the URL of a submission's page, below the public URL if the settings have one."""
    url = service_of(request).settings.public_url
    if url:
        return f"{url}/submissions/{record.id}"
    return str(request.url_for("submission_page", submission_id=record.id))
