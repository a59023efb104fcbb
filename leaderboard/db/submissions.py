"""Database operations on submissions: acceptance within the quota, lookup, publication and deletion."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import (
    LeaderboardRowModel,
    PictureImageModel,
    PictureModel,
    ResultModel,
    SubmissionModel,
    TokenModel,
    increment_content_version,
)
from rebar_depth_bench.scoring.result import disclosed_json
from rebar_depth_bench.submission import SubmissionMeta
from rebar_depth_bench.submission.declaration import MethodDetails

QUEUED, SCORING, SCORED, FAILED, DELETED = "queued", "scoring", "scored", "failed", "deleted"
DAY_S = 86400


class QuotaExceededError(Exception):
    """Raised when a token has used its daily quota; the message names it."""


@dataclass(frozen=True)
class Quota:
    """Number of submissions and bytes of archives that are accepted of a token per day (UTC)."""

    submissions: int
    size: int


@dataclass(frozen=True)
class Upload:
    """A validated archive that is about to be accepted.

    ``meta`` is its ``submission.json``, ``sha256`` its digest in hexadecimal, ``size`` is in bytes, and
    ``dataset_digest`` is the digest of the dataset that it was validated against.
    """

    meta: SubmissionMeta
    sha256: str
    size: int
    dataset_digest: str


def new_id() -> str:
    """Return a random id of 128 bits.

    It must be unguessable, because it gives access to a submission that is not public. It is hexadecimal, so that
    it is valid as an argument of any command.
    """
    return secrets.token_hex(16)


def accept(
    database: Database, submission_id: str, token: TokenModel, upload: Upload, quota: Quota, public: bool
) -> SubmissionModel:
    """Insert a queued submission, whose archive is stored already, and return its row. Durable on return.

    If the token has a submission of the same archive, nothing is inserted, and the row of that one is returned.
    Raises ``QuotaExceededError`` if the token has used its daily quota.
    """
    with database.write() as session:
        # The token's row is locked, so that concurrent uploads are neither duplicates nor exceed the quota.
        session.execute(select(TokenModel).where(TokenModel.id == token.id).with_for_update())
        if duplicate := find_duplicate(session, token, upload.sha256):
            return duplicate
        check_quota(session, token, quota, upload.size)
        record = SubmissionModel(
            id=submission_id,
            token_id=token.id,
            method=upload.meta.method,
            inputs=upload.meta.inputs,
            uses_ground_truth=upload.meta.uses_ground_truth,
            archive_sha256=upload.sha256,
            archive_bytes=upload.size,
            status=QUEUED,
            public=public,
            created_at=time.time(),
            attempts=0,
            dataset_digest=upload.dataset_digest,
            details=_details_json(upload.meta),
        )
        session.add(record)
    return record


def _details_json(meta: SubmissionMeta) -> str:
    """Return what the submitter says about the method."""
    details = meta.model_dump(include=set(MethodDetails.model_fields), exclude_none=True)
    if (seconds := meta.seconds_per_view) is not None:
        details["seconds_per_view"] = seconds
    return json.dumps(details)


def find_duplicate(session: Session, token: TokenModel, sha256: str) -> SubmissionModel | None:
    """Return the submission that a token has made of an archive, or None; failed ones may be sent again."""
    is_own = (SubmissionModel.token_id == token.id, SubmissionModel.archive_sha256 == sha256)
    return session.scalar(
        select(SubmissionModel).where(*is_own, SubmissionModel.status.in_((QUEUED, SCORING, SCORED)))
    )


def quota_used(session: Session, token: TokenModel) -> Quota:
    """Return the submissions made with a token since midnight UTC and their bytes, including deleted ones."""
    midnight = time.time() // DAY_S * DAY_S
    used = select(func.count(), func.coalesce(func.sum(SubmissionModel.archive_bytes), 0)).where(
        SubmissionModel.token_id == token.id, SubmissionModel.created_at >= midnight
    )
    count, size = session.execute(used).one()
    return Quota(count, int(size))


def check_quota(session: Session, token: TokenModel, quota: Quota, size: int) -> None:
    """Raise ``QuotaExceededError`` if an archive of ``size`` bytes is more than remains of today's quota."""
    used = quota_used(session, token)
    if used.submissions >= quota.submissions:
        raise QuotaExceededError(f"{quota.submissions} submissions per day (UTC)")
    if used.size + size > quota.size:
        raise QuotaExceededError(f"{quota.size} bytes of archives per day (UTC)")


