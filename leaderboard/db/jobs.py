"""The queue: a scorer leases a submission, renews the lease while it works, and ends it once.

Of two scorers that want the same job one gets it. Renewing and ending are one conditional update each, so that a
scorer that was taken for dead cannot end what another has taken over.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import ColumnElement, and_, delete, func, or_, select, update
from sqlalchemy.engine import CursorResult
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import PictureRecord, ResultRecord, RowRecord, SubmissionRecord
from leaderboard.db.submissions import FAILED, QUEUED, SCORED, SCORING

MOST_ATTEMPTS = 5
"""A submission whose scorer died so often fails; a service that is killed now and then stays below it."""


@dataclass(frozen=True)
class Job:
    """A submission to score, and the dataset that its archive was checked against."""

    submission_id: str
    dataset_digest: str


@dataclass(frozen=True)
class Outcome:
    """What scoring came to: the result's JSON and error maps by view, or the reason why there is none."""

    result: bytes | None = None
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    reason: str | None = None


def claim(database: Database, scorer: str, lease_s: float) -> str | None:
    """Lease the oldest of those tried least to ``scorer``; return its id, None where nothing waits.

    So what scorers died of holds nobody up.
    """
    while True:
        with database.write() as session:
            now = time.time()
            is_free = or_(SubmissionRecord.lease_until.is_(None), SubmissionRecord.lease_until < now)
            waiting = and_(SubmissionRecord.status.in_((QUEUED, SCORING)), is_free)
            order = (SubmissionRecord.attempts, SubmissionRecord.created_at)
            oldest = select(SubmissionRecord).where(waiting).order_by(*order).limit(1)
            if database.waits_for_rows:
                oldest = oldest.with_for_update(skip_locked=True)
            record = session.scalar(oldest)
            if record is None:
                return None
            if record.attempts < MOST_ATTEMPTS:
                record.status, record.scorer = SCORING, scorer
                record.lease_until, record.attempts = now + lease_s, record.attempts + 1
                return record.id
            record.status, record.finished_at = FAILED, now
            record.reason = f"scoring was begun {record.attempts} times and never came to an end"


def renew(database: Database, submission_id: str, scorer: str, lease_s: float) -> bool:
    """Prolong a lease; return whether it is still the scorer's."""
    with database.write() as session:
        return _update(session, _leased(submission_id, scorer), {"lease_until": time.time() + lease_s})


def give_back(database: Database, submission_id: str, scorer: str, wait_s: float = 0.0) -> None:
    """Queue a leased submission again, as if it had not been tried; nobody has it for ``wait_s`` seconds."""
    with database.write() as session:
        values = {
            "status": QUEUED,
            "scorer": None,
            "lease_until": time.time() + wait_s if wait_s else None,
            "attempts": SubmissionRecord.attempts - 1,
        }
        _update(session, _leased(submission_id, scorer), values)


def finish(database: Database, submission_id: str, scorer: str, outcome: Outcome) -> bool:
    """End a submission if the lease is still the scorer's; return whether it was. All in one transaction."""
    found = None if outcome.result is None else json.loads(outcome.result)
    values = {
        "status": FAILED if found is None else SCORED,
        "reason": outcome.reason,
        "finished_at": time.time(),
        "lease_until": None,
    }
    with database.write() as session:
        if not _update(session, _leased(submission_id, scorer), values):
            return False
        if found is not None:
            for table in (PictureRecord, RowRecord, ResultRecord):
                session.execute(delete(table).where(table.submission_id == submission_id))
            session.add(ResultRecord(submission_id=submission_id, json=outcome.result))
            session.add_all(_rows(submission_id, found["tables"]))
        for view_id, webp in outcome.pictures.items():
            session.add(PictureRecord(submission_id=submission_id, view_id=view_id, webp=webp))
    return True


def count_of_another(database: Database, dataset_digest: str) -> int:
    """Return how many submissions are of another dataset than this one."""
    with database.read() as session:
        return session.scalar(select(func.count()).where(_is_of_another(dataset_digest))) or 0


def queue_again(database: Database, dataset_digest: str) -> None:
    """Queue the submissions of another dataset to be scored against this one; old results stay until then."""
    with database.write() as session:
        values = {"status": QUEUED, "attempts": 0, "finished_at": None, "dataset_digest": dataset_digest}
        session.execute(update(SubmissionRecord).where(_is_of_another(dataset_digest)).values(**values))


def _is_of_another(dataset_digest: str) -> ColumnElement[bool]:
    is_kept = SubmissionRecord.status.in_((QUEUED, SCORING, SCORED))
    return and_(is_kept, SubmissionRecord.dataset_digest != dataset_digest)


def _rows(submission_id: str, tables: Mapping[str, Any]) -> list[RowRecord]:
    return [
        RowRecord(
            submission_id=submission_id,
            config=config,
            ranked=table["ranked"],
            abs_rel=(table["native"] or {}).get("abs_rel"),
            json=json.dumps(table),
        )
        for config, table in tables.items()
    ]


def _leased(submission_id: str, scorer: str) -> ColumnElement[bool]:
    return and_(
        SubmissionRecord.id == submission_id,
        SubmissionRecord.status == SCORING,
        SubmissionRecord.scorer == scorer,
    )


def _update(session: Session, where: ColumnElement[bool], values: Mapping[str, Any]) -> bool:
    changed = session.execute(update(SubmissionRecord).where(where).values(**values))
    assert isinstance(changed, CursorResult)
    return changed.rowcount == 1
