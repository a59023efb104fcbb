"""What tests of a running service look at: its processes, its database, what comes true after a while."""

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
"""What stands on the command lines of a scorer and of the process in which it scores one archive."""


def wait_until(condition: Callable[[], object], what: str, within_s: float = 60.0) -> None:
    """Wait until ``condition`` holds."""
    limit = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < limit, f"not within {within_s} s: {what}"
        time.sleep(0.05)


def processes_below(pid: int, words: bytes) -> list[int]:
    """Return the processes that ``pid`` and its children started and that have ``words`` on their command line."""
    return [one for one in descendants(pid) if words in _command_line(one)]


def submission_row(state: Path, submission_id: str) -> dict[str, Any]:
    """Return a submission's columns as they stand in the SQLite database of a state folder."""
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection:
        connection.row_factory = sqlite3.Row
        query = "SELECT * FROM submissions WHERE id = ?"
        return dict(connection.execute(query, (submission_id,)).fetchone())


def _command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""  # it has just ended