def find(database: Database, submission_id: str) -> SubmissionModel | None:
    """Return the row of a submission, or None if it does not exist or is deleted."""
    with database.read() as session:
        record = session.get(SubmissionModel, submission_id)
    return None if record is None or record.status == DELETED else record


def result_json(database: Database, submission_id: str) -> bytes | None:
    """Return the result JSON of a scored submission, byte-identical to the command line's, or None.

    If the ground truth is hidden, it is the disclosed part of the result.
    """
    query = (
        select(ResultModel.json)
        .join(SubmissionModel, SubmissionModel.id == ResultModel.submission_id)
        .where(ResultModel.submission_id == submission_id, SubmissionModel.status == SCORED)
    )
    with database.read() as session:
        result = session.scalar(query)
    return disclosed_json(result) if result is not None and database.hidden_truth else result


def result_notes(database: Database, submission_id: str) -> list[str]:
    """Return the notes on possible mistakes in a scored submission; none if the ground truth is hidden."""
    if database.hidden_truth:
        return []
    with database.read() as session:
        record = session.get(ResultModel, submission_id)
    notes: list[str] = [] if record is None else json.loads(record.notes)
    return notes


def change(database: Database, submission_id: str, values: Mapping[str, Any]) -> None:
    """Set columns of a submission that pages show."""
    with database.write() as session:
        session.execute(update(SubmissionModel).where(SubmissionModel.id == submission_id).values(**values))
        increment_content_version(session)


def of_token(database: Database, token: TokenModel) -> list[SubmissionModel]:
    """Return the submissions of a token, newest first, without deleted ones."""
    own = select(SubmissionModel).where(SubmissionModel.token_id == token.id, SubmissionModel.status != DELETED)
    with database.read() as session:
        return list(session.scalars(own.order_by(SubmissionModel.created_at.desc())))


def archive_rows(database: Database) -> dict[str, tuple[str, int] | None]:
    """Return the archive of every submission by id, also of removed ones: its SHA-256 and its size in bytes.

    None stands for an archive that is not kept: its row says that it was deleted with its submission or pruned.
    """
    of_archive = (SubmissionModel.archive_sha256, SubmissionModel.archive_bytes)
    query = select(SubmissionModel.id, SubmissionModel.status, SubmissionModel.archive_deleted_at, *of_archive)
    with database.read() as session:
        return {
            submission_id: None if status == DELETED or deleted_at is not None else (sha256, size)
            for submission_id, status, deleted_at, sha256, size in session.execute(query)
        }


def delete_results(session: Session, submission_id: str) -> None:
    """Delete what scoring has stored of a submission."""
    for table in (PictureImageModel, PictureModel, LeaderboardRowModel, ResultModel):
        session.execute(delete(table).where(table.submission_id == submission_id))


def remove(database: Database, submission_id: str) -> None:
    """Delete a submission's rows, result and pictures; its cleared own row still counts for the quota."""
    with database.write() as session:
        # The row is locked, so that no worker finishes the submission meanwhile.
        record = session.get_one(SubmissionModel, submission_id, with_for_update=True)
        delete_results(session, submission_id)
        increment_content_version(session)
        record.status, record.public, record.details = DELETED, False, "{}"
        record.method, record.archive_sha256 = "", ""
        record.reason = None
