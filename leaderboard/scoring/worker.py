"""Queue worker: leases submissions, scores them, renews the lease meanwhile, stores the outcome."""

from __future__ import annotations

import os
import secrets
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import structlog

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.db.jobs import Outcome
from leaderboard.scoring.run_sandbox import POLL_INTERVAL_S, UnavailableError, score_archive
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore

RETRY_INTERVAL_S = 1.0
_LOG = structlog.get_logger("worker")

T = TypeVar("T")


def new_worker_name() -> str:
    """Return a unique worker name: host name, process id and a random suffix."""
    return f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"


def process_queue(database: Database, settings: Settings, spool: Path, stop: threading.Event) -> None:
    """Score queued submissions until ``stop`` is set; then requeue the current job.

    While the database is unavailable its operations are retried, so that no outcome is lost. Temporary files are
    in ``spool``. Raises ``InputError`` if the archive storage is unusable.
    """
    name, archives = new_worker_name(), ArchiveStore(settings.archive_dir)
    while not stop.is_set():
        submission_id = _retry_until_available(lambda: jobs.claim(database, name, settings.lease_seconds), stop)
        if submission_id is None:
            stop.wait(POLL_INTERVAL_S)
        else:
            _score_submission(submission_id, name, database, archives, settings, spool, stop)


def _score_submission(
    submission_id: str,
    name: str,
    database: Database,
    archives: ArchiveStore,
    settings: Settings,
    spool: Path,
    stop: threading.Event,
) -> None:
    log = _LOG.bind(submission=submission_id[:6], worker=name)
    record = _retry_until_available(lambda: submissions.find(database, submission_id), stop)
    if record is None:  # Deleted after it was leased.
        return
    log.info("scoring started")
    wait_s, outcome = 0.0, None
    try:
        heartbeat = _make_heartbeat(database, submission_id, name, settings.lease_seconds, stop)
        archive = archives.path(submission_id)
        outcome = score_archive(archive, record.dataset_digest, settings, spool, heartbeat)
    except ArchiveNotFoundError:
        outcome = Outcome(reason="the archive is no longer in the archive storage")
    except (UnavailableError, OSError) as error:  # The attempt does not count.
        log.warning("scoring is unavailable; job requeued", reason=str(error))
        wait_s = settings.lease_seconds
    if outcome is not None:
        is_stored = _retry_until_available(lambda: jobs.finish(database, submission_id, name, outcome), stop)
        log.info("scoring finished" if is_stored else "lease lost; outcome discarded", reason=outcome.reason)
    elif wait_s or stop.is_set():
        _retry_until_available(lambda: jobs.release(database, submission_id, name, wait_s), stop)
        log.info("job requeued")
    else:
        log.warning(
            "scoring ended without an outcome; job requeued when the lease expires", lease_s=settings.lease_seconds
        )


def _retry_until_available(step: Callable[[], T], stop: threading.Event) -> T | None:
    """Call ``step`` until the database is available; return its value, or None if ``stop`` is set first."""
    while True:
        try:
            return step()
        except DATABASE_UNAVAILABLE as error:
            _LOG.warning("database unavailable", error=type(error).__name__)
            if stop.wait(RETRY_INTERVAL_S):
                return None


def _make_heartbeat(
    database: Database, submission_id: str, name: str, lease_s: float, stop: threading.Event
) -> Callable[[], bool]:
    """Return a function that renews the lease and returns whether scoring should continue."""

    def should_continue() -> bool:
        try:
            return not stop.is_set() and jobs.renew(database, submission_id, name, lease_s)
        except DATABASE_UNAVAILABLE:
            return True  # If another worker takes over, only one of them can finish the job.

    return should_continue
