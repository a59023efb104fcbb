"""What the routes share: settings, database, archives, the checker, meters, and the dataset's outline."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import structlog
from sqlalchemy import select

from leaderboard.archives import Archives
from leaderboard.checking import Checker
from leaderboard.database import Database
from leaderboard.meters import Meters
from leaderboard.records import SubmissionRecord
from leaderboard.settings import Settings
from leaderboard.submissions import DELETED
from rebar_depth_bench.folder import DatasetFolder, open_folder

ORPHAN_S = 3600.0
"""An archive without a submission is an upload that was cut off, once it is so old."""
_LOG = structlog.get_logger("service")


@dataclass(frozen=True)
class Service:
    """All that a request needs."""

    settings: Settings
    folder: DatasetFolder
    database: Database
    archives: Archives
    checker: Checker
    meters: Meters


@contextmanager
def open_service(settings: Settings) -> Iterator[Service]:
    """Open the database, brought up to date, and the archives, cleared of what uploads cut off have left.

    Raises ``InputError`` where the dataset, the database or the archives' place is at fault.
    """
    folder = open_folder(settings.data)
    settings.spool.mkdir(parents=True, exist_ok=True)
    database = Database(settings.database_url)
    archives = Archives(settings.archives_url)
    try:
        database.migrate()
        clear(settings, database, archives)
        with Checker(settings.data, settings.score_memory) as checker:
            yield Service(settings, folder, database, archives, checker, Meters())
    finally:
        database.close()


def clear(settings: Settings, database: Database, archives: Archives) -> None:
    """Remove spooled files that no upload writes to any more, and archives that no submission knows."""
    now = time.time()
    for path in settings.spool.glob("*.upload"):
        if now - path.stat().st_mtime > ORPHAN_S:
            path.unlink(missing_ok=True)
            _LOG.info("cleared", spooled=path.name)
    with database.read() as session:
        known = set(session.scalars(select(SubmissionRecord.id).where(SubmissionRecord.status != DELETED)))
    for submission_id in archives.ids() - known:
        if archives.age_s(submission_id, now) > ORPHAN_S:
            archives.delete(submission_id)
            _LOG.info("cleared", archive=submission_id[:6])
