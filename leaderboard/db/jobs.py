"""Job queue in the database: workers lease submissions, renew the lease while scoring, and store the outcome once.

Each submission is leased by at most one worker. Renewal and completion are single conditional updates, so that a
worker whose lease has expired cannot finish a job that another worker has taken over. The column ``scorer`` holds
the name of the worker. A job is scored against the dataset that is served (``BoardModel.dataset_digest``).
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence

from sqlalchemy import ColumnElement, and_, delete, exists, or_, select, update
from sqlalchemy.orm import Session

from leaderboard.db.engine import Database
from leaderboard.db.models import (
    BoardModel,
    LeaderboardRowModel,
    ResultModel,
    SubmissionModel,
    increment_content_version,
)
from leaderboard.db.submissions import DELETED, FAILED, QUEUED, SCORED, SCORING
from leaderboard.scoring.sandbox import Outcome
from leaderboard.settings import MAX_LEASE_S
from rebar_depth_bench.base.errors import InputError, escape_text, problem_summary
from rebar_depth_bench.scoring.bootstrap import INTERVALS
from rebar_depth_bench.scoring.protocol import PROTOCOL

MAX_ATTEMPTS = 5
"""Number of leases after which a submission fails if no worker finished it.

The limit is high enough for a service that is killed occasionally."""
_INTERVALS_JSON = json.dumps(INTERVALS, sort_keys=True)


def serve_dataset(database: Database, dataset_digest: str, rescore: bool) -> int:
    """Record the dataset that is served; queue what has to be scored against it, and return the number of these.

    A submission that has a result of this dataset and protocol is scored, whatever was to be done before. One
    whose scoring against this dataset has failed is not tried again, and one without archive cannot be. Results of
    other datasets stay. Raises ``InputError`` if submissions would have to be scored for another dataset than
    theirs, unless ``rescore`` is True.
    """
    current = exists().where(
        ResultModel.submission_id == SubmissionModel.id,
        ResultModel.dataset_digest == dataset_digest,
        ResultModel.protocol == PROTOCOL,
        ResultModel.intervals == _INTERVALS_JSON,
    )
    is_waiting = SubmissionModel.status.in_((QUEUED, SCORING))
    is_stale = and_(SubmissionModel.status == SCORED, SubmissionModel.archive_deleted_at.is_(None), ~current)
    with database.write() as session:
        board = session.scalars(select(BoardModel)).one()
        is_other = board.dataset_digest not in (None, dataset_digest)
        if is_other:
            has_result = current.where(ResultModel.json.is_not(None))
            session.execute(
                update(SubmissionModel)
                .where(is_waiting, has_result)
                .values(status=SCORED, lease_until=None, finished_at=time.time())
            )
            to_score = and_(or_(is_waiting, is_stale), ~current)
        else:
            to_score = is_stale
        records = session.scalars(select(SubmissionModel).where(to_score).with_for_update()).all()
        if records and is_other and not rescore:
            raise InputError(
                f"the dataset digest is {dataset_digest}, but {len(records)} submissions are of the dataset "
                f"{board.dataset_digest}; use --rescore true to score them against this one"
            )
        for record in records:
            record.status, record.attempts, record.queued_at, record.finished_at = QUEUED, 0, time.time(), None
            record.scorer = record.lease_until = None  # A worker that scores it for another dataset ends.
        if records or is_other:
            increment_content_version(session)
        board.dataset_digest = dataset_digest
        return len(records)


def requeue(database: Database, submission_ids: Sequence[str]) -> None:
    """Queue submissions again, without quota; earlier results stay until they are replaced.

    Raises ``InputError``, before any is queued, if an id is unknown, waits already, has no archive, or if its
    archive was sent again since.
    """
    problems: list[str] = []
    with database.write() as session:
        for submission_id in dict.fromkeys(submission_ids):
            is_id = submission_id.isascii()  # A database refuses bytes that are no text.
            record = session.get(SubmissionModel, submission_id, with_for_update=True) if is_id else None
            if record is None or record.status == DELETED:
                problems.append(f"{escape_text(submission_id)}: there is no such submission")
            elif record.status in (QUEUED, SCORING):
                problems.append(f"{submission_id}: is {record.status} already")
            elif record.archive_deleted_at is not None:
                problems.append(f"{submission_id}: its archive was deleted, so that it cannot be scored")
            elif again := session.scalar(
                select(SubmissionModel.id).where(
                    SubmissionModel.token_id == record.token_id,
                    SubmissionModel.archive_sha256 == record.archive_sha256,
                    SubmissionModel.status.in_((QUEUED, SCORING, SCORED)),
                    SubmissionModel.id != record.id,
                )
            ):
                problems.append(f"{submission_id}: the same archive was sent again as {again}")
            else:
                record.status, record.attempts, record.queued_at = QUEUED, 0, time.time()
                record.finished_at = record.reason = None
        if problems:
            raise InputError(f"nothing was queued: {problem_summary(problems)}")
        increment_content_version(session)


def claim(database: Database, scorer: str, lease_s: float) -> SubmissionModel | None:
    """Lease a waiting submission to ``scorer`` for ``lease_s`` seconds; return it, or None if none is waiting.

    Submissions with the fewest attempts come first, then the oldest, so that an archive that crashes workers does
    not delay the others. Jobs that have reached ``MAX_ATTEMPTS`` are ended.
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
                return record
            digest = session.scalars(select(BoardModel)).one().dataset_digest or ""
            reason = f"scoring was started {record.attempts} times but never finished; the operator can requeue it"
            _store(session, record, Outcome(digest, reason=reason))


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
        lease = update(SubmissionModel).where(_has_lease(submission_id, scorer))
        renewed = lease.values(lease_until=time.time() + lease_s).returning(SubmissionModel.id)
        return session.scalar(renewed) is not None


