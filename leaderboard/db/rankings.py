"""Leaderboard queries: ranked rows of a config, ranks and queue position of a submission, error maps.

The queries select columns instead of ORM objects, so that a page with hundreds of rows takes milliseconds.

If the ground truth is hidden, rows, order and ranks depend on the disclosed numbers only, and no error map is
returned.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import and_, false, func, or_, select

from leaderboard.db.engine import Database
from leaderboard.db.models import ErrorMapModel, LeaderboardRowModel, ResultModel, SubmissionModel, TokenModel
from leaderboard.db.submissions import QUEUED, SCORED
from rebar_depth_bench.scoring.disclosure import DisclosedTable, disclosed_number, smallest_disclosed_alike
from rebar_depth_bench.scoring.protocol import OLD_PROTOCOL, PROTOCOL


@dataclass(frozen=True)
class LeaderboardEntry:
    """A submission's row of one config; ``rank`` is None if the row is not ranked.

    ``class_rank`` is the rank among the submissions that declare the same ``inputs``, None without a declaration.
    ``table_json`` is the JSON text of the config's table in the result, or of its disclosed part.
    """

    rank: int | None
    class_rank: int | None
    submission_id: str
    config: str
    method: str
    submitter: str
    url: str | None
    uses_intrinsics: bool | None
    inputs: str | None
    uses_ground_truth: bool | None
    created_at: float
    finished_at: float | None
    public: bool
    table_json: str


_COLUMNS = (
    LeaderboardRowModel.ranked,
    LeaderboardRowModel.rank_error,
    SubmissionModel.id,
    LeaderboardRowModel.config,
    SubmissionModel.method,
    TokenModel.name,
    SubmissionModel.url,
    SubmissionModel.uses_intrinsics,
    SubmissionModel.inputs,
    SubmissionModel.uses_ground_truth,
    SubmissionModel.created_at,
    SubmissionModel.finished_at,
    SubmissionModel.public,
    LeaderboardRowModel.json,
)
"""Columns selected for a ``LeaderboardEntry``: whether it is ranked, its rank error, then its other fields."""

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


def ranking_version(rows: Sequence[LeaderboardEntry]) -> RankingVersion:
    """Return the version of the given public rows of a config."""
    newest = max((row.finished_at or 0.0 for row in rows), default=0.0)
    return RankingVersion(frozenset(row.submission_id for row in rows), newest)


def leaderboard_entries(
    database: Database, config: str, viewer: TokenModel | None = None
) -> list[LeaderboardEntry]:
    """Return the public rows of a config and those of ``viewer``, of results that this version can read.

    Ranked rows come first, by rank error, then unranked ones; ties are ordered by age, oldest first, and share a
    rank. A row that is not public has no rank and does not affect the ranks of others.
    """
    own = false() if viewer is None else SubmissionModel.token_id == viewer.id
    query = (
        select(*_COLUMNS)
        .join(SubmissionModel, SubmissionModel.id == LeaderboardRowModel.submission_id)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .join(ResultModel, ResultModel.submission_id == SubmissionModel.id)
        .where(
            LeaderboardRowModel.config == config,
            SubmissionModel.status == SCORED,
            SubmissionModel.public | own,
            ResultModel.protocol.in_((PROTOCOL, OLD_PROTOCOL)),
        )
        .order_by(SubmissionModel.created_at)
    )
    with database.read() as session:
        rows = [tuple(row) for row in session.execute(query)]
    if database.hidden_truth:
        rows = [_disclosed(row) for row in rows]
    # Sorted here, because databases round differently; the sort is stable.
    rows.sort(key=lambda row: (not row[0], row[1] is None, row[1]))
    overall, by_inputs = _RankCounter(), defaultdict[str, _RankCounter](_RankCounter)
    entries = []
    for ranked, rank_error, *fields in rows:
        entry = LeaderboardEntry(None, None, *fields)
        if ranked and entry.public:
            class_rank = by_inputs[entry.inputs].next(rank_error) if entry.inputs else None
            entry = replace(entry, rank=overall.next(rank_error), class_rank=class_rank)
        entries.append(entry)
    return entries


def _disclosed(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the values of ``_COLUMNS`` with the rank error and the table as they are disclosed."""
    ranked, rank_error, *others, table_json = row
    shown = None if rank_error is None else disclosed_number(rank_error)
    return ranked, shown, *others, DisclosedTable.model_validate_json(table_json).model_dump_json()


def entries_of_class(entries: Sequence[LeaderboardEntry], inputs: str | None) -> list[LeaderboardEntry]:
    """Return the rows that declare ``inputs``, all rows for None; their ranks are kept."""
    return [entry for entry in entries if inputs is None or entry.inputs == inputs]


@dataclass
class _RankCounter:
    """Counter of rows by ascending error, in which equal errors share a rank."""

    rows: int = 0
    rank: int = 0
    error: float | None = None

    def next(self, error: float) -> int:
        """Return the rank of the next row."""
        self.rows += 1
        if error != self.error:
            self.rank, self.error = self.rows, error
        return self.rank


def error_map_views(database: Database, submission_id: str) -> list[str]:
    """Return the ids of the views that have a stored error map, sorted."""
    if database.hidden_truth:
        return []
    query = select(ErrorMapModel.view_id).where(ErrorMapModel.submission_id == submission_id)
    with database.read() as session:
        return list(session.scalars(query.order_by(ErrorMapModel.view_id)))


def error_map_webp(database: Database, submission_id: str, view_id: str) -> bytes | None:
    """Return the error map of a view as WebP bytes, or None if none is stored."""
    if database.hidden_truth:
        return None
    with database.read() as session:
        record = session.get(ErrorMapModel, (submission_id, view_id))
        return None if record is None else record.webp


@dataclass(frozen=True)
class QueuePosition:
    """Position of a submission in the queue, where 1 is next, and the number of waiting submissions."""

    number: int
    waiting: int


def ranks(database: Database, submission: SubmissionModel) -> dict[str, int]:
    """Return the ranks of a submission by config; configs where it is not ranked are left out."""
    if not submission.public:
        return {}
    row = LeaderboardRowModel
    own = select(row.config, row.rank_error).where(row.submission_id == submission.id, row.ranked)
    with database.read() as session:
        least_equal = {
            config: smallest_disclosed_alike(error) if database.hidden_truth else error
            for config, error in session.execute(own)
            if error is not None
        }
        is_better = (and_(row.config == config, row.rank_error < error) for config, error in least_equal.items())
        query = (
            select(row.config, func.count())
            .join(SubmissionModel, SubmissionModel.id == row.submission_id)
            .where(or_(false(), *is_better), row.ranked, SubmissionModel.status == SCORED, SubmissionModel.public)
            .group_by(row.config)
        )
        counts = dict(session.execute(query).all())
    return {config: 1 + counts.get(config, 0) for config in least_equal}


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
