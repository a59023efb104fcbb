"""Helpers of tests of a running service: its processes, its database and polling of conditions."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from tests.leaderboard.processes import descendants

SCORER = b"leaderboard.scoring\0"
SCORING = b"leaderboard.scoring.sandbox"
"""Parts of the command lines of a scorer and of the process in which it scores one archive."""


def wait_until(condition: Callable[[], object], what: str, within_s: float = 60.0) -> None:
    """Wait until ``condition`` holds; fail after ``within_s`` seconds."""
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {within_s} s: {what}"
        time.sleep(0.05)


def processes_below(pid: int, text: bytes) -> list[int]:
    """Return the descendants of ``pid`` whose command line contains ``text``."""
    return [descendant for descendant in descendants(pid) if text in _command_line(descendant)]


def submission_row(state: Path, submission_id: str) -> dict[str, Any]:
    """Return the columns of a submission in the SQLite database of a state folder."""
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection:
        connection.row_factory = sqlite3.Row
        query = "SELECT * FROM submissions WHERE id = ?"
        return dict(connection.execute(query, (submission_id,)).fetchone())


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""  # The process has just ended.
