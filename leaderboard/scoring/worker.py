"""Queue workers: threads that lease submissions, score them, renew the lease meanwhile and store the outcome.

Archives are read in processes of their own, so workers need little time and memory.
"""

from __future__ import annotations

import os
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import structlog

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.db.models import SubmissionModel
from leaderboard.scoring.isolation import (
    POLL_INTERVAL_S,
    ProcessEndedError,
    StoppedError,
    TimeLimitError,
    UnavailableError,
    call_isolated,
)
from leaderboard.scoring.sandbox import Outcome, score
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore
from rebar_depth_bench.base.errors import SubmissionError, problem_summary

RETRY_INTERVAL_S = 1.0
RENEWALS_PER_LEASE = 4
_LOG = structlog.get_logger("worker")

T = TypeVar("T")


@contextmanager
def running_workers(database: Database, settings: Settings) -> Iterator[list[threading.Thread]]:
    """Run the workers of the settings until the block ends; their jobs are then requeued."""
    stop = threading.Event()
    workers = [
        threading.Thread(target=process_queue, args=(database, settings, stop), name=f"worker {number}")
        for number in range(settings.workers)
    ]
    for worker in workers:
        worker.start()
    try:
        yield workers
    finally:
        stop.set()
        for worker in workers:
            worker.join()


def process_queue(database: Database, settings: Settings, stop: threading.Event) -> None:
    """Score queued submissions until ``stop`` is set; then requeue the current job.

    While the database is unavailable its operations are retried, so that no outcome is lost. Raises
    ``InputError`` if the archive storage is unusable.
    """
    name = f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"
    worker = _Worker(name, database, ArchiveStore(settings.archive_dir), settings, stop)
    while not stop.is_set():
        try:
            if not worker.score_next():
                stop.wait(POLL_INTERVAL_S)
        except Exception:  # The job is free again when its lease expires.
            _LOG.exception("worker failed; continuing", worker=name)
            stop.wait(RETRY_INTERVAL_S)


@dataclass(frozen=True)
class _Worker:
    """A worker and what it needs; ``name`` is unique."""

    name: str
    database: Database
    archives: ArchiveStore
    settings: Settings
    stop: threading.Event

    def score_next(self) -> bool:
        """Score a submission; return False if none is waiting."""
        lease_s = self.settings.lease_seconds
        submission_id = self._retried(lambda: jobs.claim(self.database, self.name, lease_s))
        if submission_id is None:
            return False
        record = self._retried(lambda: submissions.find(self.database, submission_id))
        if record is not None:  # Otherwise deleted after it was leased.
            self._score(record)
        return True

    def _score(self, record: SubmissionModel) -> None:
        log = _LOG.bind(submission=record.id[:6], worker=self.name)
        log.info("scoring started")
        wait_s, outcome = 0.0, None
        try:
            outcome = self._outcome(record)
        except (UnavailableError, OSError) as error:  # The attempt does not count.
            log.warning("scoring is unavailable; job requeued", reason=str(error))
            wait_s = self.settings.lease_seconds
        if outcome is not None:
            is_stored = self._retried(lambda: jobs.finish(self.database, record.id, self.name, outcome))
            log.info("scoring finished" if is_stored else "lease lost; outcome discarded", reason=outcome.reason)
        elif wait_s or self.stop.is_set():
            self._retried(lambda: jobs.release(self.database, record.id, self.name, wait_s))
            log.info("job requeued")
        else:
            log.warning("scoring ended without an outcome; job requeued when the lease expires")

    def _outcome(self, record: SubmissionModel) -> Outcome | None:
        """Return the outcome, or None if the process was killed from outside or should not continue."""
        settings = self.settings
        try:
            return call_isolated(
                score,
                self.archives.path(record.id),
                settings.data,
                record.dataset_digest,
                settings.error_maps,
                settings.hidden_truth,
                memory=settings.score_memory,
                time_limit_s=settings.score_time,
                step_s=min(settings.lease_seconds / RENEWALS_PER_LEASE, POLL_INTERVAL_S),
                should_continue=lambda: self._keeps_lease(record.id),
            )
        except ArchiveNotFoundError:
            return Outcome(reason="the archive is no longer in the archive storage", archive_missing=True)
        except SubmissionError as error:
            return Outcome(reason=problem_summary(error.problems))
        except TimeLimitError:
            return Outcome(reason=f"scoring took longer than the limit of {settings.score_time:g} s")
        except StoppedError:
            return None
        except ProcessEndedError as error:
            _LOG.error("scoring process ended", submission=record.id[:6], status=error.status)
            return None if error.was_killed else Outcome(reason=f"{error} without a result")

    def _keeps_lease(self, submission_id: str) -> bool:
        """Renew the lease; return whether scoring should continue."""
        try:
            lease_s = self.settings.lease_seconds
            return not self.stop.is_set() and jobs.renew(self.database, submission_id, self.name, lease_s)
        except DATABASE_UNAVAILABLE:
            return True  # If another worker takes over, only one of them can finish the job.

    def _retried(self, step: Callable[[], T]) -> T | None:
        """Call ``step`` until the database is available; return its value, or None if ``stop`` is set first."""
        while True:
            try:
                return step()
            except DATABASE_UNAVAILABLE as error:
                _LOG.warning("database unavailable", error=type(error).__name__)
                if self.stop.wait(RETRY_INTERVAL_S):
                    return None
