"""Scoring on this machine: an archive in a process of its own, within the settings' time and memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import structlog

from leaderboard.db.jobs import Job, Outcome
from leaderboard.scoring.sandbox import AWAY, PICTURES, PROBLEM, RESULT, Task
from leaderboard.scoring.worker import IDLE_S, RENEWALS_PER_LEASE, AwayError, Score
from leaderboard.settings import Settings

COMPLAINTS = "complaints.txt"
_LOG = structlog.get_logger("scorer")


def local_score(settings: Settings, spool: Path) -> Score:
    """Return scoring in a process of this machine; its files go to ``spool``."""

    def score(job: Job, go_on: Callable[[], bool]) -> Outcome | None:
        with tempfile.TemporaryDirectory(dir=spool) as scratch:
            task = Task(
                archives=settings.archives_url,
                submission_id=job.submission_id,
                data=settings.data,
                dataset_digest=job.dataset_digest,
                out=scratch,
                memory=settings.score_memory,
                error_maps=settings.error_maps,
                parent=os.getpid(),
            )
            try:
                return _run(task, settings, go_on)
            except OSError as error:
                raise AwayError(str(error)) from None

    return score


def _run(task: Task, settings: Settings, go_on: Callable[[], bool]) -> Outcome | None:
    command = [sys.executable, "-m", "leaderboard.scoring.sandbox"]
    with (Path(task.out) / COMPLAINTS).open("wb") as complaints:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=complaints, stderr=complaints)
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
    if (out / AWAY).is_file():
        raise AwayError((out / AWAY).read_text())
    if status in (-signal.SIGKILL, -signal.SIGTERM):
        return None  # somebody's doing, not the archive's: try again
    _LOG.error("scoring crashed", status=status, said=(out / COMPLAINTS).read_text(errors="replace")[-2000:])
    return Outcome(reason=f"scoring ended with status {status} and said nothing")
