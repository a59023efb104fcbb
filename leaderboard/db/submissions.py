"""Database operations on submissions: lookup, quota, results, change and deletion."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import (
    LeaderboardRowModel,
    ResultModel,
    SubmissionModel,
    TokenModel,
    increment_content_version,
)
from rebar_depth_bench.scoring.protocol import PROTOCOL

QUEUED, SCORING, SCORED, FAILED, DELETED = "queued", "scoring", "scored", "failed", "deleted"
DAY_S = 86400


class QuotaExceededError(Exception):
    """Raised when a token has used its daily quota; the message names it."""


@dataclass(frozen=True)
class Quota:
    """Number of submissions and bytes of archives that are accepted of a token per day (UTC)."""

    submissions: int
    size: int


def new_id() -> str:
    """Return a random id of 128 bits.

    It must be unguessable, because it gives access to a submission that is not public. It is hexadecimal, so that
    it is valid as an argument of any command.
    """
    return secrets.token_hex(16)


def quota_used(session: Session, token: TokenModel) -> Quota:
    """Return the submissions made with a token today (UTC) and their bytes, including deleted ones.

    Submissions dated in the future, by a clock that was wrong, do not count.
    """
    midnight = time.time() // DAY_S * DAY_S
    used = select(func.count(), func.coalesce(func.sum(SubmissionModel.archive_bytes), 0)).where(
        SubmissionModel.token_id == token.id,
        SubmissionModel.created_at >= midnight,
        SubmissionModel.created_at < midnight + DAY_S,
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


def of_token(database: Database, token: TokenModel) -> list[SubmissionModel]:
    """Return the submissions of a token, newest first, without deleted ones."""
    own = select(SubmissionModel).where(SubmissionModel.token_id == token.id, SubmissionModel.status != DELETED)
    with database.read() as session:
        return list(session.scalars(own.order_by(SubmissionModel.created_at.desc())))


@dataclass(frozen=True)
class ShownResult:
    """Dataset and protocol of the result of a submission that is shown.

    ``outdated`` says why they are not those that are served; it is None if they are.
    """

    dataset_digest: str
    protocol: str
    outdated: str | None


def shown_results(
    database: Database, records: Sequence[SubmissionModel], dataset_digest: str
) -> dict[str, ShownResult]:
    """Return the shown results by submission id, for the submissions that have any.

    The result of the served dataset and protocol is shown if there is one, and else the newest result.
    """
    columns = (
        ResultModel.submission_id,
        ResultModel.dataset_digest,
        ResultModel.protocol,
        ResultModel.json.is_not(None),
        ResultModel.reason,
    )
    query = select(*columns).where(ResultModel.submission_id.in_([record.id for record in records]))
    by_id: dict[str, ShownResult] = {}
    failures: dict[str, str | None] = {}
    with database.read() as session:
        for submission_id, digest, protocol, has_json, reason in session.execute(
            query.order_by(ResultModel.finished_at)
        ):
            is_current = (digest, protocol) == (dataset_digest, PROTOCOL)
            if not has_json:
                failures |= {submission_id: reason} if is_current else {}
            elif is_current:
                by_id[submission_id] = ShownResult(digest, protocol, None)
            elif submission_id not in by_id or by_id[submission_id].outdated is not None:
                where = f"the result belongs to the dataset {digest} and the protocol {protocol}"
                by_id[submission_id] = ShownResult(digest, protocol, where)
    for record in records:
        shown = by_id.get(record.id)
        if shown is None or shown.outdated is None:
            continue
        if record.status in (QUEUED, SCORING):
            why = "the submission is being scored again"
        elif record.id in failures:
            why = f"scoring against the served dataset {dataset_digest} failed: {failures[record.id]}"
        elif record.archive_deleted_at is not None:
            why = "its archive is not kept, so that it is neither scored against the served dataset nor ranked"
        else:
            why = f"it is not scored against the served dataset {dataset_digest}"
        by_id[record.id] = replace(shown, outdated=f"{shown.outdated}; {why}")
    return by_id


def result_content(database: Database, submission_id: str, shown: ShownResult) -> tuple[bytes, list[str]] | None:
    """Return the JSON of a result and the notes on possible mistakes; None if it was deleted meanwhile."""
    with database.read() as session:
        record = session.get(ResultModel, (submission_id, shown.dataset_digest, shown.protocol))
    return None if record is None or record.json is None else (record.json, json.loads(record.notes))


def change(database: Database, submission_id: str, values: Mapping[str, Any]) -> None:
    """Set columns of a submission that pages show."""
    with database.write() as session:
        present = (SubmissionModel.id == submission_id, SubmissionModel.status != DELETED)
        session.execute(update(SubmissionModel).where(*present).values(**values))
        increment_content_version(session)


def archive_rows(database: Database) -> dict[str, tuple[str, int] | None]:
    """Return the archive of every submission by id, also of deleted ones: its SHA-256 and its size in bytes.

    None stands for an archive that is not kept, because the submission or the archive alone was deleted.
    """
    of_archive = (SubmissionModel.archive_sha256, SubmissionModel.archive_bytes)
    query = select(SubmissionModel.id, SubmissionModel.archive_deleted_at, *of_archive)
    with database.read() as session:
        return {
            submission_id: None if deleted_at is not None else (sha256, size)
            for submission_id, deleted_at, sha256, size in session.execute(query)
        }


def remove(database: Database, submission_id: str) -> None:
    """Delete a submission's rows and results; its cleared own row still counts for the quota."""
    with database.write() as session:
        # The row is locked, so that no worker finishes the submission meanwhile.
        record = session.get_one(SubmissionModel, submission_id, with_for_update=True)
        for table in (LeaderboardRowModel, ResultModel):
            session.execute(delete(table).where(table.submission_id == submission_id))
        increment_content_version(session)
        record.status, record.public, record.details = DELETED, False, "{}"
        record.method, record.archive_sha256 = "", ""
        record.archive_deleted_at = time.time()
        record.reason = None
