"""Queue worker: leases submissions, scores them with a backend, renews the lease meanwhile, stores the outcome."""

from __future__ import annotations

import os
import secrets
import socket
import threading
from collections.abc import Callable
from typing import TypeVar

import structlog

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.db.jobs import Job, Outcome
from leaderboard.settings import Settings

POLL_INTERVAL_S = 1.0
RETRY_INTERVAL_S = 1.0
RENEWALS_PER_LEASE = 4
_LOG = structlog.get_logger("worker")

T = TypeVar("T")
ScoringBackend = Callable[[Job, Callable[[], bool]], Outcome | None]
"""Function that scores a job.

It calls its second argument regularly and stops when that returns False. It returns None if it was stopped or its
process died, and raises ``BackendUnavailableError`` for an infrastructure failure."""


class BackendUnavailableError(Exception):
    """Raised when scoring is impossible for now: no backend, or archive or dataset unreachable.

    The job is requeued without counting the attempt.
    """


def new_worker_name() -> str:
    """Return a unique worker name: host name, process id and a random suffix."""
    return f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"


def process_queue(database: Database, settings: Settings, score: ScoringBackend, stop: threading.Event) -> None:
    """Score queued submissions until ``stop`` is set; then requeue the current job.

    While the database is unavailable its operations are retried, so that no outcome is lost.
    """
    name = new_worker_name()
    while not stop.is_set():
        submission_id = _retry_until_available(lambda: jobs.claim(database, name, settings.lease_seconds), stop)
        if submission_id is None:
            stop.wait(POLL_INTERVAL_S)
        else:
            _score_submission(submission_id, name, database, settings, score, stop)


def _score_submission(
    submission_id: str,
    name: str,
    database: Database,
    settings: Settings,
    score: ScoringBackend,
    stop: threading.Event,
) -> None:
    log = _LOG.bind(submission=submission_id[:6], worker=name)
    record = _retry_until_available(lambda: submissions.find(database, submission_id), stop)
    if record is None:  # Deleted after it was leased.
        return
    log.info("scoring started")
    wait_s, outcome = 0.0, None
    try:
        job = Job(submission_id, record.dataset_digest)
        outcome = score(job, _make_heartbeat(database, submission_id, name, settings.lease_seconds, stop))
    except BackendUnavailableError as error:
        log.warning("scoring backend unavailable; job requeued", reason=str(error))
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
