"""A scorer: leases submissions, has each scored, renews its lease meanwhile, ends it."""

from __future__ import annotations

import os
import secrets
import socket
import threading
from collections.abc import Callable
from typing import TypeVar

import structlog

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import AWAY, Database
from leaderboard.db.jobs import Job, Outcome
from leaderboard.settings import Settings

IDLE_S = 1.0
AWAY_S = 1.0
RENEWALS_PER_LEASE = 4
_LOG = structlog.get_logger("scorer")

T = TypeVar("T")
Score = Callable[[Job, Callable[[], bool]], Outcome | None]
"""Score a job; asked now and then whether to go on; None where it was told to stop or died.

Raises ``AwayError`` where the fault is not the archive's."""


class AwayError(Exception):
    """Nobody is there to score, or archive or dataset cannot be had: the job waits, and it costs no attempt."""


def scorer_name() -> str:
    """Return a name that no other scorer has."""
    return f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"


def work(database: Database, settings: Settings, score: Score, stop: threading.Event) -> None:
    """Score what waits until ``stop`` is set; then the job at hand is given back.

    A database that is away for a while is waited for; what was scored meanwhile is kept once it is back.
    """
    name = scorer_name()
    while not stop.is_set():
        submission_id = _insist(lambda: jobs.claim(database, name, settings.lease), stop)
        if submission_id is None:
            stop.wait(IDLE_S)
        else:
            _work_on(submission_id, name, database, settings, score, stop)


def _work_on(
    submission_id: str, name: str, database: Database, settings: Settings, score: Score, stop: threading.Event
) -> None:
    log = _LOG.bind(submission=submission_id[:6], scorer=name)
    record = _insist(lambda: submissions.find(database, submission_id), stop)
    if record is None:  # deleted a moment ago
        return
    log.info("scoring")
    wait_s, outcome = 0.0, None
    try:
        job = Job(submission_id, record.dataset_digest)
        outcome = score(job, _keeper(database, submission_id, name, settings.lease, stop))
    except AwayError as error:
        log.warning("nobody to score", reason=str(error))
        wait_s = settings.lease
    if outcome is not None:
        kept = _insist(lambda: jobs.finish(database, submission_id, name, outcome), stop)
        log.info("ended" if kept else "lost", reason=outcome.reason)
    elif wait_s or stop.is_set():
        _insist(lambda: jobs.give_back(database, submission_id, name, wait_s), stop)
        log.info("given back")
    else:
        log.warning("died", lease_s=settings.lease)  # it waits for the lease to end, and is tried again


def _insist(step: Callable[[], T], stop: threading.Event) -> T | None:
    """Return what ``step`` returns, tried again while the database is away; None where ``stop`` comes first."""
    while True:
        try:
            return step()
        except AWAY as error:
            _LOG.warning("database away", error=type(error).__name__)
            if stop.wait(AWAY_S):
                return None


def _keeper(
    database: Database, submission_id: str, name: str, lease_s: float, stop: threading.Event
) -> Callable[[], bool]:
    """Return what renews the lease and tells whether to go on."""

    def go_on() -> bool:
        try:
            return not stop.is_set() and jobs.renew(database, submission_id, name, lease_s)
        except AWAY:
            return True  # should another take over meanwhile, only one of the two can end the job

    return go_on
