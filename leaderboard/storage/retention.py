"""Deletion of archives: those that expire by age and rank, and those that belong to no submission."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import structlog
from sqlalchemy import select, update
from sqlalchemy.engine import CursorResult

from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.db.models import SubmissionModel, increment_content_version
from leaderboard.db.rankings import read_ranking
from leaderboard.db.submissions import DAY_S, DELETED, FAILED, SCORED
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore

ORPHAN_AGE_S = 3600.0
"""Age in seconds after which an archive without a submission is regarded as an interrupted upload."""
RETENTION_INTERVAL_S = 3600.0
_LOG = structlog.get_logger("retention")


def expired_archives(database: Database, configs: Sequence[str], settings: Settings) -> list[SubmissionModel]:
    """Return the ended submissions whose archive may be deleted, oldest first.

    They are older than ``archive_days`` days, and no public row of them is ranked up to ``archive_ranks`` in one
    of ``configs``.
    """
    query = (
        select(SubmissionModel)
        .where(
            SubmissionModel.status.in_((SCORED, FAILED)),
            SubmissionModel.archive_deleted_at.is_(None),
            SubmissionModel.created_at < time.time() - settings.archive_days * DAY_S,
        )
        .order_by(SubmissionModel.created_at)
    )
    with database.read() as session:
        old = list(session.scalars(query))
    kept = {
        entry.id
        for config in configs
        for entry in read_ranking(database, config).entries
        if entry.rank is not None and entry.rank <= settings.archive_ranks
    }
    return [record for record in old if record.id not in kept]


def delete_archives(database: Database, archives: ArchiveStore, records: Sequence[SubmissionModel]) -> None:
    """Delete the archives of submissions, which stay and cannot be scored again."""
    for record in records:
        is_ended = (SubmissionModel.id == record.id, SubmissionModel.status.in_((SCORED, FAILED)))
        with database.write() as session:
            changed = session.execute(
                update(SubmissionModel).where(*is_ended).values(archive_deleted_at=time.time())
            )
            increment_content_version(session)
        assert isinstance(changed, CursorResult)
        if changed.rowcount:
            archives.delete(record.id)


@contextmanager
def archive_retention(
    database: Database, archives: ArchiveStore, configs: Sequence[str], settings: Settings
) -> Iterator[None]:
    """Delete expired archives now and every hour in a thread, if the settings say after how many days."""
    stop = threading.Event()

    def delete_expired() -> None:
        while not stop.is_set():
            try:
                expired = expired_archives(database, configs, settings)
                delete_archives(database, archives, expired)
                _LOG.info("expired archives deleted", archives=len(expired))
            except (*DATABASE_UNAVAILABLE, OSError) as error:
                _LOG.warning("expired archives not deleted", error=type(error).__name__)
            stop.wait(RETENTION_INTERVAL_S)

    thread = threading.Thread(target=delete_expired, name="retention", daemon=True)
    if settings.archive_days:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        if thread.is_alive():
            thread.join()


def remove_orphan_archives(database: Database, archives: ArchiveStore) -> None:
    """Delete archives without a submission, except recent ones, whose row may not be inserted yet.

    Nothing is deleted if the database has no submissions, since it is probably not the one of these archives.
    """
    now = time.time()
    with database.read() as session:
        rows = session.execute(select(SubmissionModel.id, SubmissionModel.status)).all()
    orphans = archives.ids() - {submission_id for submission_id, status in rows if status != DELETED}
    if orphans and not rows:
        _LOG.warning("orphan cleanup skipped", reason="the database has no submissions", archives=len(orphans))
        return
    for submission_id in orphans:
        if archives.age_s(submission_id, now) > ORPHAN_AGE_S:
            archives.delete(submission_id)
            _LOG.info("orphaned archive deleted", archive=submission_id[:6])
