"""Leaderboard fixture: a database with many scored submissions, and the real server in a separate process."""

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

from sqlalchemy import func, select

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, Quota, Upload
from leaderboard.db.tokens import create_token, find_token
from leaderboard.scoring.sandbox import Outcome
from rebar_depth_bench.submission import SubmissionMeta
from tests.synthetic_dataset import scale_errors

START_S = 120.0
WITHOUT_LIMIT = 1_000_000_000


@dataclass(frozen=True)
class ServerProcess:
    """Running leaderboard server: host, port and process id."""

    host: str
    port: int
    pid: int

    def megabytes(self) -> float:
        """Return the resident memory of the server process in MB (Linux only)."""
        match = re.search(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{self.pid}/status").read_text())
        assert match is not None
        return int(match[1]) / 1024

    def cpu_s(self) -> float:
        """Return the user and system CPU seconds of the server process (Linux only)."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def add_scored_submissions(database: Database, result_json: bytes, rows: int, seed: int) -> list[str]:
    """Add ``rows`` scored submissions with varied errors, in the way a scoring worker does; return their ids."""
    rng = random.Random(seed)
    token = _new_token(database)[1]
    ids, digest = [], json.loads(result_json)["dataset"]["digest"]
    for number in range(rows):
        submission_id = submissions.new_id()
        method = f"method {number:04d}"
        meta = SubmissionMeta(method=method, url="https://example.org/method" if number % 2 else None)
        upload = Upload(meta, secrets.token_hex(32), 1, digest)
        submissions.accept(database, submission_id, token, upload, Quota(WITHOUT_LIMIT, WITHOUT_LIMIT), True)
        jobs.claim(database, "filler", 60.0)
        result = scale_errors(json.loads(result_json), rng.uniform(0.2, 5.0))
        result["submission"]["method"] = method
        jobs.finish(database, submission_id, "filler", Outcome(json.dumps(result).encode()))
        ids.append(submission_id)
    return ids


def new_tokens(database: Database, count: int) -> list[str]:
    """Create ``count`` tokens with random names and return them."""
    return [_new_token(database)[0] for _ in range(count)]


def _new_token(database: Database) -> tuple[str, TokenModel]:
    token = create_token(database, f"benchmark {secrets.token_hex(4)}")
    record = find_token(database, token)
    assert record is not None
    return token, record


def count_submissions(database: Database, *statuses: str) -> int:
    """Return the number of submissions with one of the statuses, or of all submissions if none is given."""
    query = select(func.count()).select_from(SubmissionModel)
    with database.read() as session:
        return session.scalar(query.where(SubmissionModel.status.in_(statuses)) if statuses else query) or 0


def clear_queue(database: Database) -> int:
    """Delete queued submissions and wait until running ones are finished; return the number of deleted ones."""
    with database.read() as session:
        waiting = session.scalars(select(SubmissionModel.id).where(SubmissionModel.status == QUEUED)).all()
    for submission_id in waiting:
        submissions.remove(database, submission_id)
    while count_submissions(database, SCORING):
        time.sleep(0.2)
    return len(waiting)


def remove_scored_except(database: Database, ids_to_keep: Sequence[str]) -> None:
    """Delete the scored submissions that are not in ``ids_to_keep``, which restores the leaderboard's length."""
    with database.read() as session:
        scored = session.scalars(select(SubmissionModel.id).where(SubmissionModel.status == SCORED)).all()
    for submission_id in set(scored) - set(ids_to_keep):
        submissions.remove(database, submission_id)


@contextmanager
def running_server(data: Path, state: Path, db: str, scorers: int) -> Iterator[ServerProcess]:
    """Run ``rebar-leaderboard serve`` on a free port with rate limits and quota too high to take effect."""
    limits = ["--quota-bytes", "1TiB", "--max-connections-per-address", "0"]
    limits += ["--read-rate-limit", f"{WITHOUT_LIMIT}/minute", "--write-rate-limit", f"{WITHOUT_LIMIT}/minute"]
    options = [
        "--quota",
        str(WITHOUT_LIMIT),
        "--workers",
        str(scorers),
        "--port",
        "0",
        *limits,
        "--quota-bytes",
        "1TiB",
    ]
    command = [sys.executable, "-m", "leaderboard", "serve", "--data", str(data), "--state-dir", str(state)]
    log = state / "log"
    with log.open("w") as stream:
        process = subprocess.Popen([*command, *options, *(["--db", db] if db else [])], stderr=stream)
        try:
            host, port = _wait_for_address(process, log)
            yield ServerProcess(host, port, process.pid)
        finally:
            process.terminate()
            process.wait()


def _wait_for_address(process: subprocess.Popen[bytes], log: Path) -> tuple[str, int]:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline and process.poll() is None:
        if match := re.search(r"^http://(\S+):(\d+)$", log.read_text(), re.MULTILINE):
            return match[1], int(match[2])
        time.sleep(0.05)
    raise RuntimeError(f"the server did not start within {START_S} s:\n{log.read_text()}")
