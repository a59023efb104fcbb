"""The board: public rows of a config, ranked as the protocol says, and those of a submission.

What the pages ask the database: public rows in their order, a submission's ranks, its place in the queue.

Columns are read, not records: a page of hundreds of rows takes milliseconds.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sqlalchemy import and_, false, func, or_, select
from sqlalchemy.orm import aliased

from leaderboard.db.engine import Database
from leaderboard.db.models import PictureRecord, RowRecord, SubmissionRecord, TokenRecord
from leaderboard.db.submissions import QUEUED, SCORED


class StampedRow(Protocol):
    """A row as its stamp sees it."""

    @property
    def submission_id(self) -> str:
        """Whose it is."""

    @property
    def finished_at(self) -> float | None:
        """When it was scored."""


@dataclass(frozen=True)
class BoardRow:
    """A submission's row in a config; ``rank`` is None where the protocol does not rank it.

    ``table`` is the row as the result's JSON has it.
    """

    rank: int | None
    submission_id: str
    config: str
    method: str
    submitter: str
    url: str | None
    uses_intrinsics: bool | None
    created_at: float
    finished_at: float | None
    public: bool
    table: Mapping[str, Any]


_COLUMNS = (
    RowRecord.ranked,
    RowRecord.json,
    SubmissionRecord.id,
    RowRecord.config,
    SubmissionRecord.method,
    TokenRecord.name,
    SubmissionRecord.url,
    SubmissionRecord.uses_intrinsics,
    SubmissionRecord.created_at,
    SubmissionRecord.finished_at,
    SubmissionRecord.public,
)
"""What is read for a row: records would take longer."""


_IDS = func.aggregate_strings(RowRecord.submission_id, " ")


@dataclass(frozen=True)
class Stamp:
    """What a config's public rows are, in small: whose they are, and when the last of them was scored.

    A row does not change unless it is scored anew, so that the same stamp means the same rows.
    """

    ids: frozenset[str] = frozenset()
    newest: float = 0.0


def stamps(database: Database) -> dict[str, Stamp]:
    """Return the stamp of each config that has a public row, in one query that reads no tables."""
    query = (
        select(RowRecord.config, _IDS, func.max(SubmissionRecord.finished_at))
        .join(SubmissionRecord, SubmissionRecord.id == RowRecord.submission_id)
        .where(SubmissionRecord.status == SCORED, SubmissionRecord.public)
        .group_by(RowRecord.config)
    )
    with database.read() as session:
        found = session.execute(query).all()
    return {config: Stamp(frozenset(ids.split(" ")), newest or 0.0) for config, ids, newest in found}


def stamp_of(rows: Sequence[StampedRow]) -> Stamp:
    """Return the stamp of a config's public rows."""
    newest = max((row.finished_at or 0.0 for row in rows), default=0.0)
    return Stamp(frozenset(row.submission_id for row in rows), newest)


def board(database: Database, config: str, viewer: TokenRecord | None = None) -> list[BoardRow]:
    """Return a config's rows: ranked ones by native AbsRel, then the unranked, older before newer among equals.

    Public rows, and those of the token that asks; a row that is not public takes no rank from others.
    """
    own = false() if viewer is None else SubmissionRecord.token_id == viewer.id
    query = (
        select(*_COLUMNS)
        .join(SubmissionRecord, SubmissionRecord.id == RowRecord.submission_id)
        .join(TokenRecord, TokenRecord.id == SubmissionRecord.token_id)
        .where(RowRecord.config == config, SubmissionRecord.status == SCORED, SubmissionRecord.public | own)
        .order_by(RowRecord.ranked.desc(), RowRecord.abs_rel.nulls_last(), SubmissionRecord.created_at)
    )
    with database.read() as session:
        found = session.execute(query).all()
    rows, rank = [], 0
    for row in found:
        counts = row.ranked and row.public
        rank += counts
        rows.append(_row(row, rank if counts else None))
    return rows


def picture_views(database: Database, submission_id: str) -> list[str]:
    """Return the views whose error maps are kept."""
    query = select(PictureRecord.view_id).where(PictureRecord.submission_id == submission_id)
    with database.read() as session:
        return list(session.scalars(query.order_by(PictureRecord.view_id)))


def picture(database: Database, submission_id: str, view_id: str) -> bytes | None:
    """Return a view's error map, WebP."""
    with database.read() as session:
        record = session.get(PictureRecord, (submission_id, view_id))
        return None if record is None else record.webp


def _row(found: Any, rank: int | None) -> BoardRow:
    return BoardRow(
        rank=rank,
        submission_id=found.id,
        config=found.config,
        method=found.method,
        submitter=found.name,
        url=found.url,
        uses_intrinsics=found.uses_intrinsics,
        created_at=found.created_at,
        finished_at=found.finished_at,
        public=found.public,
        table=json.loads(found.json),
    )


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
