"""Ranking queries: the rows of a config with their ranks, pictures of views, and the queue position.

The queries select columns instead of ORM objects, so that a page with hundreds of rows takes milliseconds.

If the ground truth is hidden, rows, order and ranks depend on the disclosed numbers only, and no picture is
returned.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from sqlalchemy import false, func, select

from leaderboard.db.engine import Database
from leaderboard.db.models import (
    LeaderboardRowModel,
    PictureImageModel,
    PictureModel,
    ResultModel,
    SubmissionModel,
    TokenModel,
)
from leaderboard.db.submissions import QUEUED, SCORED
from leaderboard.db.view_errors import rank_ranges
from rebar_depth_bench.scoring.disclosure import DisclosedTable, disclosed_number
from rebar_depth_bench.scoring.protocol import OLD_PROTOCOL, PROTOCOL


@dataclass(frozen=True)
class LeaderboardEntry:
    """A submission's row of one config; ``rank`` is None if the row is not ranked.

    ``class_rank`` is the rank among the submissions that declare the same ``inputs``, None without a declaration.
    ``rank_range`` holds the first and last rank that the paired 95 % differences allow, None where they are not
    known. ``table_json`` is the JSON text of the config's table in the result, or of its disclosed part.
    """

    rank: int | None
    class_rank: int | None
    rank_range: tuple[int, int] | None
    submission_id: str
    config: str
    method: str
    submitter: str
    url: str | None
    uses_intrinsics: bool | None
    inputs: str | None
    uses_ground_truth: bool | None
    created_at: float
    public: bool
    details_json: str
    table_json: str
    rank_error: float | None = field(default=None, kw_only=True)


_COLUMNS = (
    LeaderboardRowModel.ranked,
    LeaderboardRowModel.rank_error,
    LeaderboardRowModel.view_errors,
    SubmissionModel.id,
    LeaderboardRowModel.config,
    SubmissionModel.method,
    TokenModel.name,
    SubmissionModel.url,
    SubmissionModel.uses_intrinsics,
    SubmissionModel.inputs,
    SubmissionModel.uses_ground_truth,
    SubmissionModel.created_at,
    SubmissionModel.public,
    SubmissionModel.details,
    LeaderboardRowModel.json,
)
"""Columns of a row: whether it is ranked, its rank error, its view errors, then the fields of the entry."""


@dataclass(frozen=True)
class Ranking:
    """Rows of a config: ranked rows first, by rank error, then unranked ones; ties by age, oldest first."""

    entries: tuple[LeaderboardEntry, ...]

    @cached_property
    def by_id(self) -> dict[str, LeaderboardEntry]:
        """Rows by submission id."""
        return {entry.submission_id: entry for entry in self.entries}

    def of_class(self, inputs: str | None) -> list[LeaderboardEntry]:
        """Return the rows that declare ``inputs``, all rows for None; their ranks are kept."""
        return [entry for entry in self.entries if inputs is None or entry.inputs == inputs]


def read_ranking(database: Database, config: str, viewer: TokenModel | None = None) -> Ranking:
    """Return the public rows of a config and those of ``viewer``, of results that this version can read.

    Equal rank errors share a rank. A row that is not public has no rank and does not affect the ranks of others.
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
    return Ranking(tuple(_ranked(rows)))


def _ranked(rows: Sequence[tuple[Any, ...]]) -> list[LeaderboardEntry]:
    overall, by_inputs = _RankCounter(), defaultdict[str, _RankCounter](_RankCounter)
    entries = [LeaderboardEntry(None, None, None, *row[3:], rank_error=row[1]) for row in rows]
    ranked = [index for index, row in enumerate(rows) if row[0] and entries[index].public]
    ranges = rank_ranges([rows[index][2] for index in ranked])
    for index, rank_range in zip(ranked, ranges, strict=True):
        entry, error = entries[index], rows[index][1]
        entries[index] = replace(
            entry,
            rank=overall.next(error),
            class_rank=by_inputs[entry.inputs].next(error) if entry.inputs else None,
            rank_range=rank_range,
        )
    return entries


def _disclosed(row: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the values of ``_COLUMNS`` with the rank error and the table as they are disclosed."""
    ranked, rank_error, _, *others, table_json = row
    shown = None if rank_error is None else disclosed_number(rank_error)
    return ranked, shown, None, *others, DisclosedTable.model_validate_json(table_json).model_dump_json()


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


def picture_facts(database: Database, submission_id: str) -> dict[str, tuple[dict[str, Any], list[str]]]:
    """Return the facts and the kinds of the stored pictures by view id."""
    if database.hidden_truth:
        return {}
    facts = select(PictureModel.view_id, PictureModel.facts).where(PictureModel.submission_id == submission_id)
    kinds = select(PictureImageModel.view_id, PictureImageModel.kind).where(
        PictureImageModel.submission_id == submission_id
    )
    with database.read() as session:
        pictures = {view_id: (json.loads(text), list[str]()) for view_id, text in session.execute(facts)}
        for view_id, kind in session.execute(kinds):
            pictures[view_id][1].append(kind)
    return pictures


def picture_webp(database: Database, submission_id: str, view_id: str, kind: str) -> bytes | None:
    """Return a picture of a view as WebP bytes, or None if it is not stored."""
    if database.hidden_truth:
        return None
    with database.read() as session:
        record = session.get(PictureImageModel, (submission_id, view_id, kind))
        return None if record is None else record.webp


@dataclass(frozen=True)
class QueuePosition:
    """Position of a submission in the queue, where 1 is next, and the number of waiting submissions."""

    number: int
    waiting: int


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
