"""A leaderboard with hundreds of scored rows, and its real server in a process of its own."""

from __future__ import annotations

import json
import os
import random
import re
import secrets
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.jobs import Outcome
from leaderboard.db.models import SubmissionRecord, TokenRecord
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, Upload
from leaderboard.db.tokens import create_token, find_token
from rebar_depth_bench.submission import SubmissionMeta

START_S = 120.0
WITHOUT_LIMIT = 1_000_000_000
_ERRORS = ("abs_rel", "rmse_cm", "mae_cm")


@dataclass(frozen=True)
class Served:
    """A server that runs: where it listens, and its process id."""

    host: str
    port: int
    pid: int

    def megabytes(self) -> float:
        """Return the resident memory of the server's own process (Linux)."""
        found = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{self.pid}/status").read_text())
        assert found is not None
        return int(found[1]) / 1024

    def cpu_s(self) -> float:
        """Return the processor seconds that the server's own process has taken (Linux)."""
        after_name = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


def fill(database: Database, result_json: bytes, rows: int, seed: int) -> list[str]:
    """Write ``rows`` scored submissions as a scorer does, errors varied; return their ids."""
    rng = random.Random(seed)
    token = _new_token(database)[1]
    ids, digest = [], json.loads(result_json)["dataset"]["digest"]
    for number in range(rows):
        submission_id = submissions.new_id()
        method = f"method {number:04d}"
        meta = SubmissionMeta(method, url="https://example.org/method" if number % 2 else None)
        upload = Upload(meta, secrets.token_hex(32), 1, digest)
        submissions.accept(database, submission_id, token, upload, WITHOUT_LIMIT, True)
        jobs.claim(database, "filler", 60.0)
        result = varied(json.loads(result_json), rng.uniform(0.2, 5.0))
        result["submission"]["method"] = method
        jobs.finish(database, submission_id, "filler", Outcome(json.dumps(result).encode()))
        ids.append(submission_id)
    return ids


def varied(part: Any, factor: float, name: str = "") -> Any:
    """Return a part of a result with every error in it times ``factor``, its intervals too."""
    if isinstance(part, dict):
        return {key: varied(value, factor, key) for key, value in part.items()}
    if isinstance(part, list):
        return [varied(value, factor, name) for value in part]
    return part * factor if name in _ERRORS and isinstance(part, float) else part


def new_tokens(database: Database, count: int) -> list[str]:
    """Make tokens of names that nobody has."""
    return [_new_token(database)[0] for _ in range(count)]


def _new_token(database: Database) -> tuple[str, TokenRecord]:
    token = create_token(database, f"benchmark {secrets.token_hex(4)}")
    record = find_token(database, token)
    assert record is not None
    return token, record


def count(database: Database, *statuses: str) -> int:
    """Return how many submissions have one of the statuses; any, where none is named."""
    query = select(func.count()).select_from(SubmissionRecord)
    with database.read() as session:
        return session.scalar(query.where(SubmissionRecord.status.in_(statuses)) if statuses else query) or 0


def empty_queue(database: Database) -> int:
    """Delete what waits, let what is being scored come to its end; return how many were deleted."""
    with database.read() as session:
        waiting = session.scalars(select(SubmissionRecord.id).where(SubmissionRecord.status == QUEUED)).all()
    for submission_id in waiting:
        submissions.remove(database, submission_id)
    while count(database, SCORING):
        time.sleep(0.2)
    return len(waiting)


def drop_newer(database: Database, kept: Sequence[str]) -> None:
    """Delete scored submissions that are not among ``kept``, so that the board is as long as before."""
    with database.read() as session:
        scored = session.scalars(select(SubmissionRecord.id).where(SubmissionRecord.status == SCORED)).all()
    for submission_id in set(scored) - set(kept):
        submissions.remove(database, submission_id)


@contextmanager
def running_server(data: Path, state: Path, db: str, scorers: int) -> Iterator[Served]:
    """Run ``rebar-leaderboard serve`` on a free port, its limits on requests and uploads out of the way."""
    limits = ["--reads", f"{WITHOUT_LIMIT}/minute", "--writes", f"{WITHOUT_LIMIT}/minute"]
    options = ["--quota", str(WITHOUT_LIMIT), "--scorers", str(scorers), "--port", "0", *limits]
    command = [sys.executable, "-m", "leaderboard", "serve", "--data", str(data), "--state", str(state)]
    log = state / "log"
    with log.open("w") as stream:
        process = subprocess.Popen([*command, *options, *(["--db", db] if db else [])], stderr=stream)
        try:
            host, port = _address(process, log)
            yield Served(host, port, process.pid)
        finally:
            process.terminate()
            process.wait()


def _address(process: subprocess.Popen[bytes], log: Path) -> tuple[str, int]:
    limit = time.monotonic() + START_S
    while time.monotonic() < limit and process.poll() is None:
        if found := re.search(r"^http://(\S+):(\d+)$", log.read_text(), re.MULTILINE):
            return found[1], int(found[2])
        time.sleep(0.05)
    raise RuntimeError(f"the server did not start within {START_S} s:\n{log.read_text()}")
