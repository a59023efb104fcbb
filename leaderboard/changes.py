"""Rules for submissions: who finds, changes and deletes one."""

from __future__ import annotations

import json
from typing import Any

import structlog
from pydantic import ConfigDict

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.refusals import RefusedError
from leaderboard.service import Service
from rebar_depth_bench.base.errors import StorageError
from rebar_depth_bench.submission.declaration import MethodDetails

_LOG = structlog.get_logger("submissions")


class SubmissionChange(MethodDetails):
    """Change of a submission: its visibility on the leaderboard and what is said about the method.

    Values that are absent stay; null removes a value. Declarations and scores cannot be changed.
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, defer_build=False, json_schema_extra={"example": {"public": True}}
    )

    public: bool = False


def get_submission(service: Service, submission_id: str) -> SubmissionModel:
    """Return the row of a submission. Raises status 404 if it does not exist."""
    # PostgreSQL raises an error for an id with NUL.
    record = submissions.find(service.database, submission_id) if submission_id.isprintable() else None
    if record is None:
        raise RefusedError(404, "no such submission")
    return record


def get_own_submission(service: Service, submission_id: str, token: TokenModel) -> SubmissionModel:
    """Return the row of a submission. Raises status 404 if it does not exist, 403 if another token owns it."""
    record = get_submission(service, submission_id)
    if record.token_id != token.id:
        raise RefusedError(403, "you are not the owner of this submission")
    return record


def edit_submission(service: Service, record: SubmissionModel, change: SubmissionChange) -> None:
    """Make the owner's change of a submission. Raises status 403 if the visibility cannot be changed."""
    values = change.model_dump(include=change.model_fields_set)
    if values.get("public") is False and service.settings.default_visibility == "always":
        raise RefusedError(403, "every submission of this leaderboard is public; delete it to remove its rows")
    columns: dict[str, Any] = {"public": values.pop("public")} if "public" in values else {}
    details = {**json.loads(record.details), **values}
    columns["details"] = json.dumps({name: value for name, value in details.items() if value is not None})
    submissions.change(service.database, record.id, columns)


def delete_submission(service: Service, record: SubmissionModel) -> None:
    """Delete a submission, its archive and its results. Raises status 503 if the archive folder is unusable."""
    try:
        service.archives.check()
    except (StorageError, OSError) as error:
        _LOG.error("deletion failed: archive folder unusable", error=str(error))
        raise RefusedError(503, "the service cannot delete archives at the moment; try again later") from None
    submissions.remove(service.database, record.id)
    try:
        service.archives.delete(record.id)
    except (StorageError, OSError) as error:  # The next start deletes it.
        _LOG.error("archive not deleted", submission=record.id[:6], error=str(error))
