"""Rules for submissions: who finds, changes and deletes one, and when a result is outdated."""

from __future__ import annotations

import json
from typing import Any

from pydantic import ConfigDict

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import SCORED
from leaderboard.refusals import RefusedError
from leaderboard.service import Service
from leaderboard.storage.retention import delete_archives
from rebar_depth_bench.submission.declaration import MethodDetails


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
    record = submissions.find(service.database, submission_id)
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
    """Delete a submission, its archive and its results."""
    submissions.remove(service.database, record.id)
    delete_archives(service.archives, [record.id])


def outdated_note(record: SubmissionModel, dataset_digest: str) -> str | None:
    """Return why a result is not of the dataset with ``dataset_digest``, or None if it is."""
    if record.status != SCORED or record.dataset_digest == dataset_digest:
        return None
    reason = "its archive is not kept, so that it is neither scored against the present dataset nor ranked"
    return f"the result belongs to the dataset {record.dataset_digest}; {reason}"
