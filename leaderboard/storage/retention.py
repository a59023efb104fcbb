"""Retention of archives: which archives of ended submissions are deleted, by their age and rank."""

from __future__ import annotations

import time
from collections.abc import Sequence

from sqlalchemy import select, update

from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel, increment_content_version
from leaderboard.db.rankings import read_ranking
from leaderboard.db.submissions import FAILED, SCORED
from leaderboard.storage.archive_store import ArchiveStore

DAY_S = 86400.0


def expired_archives(
    database: Database, configs: Sequence[str], archive_days: float, archive_ranks: int
) -> list[SubmissionModel]:
    """Return the ended submissions whose archive may be deleted, oldest first.

    They are older than ``archive_days`` days, and no public row of them is ranked up to ``archive_ranks`` in one
    of ``configs``.
    """
    query = (
        select(SubmissionModel)
        .where(
            SubmissionModel.status.in_((SCORED, FAILED)),
            SubmissionModel.archive_deleted_at.is_(None),
            SubmissionModel.created_at < time.time() - archive_days * DAY_S,
        )
        .order_by(SubmissionModel.created_at)
    )
    with database.read() as session:
        old = list(session.scalars(query))
    kept = {
        entry.submission_id
        for config in configs
        for entry in read_ranking(database, config).entries
        if entry.rank is not None and entry.rank <= archive_ranks
    }
    return [record for record in old if record.id not in kept]


def delete_archives(database: Database, archives: ArchiveStore, records: Sequence[SubmissionModel]) -> None:
    """Delete the archives of submissions, which stay and cannot be scored again."""
    for record in records:
        with database.write() as session:
            changed = session.execute(
                update(SubmissionModel)
                .where(SubmissionModel.id == record.id, SubmissionModel.status.in_((SCORED, FAILED)))
                .values(archive_deleted_at=time.time())
            )
            increment_content_version(session)
        if changed.rowcount:  # type: ignore[attr-defined]
            archives.delete(record.id)
