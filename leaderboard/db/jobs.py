"""Job queue in the database: workers lease submissions, renew the lease while scoring, and store the outcome once.

Each submission is leased by at most one worker. Renewal and completion are single conditional updates, so that a
worker whose lease has expired cannot finish a job that another worker has taken over. The column ``scorer`` holds
the name of the worker.
"""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from typing import Any

from sqlalchemy import ColumnElement, and_, or_, select, update
from sqlalchemy.engine import CursorResult
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database, parsed_result
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
from leaderboard.settings import MAX_LEASE_S
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.scoring.bootstrap import INTERVALS
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
            waiting = and_(SubmissionModel.status.in_((QUEUED, SCORING)), is_free(now))
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


def is_free(now: float) -> ColumnElement[bool]:
    """Return the condition that no lease holds a submission at Unix time ``now``.

    A lease that ends later than any lease can was made before the clock was set back, and holds nothing. Twice the
    longest one leaves room for the clocks of other machines.
    """
    lease_until = SubmissionModel.lease_until
    return or_(lease_until.is_(None), lease_until < now, lease_until > now + 2 * MAX_LEASE_S)


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
    """Store the outcome in one transaction if ``scorer`` still holds the lease; return whether it did.

    If the archive is missing, a result that was to be computed again stays, with its dataset.
    """
    result = None if outcome.result is None else json.loads(outcome.result)
    values = {
        "status": FAILED if result is None else SCORED,
        "reason": outcome.reason,
        "finished_at": time.time(),
        "lease_until": None,
    }
    with database.write() as session:
        if outcome.archive_missing and (kept := session.get(ResultModel, submission_id)):
            with suppress(ValueError):  # A damaged result is not kept.
                digest = parsed_result(kept.json)["dataset"]["digest"]
                values |= {"status": SCORED, "reason": None, "dataset_digest": digest}
        if not _update_one(session, _has_lease(submission_id, scorer), values):
            return False
        if result is not None:
            delete_results(session, submission_id)
            session.add_all(_stored(submission_id, outcome, result))
        increment_content_version(session)
    return True


def requeue_stale(database: Database, dataset_digest: str, archive_ids: Collection[str], rescore: bool) -> int:
    """Requeue the stale submissions for scoring against a dataset; return their number.

    Old results stay until they are replaced. Raises ``InputError`` if there are submissions of other datasets,
    unless ``rescore`` is True.
    """
    with database.write() as session:
        stale = stale_submissions(session, dataset_digest, archive_ids, lock=True)
        others = sum(record.dataset_digest != dataset_digest for record in stale)
        if others and not rescore:
            raise InputError(
                f"the dataset digest is {dataset_digest}, but {others} submissions of this leaderboard belong to "
                "another dataset; use --rescore true to score them against this one"
            )
        for record in stale:
            record.status, record.attempts, record.finished_at = QUEUED, 0, None
            record.dataset_digest = dataset_digest
        if stale:
            increment_content_version(session)
        return len(stale)


def stale_submissions(
    session: Session, digest: str, archive_ids: Collection[str], *, lock: bool = False
) -> list[SubmissionModel]:
    """Return the submissions of other datasets than the one with ``digest``, and those of other definitions.

    Results stay as they are if their archive is pruned, or not among ``archive_ids``. With ``lock``, the rows are
    locked until the session ends.
    """
    query = (
        select(SubmissionModel, ResultModel.json)
        .outerjoin(ResultModel, ResultModel.submission_id == SubmissionModel.id)
        .where(SubmissionModel.status.in_((QUEUED, SCORING, SCORED)))
    )
    if lock:
        query = query.with_for_update(of=SubmissionModel)
    stale = []
    for record, content in session.execute(query, execution_options={"yield_per": 20}):
        scored, has_archive = record.status == SCORED, record.id in archive_ids and not record.archive_deleted_at
        is_other = record.dataset_digest != digest or (scored and _has_other_definitions(content or b""))
        if is_other and (has_archive or not scored):
            stale.append(record)
    return stale


def _has_other_definitions(content: bytes) -> bool:
    """Return whether a result JSON was computed with other definitions than those of this version."""
    try:
        result = parsed_result(content)
    except ValueError:  # Damaged: it is computed again, too.
        return True
    return bool(result["protocol"] != PROTOCOL or result.get("intervals") != INTERVALS)


def _stored(submission_id: str, outcome: Outcome, result: Mapping[str, Any]) -> Iterator[Base]:
    """Yield the rows of what scoring has found out."""
    notes = json.dumps(list(outcome.notes))
    yield ResultModel(submission_id=submission_id, json=outcome.result, notes=notes)
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
