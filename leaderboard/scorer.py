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
from collections.abc import Callable
from pathlib import Path

import structlog

from leaderboard import jobs
from leaderboard.archives import Archives
from leaderboard.database import Database
from leaderboard.jobs import Outcome
from leaderboard.scoring_process import PICTURES, PROBLEM, RESULT, Task
from leaderboard.settings import Settings

IDLE_S = 1.0
RENEWALS_PER_LEASE = 4
_LOG = structlog.get_logger("scorer")

Score = Callable[[str, Callable[[], bool]], Outcome | None]
"""Score a submission; asked now and then whether to go on; None where it was told to stop or died."""


def scorer_name() -> str:
    """Return a name that no other scorer has."""
    return f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"


def work(database: Database, settings: Settings, score: Score, stop: threading.Event) -> None:
    """Score what waits until ``stop`` is set; then the job at hand is given back."""
    name = scorer_name()
    while not stop.is_set():
        submission_id = jobs.claim(database, name, settings.lease)
        if submission_id is None:
            stop.wait(IDLE_S)
            continue
        log = _LOG.bind(submission=submission_id[:6], scorer=name)
        log.info("scoring")
        outcome = score(submission_id, _keeper(database, submission_id, name, settings.lease, stop))
        if stop.is_set() and outcome is None:
            jobs.give_back(database, submission_id, name)
            log.info("given back")
        elif outcome is None:
            log.warning("died", lease_s=settings.lease)  # it waits for the lease to end, and is tried again
        else:
            kept = jobs.finish(database, submission_id, name, outcome)
            log.info("ended" if kept else "lost", reason=outcome.reason)


def _keeper(
    database: Database, submission_id: str, name: str, lease_s: float, stop: threading.Event
) -> Callable[[], bool]:
    """Return what renews the lease and tells whether to go on."""
    return lambda: not stop.is_set() and jobs.renew(database, submission_id, name, lease_s)


def local_score(settings: Settings, archives: Archives) -> Score:
    """Return scoring in a process of this machine, within the settings' time and memory."""

    def score(submission_id: str, go_on: Callable[[], bool]) -> Outcome | None:
        with tempfile.TemporaryDirectory(dir=settings.spool) as scratch:
            try:
                with archives.local(submission_id, Path(scratch)) as archive:
                    task = Task(str(archive), settings.data, scratch, settings.score_memory, settings.error_maps)
                    return _run(task, settings, go_on)
            except FileNotFoundError:
                return Outcome(reason="the archive is no longer there")

    return score


def _run(task: Task, settings: Settings, go_on: Callable[[], bool]) -> Outcome | None:
    command = [sys.executable, "-m", "leaderboard.scoring_process"]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    assert process.stdin is not None
    step_s = settings.lease / RENEWALS_PER_LEASE
    try:
        process.stdin.write(task.to_json())
        process.stdin.close()
        spent_s = 0.0
        while True:
            try:
                process.wait(min(step_s, IDLE_S))
                break
            except subprocess.TimeoutExpired:
                spent_s += min(step_s, IDLE_S)
            if spent_s >= settings.score_time:
                return Outcome(
                    reason=f"scoring took longer than the {settings.score_time:g} s this service allows"
                )
            if not go_on():
                return None
    except BrokenPipeError:
        pass
    finally:
        process.kill()
        process.wait()
    return _outcome(Path(task.out), process.returncode)


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
