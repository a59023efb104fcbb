"""A scorer: leases submissions, scores each in a process of its own, renews its lease meanwhile, ends it."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import structlog

from leaderboard import jobs
from leaderboard.archives import Archives
from leaderboard.database import AWAY, Database
from leaderboard.jobs import Outcome
from leaderboard.scoring_process import PICTURES, PROBLEM, RESULT, Task
from leaderboard.settings import Settings

IDLE_S = 1.0
AWAY_S = 1.0
RENEWALS_PER_LEASE = 4
_LOG = structlog.get_logger("scorer")

T = TypeVar("T")
Score = Callable[[str, Callable[[], bool]], Outcome | None]
"""Score a submission; asked now and then whether to go on; None where it was told to stop or died.

Raises ``AwayError`` where nobody is there to score."""


class AwayError(Exception):
    """Nobody is there to score: the job is given back and costs no attempt."""


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
    log.info("scoring")
    try:
        outcome = score(submission_id, _keeper(database, submission_id, name, settings.lease, stop))
        is_given_back = outcome is None and stop.is_set()
    except AwayError as error:
        log.warning("nobody to score", reason=str(error))
        outcome, is_given_back = None, True
    if outcome is not None:
        kept = _insist(lambda: jobs.finish(database, submission_id, name, outcome), stop)
        log.info("ended" if kept else "lost", reason=outcome.reason)
    elif is_given_back:
        _insist(lambda: jobs.give_back(database, submission_id, name), stop)
        log.info("given back")
        stop.wait(AWAY_S)
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


def local_score(settings: Settings, archives: Archives, spool: Path) -> Score:
    """Return scoring in a process of this machine, within the settings' time and memory; files go to ``spool``."""

    def score(submission_id: str, go_on: Callable[[], bool]) -> Outcome | None:
        with tempfile.TemporaryDirectory(dir=spool) as scratch:
            try:
                with archives.local(submission_id, Path(scratch)) as archive:
                    task = Task(
                        archive=str(archive),
                        data=settings.data,
                        out=scratch,
                        memory=settings.score_memory,
                        error_maps=settings.error_maps,
                        parent=os.getpid(),
                    )
                    return _run(task, settings, go_on)
            except FileNotFoundError:
                return Outcome(reason="the archive is no longer there")
            except OSError as error:
                raise AwayError(f"the archive cannot be had: {error}") from None

    return score


def _run(task: Task, settings: Settings, go_on: Callable[[], bool]) -> Outcome | None:
    command = [sys.executable, "-m", "leaderboard.scoring_process"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    assert process.stdin is not None
    step_s = min(settings.lease / RENEWALS_PER_LEASE, IDLE_S)
    end = time.monotonic() + settings.score_time
    try:
        with suppress(BrokenPipeError):
            process.stdin.write(task.to_json())
            process.stdin.close()
        while not _has_ended(process, step_s):
            if time.monotonic() >= end:
                return Outcome(
                    reason=f"scoring took longer than the {settings.score_time:g} s this service allows"
                )
            if not go_on():
                return None
    finally:
        process.kill()
        process.wait()
    return _outcome(Path(task.out), process.returncode)


def _has_ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        process.wait(within_s)
    return process.returncode is not None


def _outcome(out: Path, status: int) -> Outcome | None:
    if (out / RESULT).is_file() and status == 0:
        pictures = sorted((out / PICTURES).glob("*.webp")) if (out / PICTURES).is_dir() else []
        maps = {path.with_suffix(".txt").read_text(): path.read_bytes() for path in pictures}
        return Outcome(result=(out / RESULT).read_bytes(), pictures=maps)
    if (out / PROBLEM).is_file():
        return Outcome(reason=(out / PROBLEM).read_text())
    if status in (-signal.SIGKILL, -signal.SIGTERM):
        return None  # somebody's doing, not the archive's: try again
    return Outcome(reason=f"scoring ended with status {status} and said nothing")
