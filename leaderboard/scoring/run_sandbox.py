"""Runs of the sandbox process, with time and memory limits: checks of uploads and scoring of accepted archives."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import structlog

from leaderboard.db.jobs import Outcome, ViewPicture
from leaderboard.scoring.task import (
    META_FILE,
    NOTES_FILE,
    PICTURES_DIR,
    PROBLEMS_FILE,
    RESULT_FILE,
    UNAVAILABLE_FILE,
    SandboxTask,
)
from leaderboard.settings import Settings
from rebar_depth_bench.errors import Problem, problem_summary
from rebar_depth_bench.submission import SubmissionMeta

POLL_INTERVAL_S = 1.0
RENEWALS_PER_LEASE = 4
_OUTPUT_FILE = "output.txt"
_KILLED = (-signal.SIGKILL, -signal.SIGTERM)
_LOG = structlog.get_logger("sandbox")

Verdict = SubmissionMeta | tuple[Problem, ...]
"""The content of ``submission.json`` if the archive is valid, otherwise all problems."""


class UnavailableError(Exception):
    """Raised when checking or scoring is impossible for now: no process, or dataset or disk unusable."""


class TimeLimitError(Exception):
    """Raised when the sandbox process has reached its time limit."""


def check_archive(archive: Path, settings: Settings, spool: Path) -> Verdict:
    """Check an archive. Raises ``UnavailableError``."""
    task = SandboxTask("check", str(archive), settings.data, "", settings.score_memory, os.getpid())
    for _ in range(2):  # A process that was killed from outside says nothing about the archive.
        with _scratch(spool) as out:
            try:
                status = _run(replace(task, out=str(out)), settings.check_time, POLL_INTERVAL_S, lambda: True)
            except TimeLimitError:
                return (Problem("size", "", f"the check took longer than {settings.check_time:g} s"),)
            if (out / META_FILE).is_file() and status == 0:
                return SubmissionMeta.model_validate_json((out / META_FILE).read_bytes())
            if (out / PROBLEMS_FILE).is_file():
                return tuple(_read_problems(out))
            if status not in _KILLED:
                break
    return (Problem("damaged", "", "the archive cannot be read: the process that reads it crashed"),)


def score_archive(
    archive: Path, dataset_digest: str, settings: Settings, spool: Path, should_continue: Callable[[], bool]
) -> Outcome | None:
    """Score an archive; return None if ``should_continue`` returned False or the process was killed from outside.

    ``should_continue`` is called several times per lease. Raises ``UnavailableError``.
    """
    step_s = min(settings.lease_seconds / RENEWALS_PER_LEASE, POLL_INTERVAL_S)
    with _scratch(spool) as out:
        task = SandboxTask(
            "score",
            str(archive),
            settings.data,
            str(out),
            settings.score_memory,
            os.getpid(),
            dataset_digest,
            settings.error_maps,
            settings.hidden_truth,
        )
        try:
            status = _run(task, settings.score_time, step_s, should_continue)
        except TimeLimitError:
            return Outcome(reason=f"scoring took longer than the limit of {settings.score_time:g} s")
        if (out / RESULT_FILE).is_file() and status == 0:
            return _read_outcome(out)
        if (out / PROBLEMS_FILE).is_file():
            return Outcome(reason=problem_summary(_read_problems(out)))
        if status is None or status in _KILLED:
            return None
        return Outcome(reason=f"the scoring process exited with status {status} without a result")


def _run(task: SandboxTask, time_limit_s: float, step_s: float, should_continue: Callable[[], bool]) -> int | None:
    """Run the task and return the exit status of the process, or None if ``should_continue`` returned False.

    Raises ``TimeLimitError`` and ``UnavailableError``.
    """
    output_file = Path(task.out) / _OUTPUT_FILE
    deadline = time.monotonic() + time_limit_s
    command = [sys.executable, "-P", "-m", "leaderboard.scoring.sandbox"]
    with output_file.open("wb") as output:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output)
    try:
        assert process.stdin is not None
        with suppress(BrokenPipeError):
            process.stdin.write(task.to_json())
            process.stdin.close()
        while not _has_ended(process, min(step_s, max(0.0, deadline - time.monotonic()))):
            if time.monotonic() >= deadline:
                raise TimeLimitError
            if not should_continue():
                return None
    finally:
        process.kill()
        process.wait()
    unavailable = Path(task.out) / UNAVAILABLE_FILE
    if unavailable.is_file():
        raise UnavailableError(unavailable.read_text())
    if process.returncode not in (0, *_KILLED):
        text = output_file.read_text(errors="replace")[-2000:]
        _LOG.error("sandbox process crashed", action=task.action, status=process.returncode, output=text)
    return process.returncode


def _has_ended(process: subprocess.Popen[bytes], within_s: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        process.wait(within_s)
    return process.returncode is not None


@contextmanager
def _scratch(spool: Path) -> Iterator[Path]:
    """Yield a temporary folder. Raises ``UnavailableError`` for errors of the disk."""
    try:
        with tempfile.TemporaryDirectory(dir=spool) as folder:
            yield Path(folder)
    except OSError as error:
        raise UnavailableError(str(error)) from None


def _read_problems(out: Path) -> list[Problem]:
    return [Problem(**problem) for problem in _read_json(out / PROBLEMS_FILE)]


def _read_outcome(out: Path) -> Outcome:
    pictures = [_read_picture(path) for path in sorted((out / PICTURES_DIR).glob("*.json"))]
    return Outcome((out / RESULT_FILE).read_bytes(), _read_json(out / NOTES_FILE), pictures)


def _read_picture(path: Path) -> ViewPicture:
    facts = _read_json(path)
    images = {
        image.stem.rpartition("-")[2]: image.read_bytes() for image in path.parent.glob(f"{path.stem}-*.webp")
    }
    return ViewPicture(facts["view_id"], json.dumps(facts), images)


def _read_json(path: Path) -> Any:
    return json.loads(path.read_bytes())
