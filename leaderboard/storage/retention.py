"""Deletion of archives whose row says so: those of removed submissions, and those that expire by age and rank.

The row is committed before the file is deleted, so that a file that is left over is found again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import structlog
from sqlalchemy import select, update
from sqlalchemy.exc import DatabaseError

from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.db.models import SubmissionModel, increment_content_version
from leaderboard.db.rankings import read_ranking
from leaderboard.db.submissions import DAY_S, FAILED, SCORED, archive_rows
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore
from rebar_depth_bench.data.manifest import DatasetFolder

ORPHAN_AGE_S = 3600.0
"""Age in seconds after which an archive without a row belongs to no upload that is about to insert one."""
RETENTION_INTERVAL_S = 3600.0
_LOG = structlog.get_logger("retention")


def expired_archives(database: Database, folder: DatasetFolder, settings: Settings) -> list[str]:
    """Return the ids of the ended submissions whose archive may be deleted, oldest first.

    They are older than ``archive_days`` days, and no public row of them is ranked up to ``archive_ranks`` in one
    of the configs of the dataset.
    """
    query = (
        select(SubmissionModel.id)
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
        for config in folder.configs
        for entry in read_ranking(database, config, folder.digest).entries
        if entry.rank is not None and entry.rank <= settings.archive_ranks
    }
    return [submission_id for submission_id in old if submission_id not in kept]


def prune_archives(database: Database, archives: ArchiveStore, submission_ids: Iterable[str]) -> None:
    """Delete the archives of submissions, which stay and cannot be scored again, and all that are not needed."""
    for submission_id in submission_ids:
        is_ended = (SubmissionModel.id == submission_id, SubmissionModel.status.in_((SCORED, FAILED)))
        with database.write() as session:
            session.execute(update(SubmissionModel).where(*is_ended).values(archive_deleted_at=time.time()))
            increment_content_version(session)
    delete_archives(archives, unneeded_archives(archive_rows(database), archives))


def unneeded_archives(rows: Mapping[str, tuple[str, int] | None], archives: ArchiveStore) -> list[str]:
    """Return the ids of the archives whose row says deleted or pruned."""
    return sorted(submission_id for submission_id in archives.ids() if rows.get(submission_id, ("", 0)) is None)


def delete_archives(archives: ArchiveStore, submission_ids: Iterable[str]) -> None:
    """Delete archives; one that cannot be deleted is logged."""
    for submission_id in submission_ids:
        try:
            archives.delete(submission_id)
        except OSError as error:
            _LOG.warning("archive not deleted", submission=submission_id[:6], error=error.strerror)


@contextmanager
def archive_retention(
    database: Database, archives: ArchiveStore, folder: DatasetFolder, settings: Settings
) -> Iterator[None]:
    """Delete expired archives, if the settings have an age, and unneeded ones: now and every hour, in a thread."""
    stop = threading.Event()

    def apply() -> None:
        while not stop.is_set():
            try:
                expired = expired_archives(database, folder, settings) if settings.archive_days else []
                prune_archives(database, archives, expired)
                archives.delete_leftovers(ORPHAN_AGE_S)
            except (*DATABASE_UNAVAILABLE, DatabaseError, OSError) as error:
                _LOG.warning("archives not deleted", error=type(error).__name__)
            stop.wait(RETENTION_INTERVAL_S)

    thread = threading.Thread(target=apply, name="retention", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def orphaned_archives(database: Database, archives: ArchiveStore) -> list[str]:
    """Return the ids of archives without a row, of an interrupted upload or a database that was lost.

    Recent ones, whose row may be inserted yet, are left out.
    """
    old = [submission_id for submission_id in archives.ids() if archives.age_s(submission_id) > ORPHAN_AGE_S]
    return sorted(set(old) - archive_rows(database).keys())
