"""Submissions in the database: accepted within the quota, shown to whom they may be, published, deleted."""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import PictureRecord, ResultRecord, RowRecord, SubmissionRecord, TokenRecord
from rebar_depth_bench.submission import SubmissionMeta

QUEUED, SCORING, SCORED, FAILED, DELETED = "queued", "scoring", "scored", "failed", "deleted"
DAY_S = 86400


class QuotaSpentError(Exception):
    """The token has made its submissions of the day."""


@dataclass(frozen=True)
class Upload:
    """A checked archive that is about to be accepted.

    What it says of itself, its SHA-256, its size in bytes, and the digest of the dataset that it fits.
    """

    meta: SubmissionMeta
    sha256: str
    size: int
    dataset_digest: str


def new_id() -> str:
    """Return an id that nobody can guess, for it opens a submission that is not public, and any command takes."""
    return secrets.token_hex(16)


def accept(
    database: Database, submission_id: str, token: TokenRecord, upload: Upload, quota: int, public: bool
) -> SubmissionRecord:
    """Queue a submission whose archive is kept already; durable on return. Raises ``QuotaSpentError``."""
    with database.write() as session:
        # The token's row is locked, so that two uploads at once do not both take the last place.
        session.execute(select(TokenRecord).where(TokenRecord.id == token.id).with_for_update())
        if spent_today(session, token.id) >= quota:
            raise QuotaSpentError
        record = SubmissionRecord(
            id=submission_id,
            token_id=token.id,
            method=upload.meta.method,
            description=upload.meta.description,
            url=upload.meta.url,
            uses_intrinsics=upload.meta.uses_intrinsics,
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


def spent_today(session: Session, token_id: int) -> int:
    """Return how many submissions a token made since midnight UTC, deleted ones too."""
    midnight = time.time() // DAY_S * DAY_S
    mine = select(func.count()).where(
        SubmissionRecord.token_id == token_id, SubmissionRecord.created_at >= midnight
    )
    return session.scalar(mine) or 0


def find(database: Database, submission_id: str) -> SubmissionRecord | None:
    """Return a submission that is there and not deleted."""
    with database.read() as session:
        record = session.get(SubmissionRecord, submission_id)
    return None if record is None or record.status == DELETED else record


def result_json(database: Database, submission_id: str) -> bytes | None:
    """Return a scored submission's result, byte for byte as the command line writes it."""
    query = (
        select(ResultRecord.json)
        .join(SubmissionRecord, SubmissionRecord.id == ResultRecord.submission_id)
        .where(ResultRecord.submission_id == submission_id, SubmissionRecord.status == SCORED)
    )
    with database.read() as session:
        return session.scalar(query)


def publish(database: Database, submission_id: str, public: bool) -> None:
    """Put a submission's rows on the board, or take them off."""
    with database.write() as session:
        session.get_one(SubmissionRecord, submission_id).public = public


def remove(database: Database, submission_id: str) -> None:
    """Delete a submission, its rows, result and pictures; what is left counts for the quota and says nothing."""
    with database.write() as session:
        record = session.get_one(
            SubmissionRecord, submission_id, with_for_update=True
        )  # no scorer ends it meanwhile
        for table in (PictureRecord, RowRecord, ResultRecord):
            session.execute(delete(table).where(table.submission_id == submission_id))
        record.status, record.public = DELETED, False
        record.method, record.archive_sha256 = "", ""
        record.description = record.url = record.reason = None
