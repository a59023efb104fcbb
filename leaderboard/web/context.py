"""What the routes share: settings, dataset, database, archives, a spool for uploads, the checker, meters."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import structlog
from sqlalchemy import select

from leaderboard.db import jobs
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionRecord
from leaderboard.db.submissions import DELETED
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import Archives
from leaderboard.storage.work_dirs import own_spool
from leaderboard.uploads.validation import Checker
from leaderboard.web.metrics import Meters
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError

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
    spool: Path
    checker: Checker
    meters: Meters


@contextmanager
def open_service(settings: Settings) -> Iterator[Service]:
    """Open the database, brought up to date, and the archives, cleared of those that no submission knows.

    Raises ``InputError`` where the dataset, the database or the archives' place is at fault, and where the board
    has submissions of another dataset, unless these are to be scored again.
    """
    folder = open_folder(settings.data)
    with own_spool(settings.spool) as spool, closing(Database(settings.database_url)) as database:
        archives = Archives(settings.archives_url)
        database.migrate()
        clear(database, archives)
        _hold_to(folder, database, settings.rescore)
        with Checker(settings.data, settings.score_memory) as checker:
            yield Service(settings, folder, database, archives, spool, checker, Meters())


def _hold_to(folder: DatasetFolder, database: Database, rescore: bool) -> None:
    """A board never mixes numbers of two datasets."""
    others = jobs.count_of_another(database, folder.digest)
    if others and not rescore:
        raise InputError(
            f"{folder.root}: {others} submissions of this board are of another dataset, expected the same "
            f"(this one is {folder.digest}); to score them against this one: --rescore true"
        )
    jobs.queue_again(database, folder.digest)


def clear(database: Database, archives: Archives) -> None:
    """Remove archives that no submission knows, unless they came just now: their row may be under way.

    A database without any submission is likely not the one that these archives belong to.
    """
    now = time.time()
    with database.read() as session:
        rows = session.execute(select(SubmissionRecord.id, SubmissionRecord.status)).all()
    orphans = archives.ids() - {submission_id for submission_id, status in rows if status != DELETED}
    if orphans and not rows:
        _LOG.warning("nothing cleared", reason="the database has no submissions", archives=len(orphans))
        return
    for submission_id in orphans:
        if archives.age_s(submission_id, now) > ORPHAN_S:
            archives.delete(submission_id)
            _LOG.info("cleared", archive=submission_id[:6])
