"""Database operations on submissions: acceptance within the quota, lookup, publication and deletion."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import ErrorMapModel, LeaderboardRowModel, ResultModel, SubmissionModel, TokenModel
from rebar_depth_bench.scoring.disclosure import disclosed_json
from rebar_depth_bench.submission import SubmissionMeta

QUEUED, SCORING, SCORED, FAILED, DELETED = "queued", "scoring", "scored", "failed", "deleted"
DAY_S = 86400


class QuotaExceededError(Exception):
    """Raised when a token has used its daily quota of submissions."""


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
    database: Database, submission_id: str, token: TokenModel, upload: Upload, quota: int, public: bool
) -> SubmissionModel:
    """Insert a queued submission, whose archive is stored already, and return its row. Durable on return.

    Raises ``QuotaExceededError`` if the token has used its daily quota.
    """
    with database.write() as session:
        # The token's row is locked, so that concurrent uploads cannot exceed the quota.
        session.execute(select(TokenModel).where(TokenModel.id == token.id).with_for_update())
        if count_submissions_today(session, token.id) >= quota:
            raise QuotaExceededError
        record = SubmissionModel(
            id=submission_id,
            token_id=token.id,
            method=upload.meta.method,
            description=upload.meta.description,
            url=upload.meta.url,
            uses_intrinsics=upload.meta.uses_intrinsics,
            inputs=upload.meta.inputs,
            uses_ground_truth=upload.meta.uses_ground_truth,
            archive_sha256=upload.sha256,
            archive_bytes=upload.size,
            status=QUEUED,
            public=public,
            created_at=time.time(),
            attempts=0,
            dataset_digest=upload.dataset_digest,
        )
        session.add(record)
    return record


def count_submissions_today(session: Session, token_id: int) -> int:
    """Return the number of submissions made with a token since midnight UTC, including deleted ones."""
    midnight = time.time() // DAY_S * DAY_S
    own_today = select(func.count()).where(
        SubmissionModel.token_id == token_id, SubmissionModel.created_at >= midnight
    )
    return session.scalar(own_today) or 0


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


def publish(database: Database, submission_id: str, public: bool) -> None:
    """Set whether the rows of a submission are shown on the leaderboard."""
    with database.write() as session:
        session.get_one(SubmissionModel, submission_id).public = public


def remove(database: Database, submission_id: str) -> None:
    """Delete a submission's rows, result and error maps; its cleared own row still counts for the quota."""
    with database.write() as session:
        # The row is locked, so that no worker finishes the submission meanwhile.
        record = session.get_one(SubmissionModel, submission_id, with_for_update=True)
        for table in (ErrorMapModel, LeaderboardRowModel, ResultModel):
            session.execute(delete(table).where(table.submission_id == submission_id))
        record.status, record.public = DELETED, False
        record.method, record.archive_sha256 = "", ""
        record.description = record.url = record.reason = None