def release(database: Database, submission_id: str, scorer: str, wait_s: float = 0.0) -> None:
    """Requeue a leased submission without counting the attempt; it cannot be leased for ``wait_s`` seconds."""
    with database.write() as session:
        session.execute(
            update(SubmissionModel)
            .where(_has_lease(submission_id, scorer))
            .values(
                status=QUEUED,
                scorer=None,
                lease_until=time.time() + wait_s if wait_s else None,
                attempts=SubmissionModel.attempts - 1,
            )
        )


def finish(database: Database, submission_id: str, scorer: str, outcome: Outcome) -> bool:
    """Store the outcome in one transaction if ``scorer`` still holds the lease; return whether it did."""
    with database.write() as session:
        leased = select(SubmissionModel).where(_has_lease(submission_id, scorer)).with_for_update()
        record = session.scalar(leased)
        if record is None:
            return False
        _store(session, record, outcome)
    return True


def _store(session: Session, record: SubmissionModel, outcome: Outcome) -> None:
    """Store the outcome of a job and end the job; what has a result stays scored if scoring it again fails."""
    record.lease_until, record.finished_at, record.reason = None, time.time(), None
    present = select(ResultModel.dataset_digest, ResultModel.protocol, ResultModel.json.is_not(None))
    with_json = {
        (digest, protocol)
        for digest, protocol, has_json in session.execute(present.where(ResultModel.submission_id == record.id))
        if has_json
    }
    if outcome.result is None and not with_json:
        record.status, record.reason = FAILED, outcome.reason
    elif outcome.result is None and (outcome.dataset_digest, PROTOCOL) in with_json:
        record.status = SCORED  # The earlier result of the same dataset stays.
        earlier = session.get_one(ResultModel, (record.id, outcome.dataset_digest, PROTOCOL))
        earlier.intervals, earlier.reason = _INTERVALS_JSON, outcome.reason
    else:
        record.status = SCORED
        key = {"submission_id": record.id, "dataset_digest": outcome.dataset_digest, "protocol": PROTOCOL}
        for table in (LeaderboardRowModel, ResultModel):
            session.execute(delete(table).filter_by(**key))
        session.add(
            ResultModel(
                **key,
                intervals=_INTERVALS_JSON,
                json=outcome.result,
                notes=json.dumps(list(outcome.notes)),
                reason=outcome.reason,
                finished_at=record.finished_at,
            )
        )
        tables = {} if outcome.result is None else json.loads(outcome.result)["tables"]
        for config, table in tables.items():
            session.add(
                LeaderboardRowModel(
                    **key,
                    config=config,
                    ranked=table["ranked"],
                    rank_error=table["rank_error"],
                    json=json.dumps({name: value for name, value in table.items() if name != "groups"}),
                )
            )
    if session.scalar(select(BoardModel.dataset_digest)) not in (None, outcome.dataset_digest):
        record.status, record.attempts, record.queued_at = QUEUED, 0, time.time()  # Another one is served by now.
    increment_content_version(session)


def _has_lease(submission_id: str, scorer: str) -> ColumnElement[bool]:
    return and_(
        SubmissionModel.id == submission_id,
        SubmissionModel.status == SCORING,
        SubmissionModel.scorer == scorer,
    )
