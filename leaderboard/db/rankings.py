"""Leaderboard queries: ranked rows of a config, ranks and queue position of a submission, error maps.

The queries select columns instead of ORM objects, so that a page with hundreds of rows takes milliseconds.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sqlalchemy import and_, false, func, or_, select
from sqlalchemy.orm import aliased

from leaderboard.db.engine import Database
from leaderboard.db.models import ErrorMapModel, LeaderboardRowModel, SubmissionModel, TokenModel
from leaderboard.db.submissions import QUEUED, SCORED


class VersionedRow(Protocol):
    """The fields of a row that determine the ranking version."""

    @property
    def submission_id(self) -> str:
        """Id of the submission."""

    @property
    def finished_at(self) -> float | None:
        """Unix timestamp of the end of scoring."""


@dataclass(frozen=True)
class LeaderboardEntry:
    """A submission's row of one config; ``rank`` is None if the row is not ranked.

    ``table`` is the config's table from the result JSON.
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
    LeaderboardRowModel.ranked,
    LeaderboardRowModel.json,
    SubmissionModel.id,
    LeaderboardRowModel.config,
    SubmissionModel.method,
    TokenModel.name,
    SubmissionModel.url,
    SubmissionModel.uses_intrinsics,
    SubmissionModel.created_at,
    SubmissionModel.finished_at,
    SubmissionModel.public,
)
"""Columns selected for a ``LeaderboardEntry``; loading ORM objects would take longer."""


_IDS = func.aggregate_strings(LeaderboardRowModel.submission_id, " ")


@dataclass(frozen=True)
class RankingVersion:
    """Version of a config's public rows: their submission ids, and the time of the latest scoring.

    A row changes only when it is scored again, so that equal versions imply equal rows.
    """

    ids: frozenset[str] = frozenset()
    newest: float = 0.0


def ranking_versions(database: Database) -> dict[str, RankingVersion]:
    """Return the version of each config that has a public row, in one query that does not read the tables."""
    query = (
        select(LeaderboardRowModel.config, _IDS, func.max(SubmissionModel.finished_at))
        .join(SubmissionModel, SubmissionModel.id == LeaderboardRowModel.submission_id)
        .where(SubmissionModel.status == SCORED, SubmissionModel.public)
        .group_by(LeaderboardRowModel.config)
    )
    with database.read() as session:
        rows = session.execute(query).all()
    return {config: RankingVersion(frozenset(ids.split(" ")), newest or 0.0) for config, ids, newest in rows}


def ranking_version(rows: Sequence[VersionedRow]) -> RankingVersion:
    """Return the version of the given public rows of a config."""
    newest = max((row.finished_at or 0.0 for row in rows), default=0.0)
    return RankingVersion(frozenset(row.submission_id for row in rows), newest)


def leaderboard_entries(
    database: Database, config: str, viewer: TokenModel | None = None
) -> list[LeaderboardEntry]:
    """Return the public rows of a config and those of ``viewer``.

    Ranked rows come first, by native AbsRel, then unranked ones; ties are ordered by age, oldest first. A row that
    is not public has no rank and does not affect the ranks of others.
    """
    own = false() if viewer is None else SubmissionModel.token_id == viewer.id
    query = (
        select(*_COLUMNS)
        .join(SubmissionModel, SubmissionModel.id == LeaderboardRowModel.submission_id)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .where(
            LeaderboardRowModel.config == config, SubmissionModel.status == SCORED, SubmissionModel.public | own
        )
        .order_by(
            LeaderboardRowModel.ranked.desc(), LeaderboardRowModel.abs_rel.nulls_last(), SubmissionModel.created_at
        )
    )
    with database.read() as session:
        rows = session.execute(query).all()
    entries, rank = [], 0
    for row in rows:
        has_rank = row.ranked and row.public
        rank += has_rank
        entries.append(_entry(row, rank if has_rank else None))
    return entries


def error_map_views(database: Database, submission_id: str) -> list[str]:
    """Return the ids of the views that have a stored error map, sorted."""
    query = select(ErrorMapModel.view_id).where(ErrorMapModel.submission_id == submission_id)
    with database.read() as session:
        return list(session.scalars(query.order_by(ErrorMapModel.view_id)))


