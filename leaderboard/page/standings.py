"""What the pages ask the database: public rows in their order, a submission's ranks, its place in the queue.

Columns are read, not records: a page of hundreds of rows takes milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import and_, func, or_, select
from sqlalchemy.orm import aliased

from leaderboard.database import Database
from leaderboard.records import RowRecord, SubmissionRecord, TokenRecord
from leaderboard.submissions import QUEUED, SCORED


@dataclass(frozen=True)
class Standing:
    """A public row of a config: ``rank`` is None where the protocol does not rank it; ``table`` is its JSON."""

    rank: int | None
    submission_id: str
    method: str
    submitter: str
    url: str | None
    created_at: float
    finished_at: float | None
    table: str


@dataclass(frozen=True)
class Place:
    """Where in the queue a submission waits, 1 is next, and how many wait."""

    number: int
    waiting: int


def standings(database: Database, config: str) -> list[Standing]:
    """Return a config's public rows: ranked ones by native AbsRel, then the unranked, as the board has them."""
    columns = (
        RowRecord.ranked,
        SubmissionRecord.id,
        SubmissionRecord.method,
        TokenRecord.name,
        SubmissionRecord.url,
        SubmissionRecord.created_at,
        SubmissionRecord.finished_at,
        RowRecord.json,
    )
    query = (
        select(*columns)
        .join(SubmissionRecord, SubmissionRecord.id == RowRecord.submission_id)
        .join(TokenRecord, TokenRecord.id == SubmissionRecord.token_id)
        .where(RowRecord.config == config, SubmissionRecord.status == SCORED, SubmissionRecord.public)
        .order_by(RowRecord.ranked.desc(), RowRecord.abs_rel.nulls_last(), SubmissionRecord.created_at)
    )
    with database.read() as session:
        found = session.execute(query).all()
    return [Standing(rank if row[0] else None, *row[1:]) for rank, row in enumerate(found, 1)]


def ranks(database: Database, submission: SubmissionRecord) -> dict[str, int]:
    """Return the rank of each of a submission's rows that the board ranks, by config, in one query."""
    if not submission.public:
        return {}
    mine, other, others = aliased(RowRecord), aliased(RowRecord), aliased(SubmissionRecord)
    ahead = or_(
        other.abs_rel < mine.abs_rel,
        and_(other.abs_rel == mine.abs_rel, others.created_at < submission.created_at),
    )
    better = (
        select(func.count())
        .select_from(other)
        .join(others, others.id == other.submission_id)
        .where(other.config == mine.config, other.ranked, others.status == SCORED, others.public, ahead)
        .scalar_subquery()
    )
    query = select(mine.config, 1 + better).where(mine.submission_id == submission.id, mine.ranked)
    with database.read() as session:
        return dict(session.execute(query).all())


def queue_place(database: Database, submission: SubmissionRecord) -> Place | None:
    """Return where a submission waits, None where it does not."""
    if submission.status != QUEUED:
        return None
    older = func.count().filter(SubmissionRecord.created_at < submission.created_at)
    query = select(older, func.count()).where(SubmissionRecord.status == QUEUED)
    with database.read() as session:
        before, waiting = session.execute(query).one()
    return Place(before + 1, max(waiting, before + 1))


def submitter(database: Database, submission: SubmissionRecord) -> str:
    """Return who made a submission."""
    with database.read() as session:
        return session.get_one(TokenRecord, submission.token_id).name
