"""The board: public rows of a config, ranked as the protocol says, and those of a submission."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import false, select

from leaderboard.database import Database
from leaderboard.records import PictureRecord, RowRecord, SubmissionRecord, TokenRecord
from leaderboard.submissions import SCORED


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
    public: bool
    table: Mapping[str, Any]


def board(database: Database, config: str, viewer: TokenRecord | None = None) -> list[BoardRow]:
    """Return a config's rows: ranked ones by native AbsRel, then the unranked, older before newer among equals.

    Public rows, and those of the token that asks; a row that is not public takes no rank from others.
    """
    own = false() if viewer is None else SubmissionRecord.token_id == viewer.id
    query = (
        select(RowRecord, SubmissionRecord, TokenRecord.name)
        .join(SubmissionRecord, SubmissionRecord.id == RowRecord.submission_id)
        .join(TokenRecord, TokenRecord.id == SubmissionRecord.token_id)
        .where(RowRecord.config == config, SubmissionRecord.status == SCORED, SubmissionRecord.public | own)
        .order_by(RowRecord.ranked.desc(), RowRecord.abs_rel.nulls_last(), SubmissionRecord.created_at)
    )
    with database.read() as session:
        found = session.execute(query).all()
    rows, rank = [], 0
    for row, submission, submitter in found:
        counts = row.ranked and submission.public
        rank += counts
        rows.append(_row(row, submission, submitter, rank if counts else None))
    return rows


def submission_rows(database: Database, submission: SubmissionRecord) -> list[BoardRow]:
    """Return a submission's own rows, a config each; their ranks are those of the board."""
    query = select(RowRecord.config).where(RowRecord.submission_id == submission.id).order_by(RowRecord.config)
    with database.read() as session:
        configs = session.scalars(query).all()
        token = session.get_one(TokenRecord, submission.token_id)
    return [
        row for config in configs for row in board(database, config, token) if row.submission_id == submission.id
    ]


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


def _row(row: RowRecord, submission: SubmissionRecord, submitter: str, rank: int | None) -> BoardRow:
    return BoardRow(
        rank=rank,
        submission_id=submission.id,
        config=row.config,
        method=submission.method,
        submitter=submitter,
        url=submission.url,
        uses_intrinsics=submission.uses_intrinsics,
        created_at=submission.created_at,
        public=submission.public,
        table=json.loads(row.json),
    )