def error_map_webp(database: Database, submission_id: str, view_id: str) -> bytes | None:
    """Return the error map of a view as WebP bytes, or None if none is stored."""
    with database.read() as session:
        record = session.get(ErrorMapModel, (submission_id, view_id))
        return None if record is None else record.webp


def _entry(row: Any, rank: int | None) -> LeaderboardEntry:
    return LeaderboardEntry(
        rank=rank,
        submission_id=row.id,
        config=row.config,
        method=row.method,
        submitter=row.name,
        url=row.url,
        uses_intrinsics=row.uses_intrinsics,
        created_at=row.created_at,
        finished_at=row.finished_at,
        public=row.public,
        table=json.loads(row.json),
    )


@dataclass(frozen=True)
class RankedRow:
    """A public row of a config; ``rank`` is None if the row is not ranked, ``table`` is the table's JSON text."""

    rank: int | None
    submission_id: str
    method: str
    submitter: str
    url: str | None
    created_at: float
    finished_at: float | None
    table: str


@dataclass(frozen=True)
class QueuePosition:
    """Position of a submission in the queue, where 1 is next, and the number of waiting submissions."""

    number: int
    waiting: int


def ranked_rows(database: Database, config: str) -> list[RankedRow]:
    """Return the public rows of a config in leaderboard order: ranked by native AbsRel, then unranked."""
    columns = (
        LeaderboardRowModel.ranked,
        SubmissionModel.id,
        SubmissionModel.method,
        TokenModel.name,
        SubmissionModel.url,
        SubmissionModel.created_at,
        SubmissionModel.finished_at,
        LeaderboardRowModel.json,
    )
    query = (
        select(*columns)
        .join(SubmissionModel, SubmissionModel.id == LeaderboardRowModel.submission_id)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .where(LeaderboardRowModel.config == config, SubmissionModel.status == SCORED, SubmissionModel.public)
        .order_by(
            LeaderboardRowModel.ranked.desc(), LeaderboardRowModel.abs_rel.nulls_last(), SubmissionModel.created_at
        )
    )
    with database.read() as session:
        rows = session.execute(query).all()
    return [RankedRow(rank if row[0] else None, *row[1:]) for rank, row in enumerate(rows, 1)]


def ranks(database: Database, submission: SubmissionModel) -> dict[str, int]:
    """Return the ranks of a submission by config, in one query; configs where it is not ranked are left out."""
    if not submission.public:
        return {}
    own_row, other_row, other_submission = (
        aliased(LeaderboardRowModel),
        aliased(LeaderboardRowModel),
        aliased(SubmissionModel),
    )
    ahead = or_(
        other_row.abs_rel < own_row.abs_rel,
        and_(other_row.abs_rel == own_row.abs_rel, other_submission.created_at < submission.created_at),
    )
    better = (
        select(func.count())
        .select_from(other_row)
        .join(other_submission, other_submission.id == other_row.submission_id)
        .where(
            other_row.config == own_row.config,
            other_row.ranked,
            other_submission.status == SCORED,
            other_submission.public,
            ahead,
        )
        .scalar_subquery()
    )
    query = select(own_row.config, 1 + better).where(own_row.submission_id == submission.id, own_row.ranked)
    with database.read() as session:
        return dict(session.execute(query).all())


def queue_position(database: Database, submission: SubmissionModel) -> QueuePosition | None:
    """Return the queue position of a submission, or None if it is not queued."""
    if submission.status != QUEUED:
        return None
    older = func.count().filter(SubmissionModel.created_at < submission.created_at)
    query = select(older, func.count()).where(SubmissionModel.status == QUEUED)
    with database.read() as session:
        before, waiting = session.execute(query).one()
    return QueuePosition(before + 1, max(waiting, before + 1))


def submitter_name(database: Database, submission: SubmissionModel) -> str:
    """Return the name of the token that made a submission."""
    with database.read() as session:
        return session.get_one(TokenModel, submission.token_id).name
