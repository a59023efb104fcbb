"""Scoring backend on this machine: one subprocess per archive, with the time and memory limits of the settings."""

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
from leaderboard.scoring.task import ERROR_MAPS_DIR, PROBLEM_FILE, RESULT_FILE, UNAVAILABLE_FILE, ScoringTask
from leaderboard.scoring.worker import POLL_INTERVAL_S, RENEWALS_PER_LEASE, BackendUnavailableError, ScoringBackend
from leaderboard.settings import Settings

OUTPUT_FILE = "output.txt"
_LOG = structlog.get_logger("worker")


def make_subprocess_backend(settings: Settings, spool: Path) -> ScoringBackend:
    """Return a backend that scores in a subprocess on this machine, with its files in ``spool``."""

    def score(job: Job, should_continue: Callable[[], bool]) -> Outcome | None:
        with tempfile.TemporaryDirectory(dir=spool) as scratch:
            task = ScoringTask(
                archives=settings.archives_url,
                submission_id=job.submission_id,
                data=settings.data,
                dataset_digest=job.dataset_digest,
                out=scratch,
                memory=settings.score_memory,
                error_maps=settings.error_maps,
                hidden_truth=settings.hidden_truth,
                parent=os.getpid(),
            )
            try:
                return _run_sandbox(task, settings, should_continue)
            except OSError as error:
                raise BackendUnavailableError(str(error)) from None

    return score


def _run_sandbox(task: ScoringTask, settings: Settings, should_continue: Callable[[], bool]) -> Outcome | None:
    command = [sys.executable, "-P", "-m", "leaderboard.scoring.sandbox"]
    with (Path(task.out) / OUTPUT_FILE).open("wb") as output:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output)
    assert process.stdin is not None
    step_s = min(settings.lease_seconds / RENEWALS_PER_LEASE, POLL_INTERVAL_S)
    deadline = time.monotonic() + settings.score_time
    try:
        with suppress(BrokenPipeError):
            process.stdin.write(task.to_json())
            process.stdin.close()
        while not _has_ended(process, min(step_s, max(0.0, deadline - time.monotonic()))):
            if time.monotonic() >= deadline:
                return Outcome(reason=f"scoring took longer than the limit of {settings.score_time:g} s")
            if not should_continue():
                return None
    finally:
        process.kill()
        process.wait()
    return _read_outcome(Path(task.out), process.returncode)


def _has_ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        process.wait(within_s)
    return process.returncode is not None


def _read_outcome(out: Path, status: int) -> Outcome | None:
    if (out / RESULT_FILE).is_file() and status == 0:
        images = sorted((out / ERROR_MAPS_DIR).glob("*.webp")) if (out / ERROR_MAPS_DIR).is_dir() else []
        error_maps = {path.with_suffix(".txt").read_text(): path.read_bytes() for path in images}
        return Outcome(result=(out / RESULT_FILE).read_bytes(), error_maps=error_maps)
    if (out / PROBLEM_FILE).is_file():
        return Outcome(reason=(out / PROBLEM_FILE).read_text())
    if (out / UNAVAILABLE_FILE).is_file():
        raise BackendUnavailableError((out / UNAVAILABLE_FILE).read_text())
    if status in (-signal.SIGKILL, -signal.SIGTERM):
        return None  # Killed from outside, not caused by the archive: try again.
    output = (out / OUTPUT_FILE).read_text(errors="replace")[-2000:]
    _LOG.error("scoring process crashed", status=status, output=output)
    return Outcome(reason=f"the scoring process exited with status {status} without a result")
