"""Queue workers: threads that lease submissions, score them, renew the lease meanwhile and store the outcome.

Archives are read in processes of their own, so workers need little time and memory.
"""

from __future__ import annotations

import os
import secrets
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import structlog

from leaderboard.db import jobs
from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database
from leaderboard.scoring.isolation import ProcessEndedError, TimeLimitError, UnavailableError, isolated_call
from leaderboard.scoring.sandbox import Outcome, score
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore, archive_problem
from rebar_depth_bench.base.errors import StorageError, SubmissionError, problem_summary

POLL_INTERVAL_S = 1.0
RETRY_INTERVAL_S = 1.0
RENEWALS_PER_LEASE = 4
_LOG = structlog.get_logger("worker")


@contextmanager
def running_workers(
    database: Database, settings: Settings, stop: threading.Event
) -> Iterator[list[threading.Thread]]:
    """Run the workers of the settings until ``stop`` is set or the block ends; their jobs are then requeued."""
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
    """Score queued submissions until ``stop`` is set; then requeue the current job."""
    name = f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"
    while not stop.is_set():
        try:
            if not score_next(database, settings, name, stop):
                stop.wait(POLL_INTERVAL_S)
        except DATABASE_UNAVAILABLE as error:
            _LOG.warning("database unavailable", error=type(error).__name__)
            stop.wait(RETRY_INTERVAL_S)
        except Exception:  # The job is free again when its lease expires.
            _LOG.exception("worker failed; continuing", worker=name)
            stop.wait(RETRY_INTERVAL_S)


def score_next(database: Database, settings: Settings, name: str, stop: threading.Event) -> bool:
    """Score a submission as the worker ``name``, which is unique; return False if none is waiting.

    The submission is leased, its archive scored in another process while the lease is renewed, and the outcome
    stored. A job that cannot be done now (dataset, archive folder or disk unusable, or ``stop`` is set) is
    requeued. Raises the errors of an unavailable database, but not once there is an outcome: then storing it is
    tried until the database is available.
    """
    lease_s = settings.lease_seconds
    record = jobs.claim(database, name, lease_s)
    if record is None:
        return False
    log = _LOG.bind(submission=record.id[:6], worker=name)
    log.info("scoring started")
    board = database.board()
    digest = board.dataset_digest or ""
    archives = ArchiveStore(settings.archive_dir, board.board_id)
    try:
        job = (score, archives.file(record.id), settings.data, digest)
        with isolated_call(*job, memory=settings.score_memory, time_limit_s=settings.score_time) as call:
            while not call.wait(min(lease_s / RENEWALS_PER_LEASE, POLL_INTERVAL_S)):
                if stop.is_set():
                    jobs.release(database, record.id, name)
                    log.info("job requeued")
                    return True
                try:
                    if not jobs.renew(database, record.id, name, lease_s):
                        log.warning("lease lost")
                        return True
                except DATABASE_UNAVAILABLE:
                    pass  # If another worker takes over, only one of them can finish the job.
            outcome = call.value()
    except (UnavailableError, StorageError, OSError) as error:
        return _requeue(database, record.id, name, lease_s, error)
    except SubmissionError as error:
        outcome = Outcome(digest, reason=problem_summary(error.problems))
    except TimeLimitError:
        outcome = Outcome(digest, reason=f"scoring took longer than the limit of {settings.score_time:g} s")
    except ProcessEndedError as error:
        log.error("scoring process ended", status=error.status, details=error.details)
        if error.was_killed:  # From outside, which says nothing of the archive; free when the lease expires.
            return True
        outcome = Outcome(digest, reason=f"{error} without a result")
    if outcome.reason is not None:  # Is it the fault of what was accepted, or of the storage?
        row = (record.archive_sha256, record.archive_bytes)
        try:
            if problem := archive_problem(archives.file(record.id), row, hashed=True):
                outcome = Outcome(
                    digest, reason=f"the stored archive {problem}; the operator can requeue it once it is restored"
                )
        except (StorageError, OSError) as error:
            return _requeue(database, record.id, name, lease_s, error)
    while True:
        try:
            is_stored = jobs.finish(database, record.id, name, outcome)
        except DATABASE_UNAVAILABLE as error:
            log.warning("database unavailable", error=type(error).__name__)
            if stop.wait(RETRY_INTERVAL_S):
                return True
        else:
            log.info("scoring finished" if is_stored else "lease lost; outcome discarded", reason=outcome.reason)
            return True


def _requeue(database: Database, submission_id: str, name: str, wait_s: float, error: Exception) -> bool:
    """Requeue a job that cannot be done now, without counting the attempt; return True."""
    _LOG.warning("scoring is unavailable; job requeued", submission=submission_id[:6], reason=str(error))
    jobs.release(database, submission_id, name, wait_s)
    return True
