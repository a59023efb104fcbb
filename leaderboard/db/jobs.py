"""Job queue in the database: workers lease submissions, renew the lease while scoring, and store the outcome once.

Each submission is leased by at most one worker. Renewal and completion are single conditional updates, so that a
worker whose lease has expired cannot finish a job that another worker has taken over. The column ``scorer`` holds
the name of the worker.
"""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from sqlalchemy import ColumnElement, and_, func, or_, select, update
from sqlalchemy.engine import CursorResult
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import (
    Base,
    LeaderboardRowModel,
    PictureImageModel,
    PictureModel,
    ResultModel,
    SubmissionModel,
    increment_content_version,
)
from leaderboard.db.submissions import FAILED, QUEUED, SCORED, SCORING, delete_results
from leaderboard.db.view_errors import view_errors
from leaderboard.scoring.sandbox import Outcome
from rebar_depth_bench.scoring.protocol import PROTOCOL

MAX_ATTEMPTS = 5
"""Number of leases after which a submission fails if no worker finished it.

The limit is high enough for a service that is killed occasionally."""


def claim(database: Database, scorer: str, lease_s: float) -> str | None:
    """Lease a waiting submission to ``scorer`` for ``lease_s`` seconds; return its id, or None if none is waiting.

    Submissions with the fewest attempts come first, then the oldest, so that an archive that crashes workers does
    not delay the others. Submissions that have reached ``MAX_ATTEMPTS`` are marked as failed.
    """
    while True:
        with database.write() as session:
            now = time.time()
            is_free = or_(SubmissionModel.lease_until.is_(None), SubmissionModel.lease_until < now)
            waiting = and_(SubmissionModel.status.in_((QUEUED, SCORING)), is_free)
            order = (SubmissionModel.attempts, SubmissionModel.created_at)
            oldest = select(SubmissionModel).where(waiting).order_by(*order).limit(1)
            if database.has_row_locks:
                oldest = oldest.with_for_update(skip_locked=True)
            record = session.scalar(oldest)
            if record is None:
                return None
            if record.attempts < MAX_ATTEMPTS:
                record.status, record.scorer = SCORING, scorer
                record.lease_until, record.attempts = now + lease_s, record.attempts + 1
                return record.id
            record.status, record.finished_at = FAILED, now
            record.reason = f"scoring was started {record.attempts} times but never finished"


def renew(database: Database, submission_id: str, scorer: str, lease_s: float) -> bool:
    """Extend a lease to ``lease_s`` seconds from now; return whether ``scorer`` still holds it."""
    with database.write() as session:
        return _update_one(session, _has_lease(submission_id, scorer), {"lease_until": time.time() + lease_s})


def release(database: Database, submission_id: str, scorer: str, wait_s: float = 0.0) -> None:
    """Requeue a leased submission without counting the attempt; it cannot be leased for ``wait_s`` seconds."""
    with database.write() as session:
        values = {
            "status": QUEUED,
            "scorer": None,
            "lease_until": time.time() + wait_s if wait_s else None,
            "attempts": SubmissionModel.attempts - 1,
        }
        _update_one(session, _has_lease(submission_id, scorer), values)


def finish(database: Database, submission_id: str, scorer: str, outcome: Outcome) -> bool:
    """Store the outcome in one transaction if ``scorer`` still holds the lease; return whether it did."""
    result = None if outcome.result is None else json.loads(outcome.result)
    values = {
        "status": FAILED if result is None else SCORED,
        "reason": outcome.reason,
        "finished_at": time.time(),
        "lease_until": None,
    }
    with database.write() as session:
        if not _update_one(session, _has_lease(submission_id, scorer), values):
            return False
        if result is not None:
            delete_results(session, submission_id)
            session.add_all(_stored(submission_id, outcome, result))
        increment_content_version(session)
    return True


def count_stale_submissions(database: Database, dataset_digest: str) -> int:
    """Return the number of submissions that belong to another dataset than the one with ``dataset_digest``."""
    with database.read() as session:
        return session.scalar(select(func.count()).where(_is_stale(dataset_digest))) or 0


def requeue_stale_submissions(database: Database, dataset_digest: str) -> None:
    """Requeue the submissions of other datasets for scoring against this one; old results stay until replaced."""
    with database.write() as session:
        values = {"status": QUEUED, "attempts": 0, "finished_at": None, "dataset_digest": dataset_digest}
        session.execute(update(SubmissionModel).where(_is_stale(dataset_digest)).values(**values))
        increment_content_version(session)


def requeue_other_protocols(database: Database, archive_ids: Collection[str]) -> int:
    """Requeue the scored submissions whose result is of another protocol; return their number.

    ``archive_ids`` are those of the submissions whose archive is kept; the results of others stay.
    """
    query = (
        select(SubmissionModel)
        .join(ResultModel, ResultModel.submission_id == SubmissionModel.id)
        .where(SubmissionModel.status == SCORED, ResultModel.protocol != PROTOCOL)
    )
    with database.write() as session:
        requeued = [record for record in session.scalars(query) if record.id in archive_ids]
        for record in requeued:
            record.status, record.attempts, record.finished_at = QUEUED, 0, None
        increment_content_version(session)
        return len(requeued)


def _is_stale(dataset_digest: str) -> ColumnElement[bool]:
    is_active = SubmissionModel.status.in_((QUEUED, SCORING, SCORED))
    return and_(is_active, SubmissionModel.dataset_digest != dataset_digest)


def _stored(submission_id: str, outcome: Outcome, result: Mapping[str, Any]) -> Iterator[Base]:
    """Yield the rows of what scoring has found out."""
    notes = json.dumps(list(outcome.notes))
    yield ResultModel(submission_id=submission_id, json=outcome.result, protocol=result["protocol"], notes=notes)
    for config, table in result["tables"].items():
        yield LeaderboardRowModel(
            submission_id=submission_id,
            config=config,
            ranked=table["ranked"],
            rank_error=table["rank_error"],
            json=json.dumps({name: value for name, value in table.items() if name != "groups"}),
            view_errors=view_errors(result, config),
        )
    for picture in outcome.pictures:
        place = {"submission_id": submission_id, "view_id": picture.view_id}
        yield PictureModel(**place, facts=picture.facts_json)
        for kind, webp in picture.images.items():
            yield PictureImageModel(**place, kind=kind, webp=webp)


def _has_lease(submission_id: str, scorer: str) -> ColumnElement[bool]:
    return and_(
        SubmissionModel.id == submission_id,
        SubmissionModel.status == SCORING,
        SubmissionModel.scorer == scorer,
    )


def _update_one(session: Session, where: ColumnElement[bool], values: Mapping[str, Any]) -> bool:
    changed = session.execute(update(SubmissionModel).where(where).values(**values))
    assert isinstance(changed, CursorResult)
    return changed.rowcount == 1
