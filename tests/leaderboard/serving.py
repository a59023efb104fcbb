"""Leaderboard server and scorer for tests: the real commands in separate processes."""

from __future__ import annotations

import itertools
import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

from leaderboard.db.engine import Database
from leaderboard.db.tokens import create_token
from leaderboard.settings import read_settings

START_S = 120.0
_COPIES = itertools.count(1000)
ENDED = ("scored", "failed")
SCORING = b"multiprocessing.spawn"
"""Part of the command line of the process that reads one archive."""


@dataclass
class Server:
    """Running server: URL, process, state folder and the lines it has logged."""

    url: str
    process: subprocess.Popen[str]
    state: Path
    db: str = ""
    log: list[str] = field(default_factory=list)

    def token(self, name: str) -> str:
        """Create a token with the command line."""
        return make_token(self.state, name, self.db)

    def submit(self, archive: Path, token: str) -> httpx2.Response:
        """Upload an archive through the API."""
        with archive.open("rb") as stream:
            return httpx2.post(
                f"{self.url}/api/v1/submissions",
                files={"archive": (archive.name, stream, "application/zip")},
                headers={"Authorization": f"Bearer {token}"},
                timeout=120,
            )

    def submit_accepted(self, archive: Path, token: str) -> str:
        """Upload a valid archive and return the id of the new submission.

        If the token has sent it before, a copy with another SHA-256 is sent.
        """
        response = self.submit(archive, token)
        if response.status_code == 200:
            response = self.submit(distinct_archive(archive, next(_COPIES)), token)
        assert response.status_code == 202, response.text
        return str(response.json()["id"])

    def wait_until_ended(self, submission_id: str, timeout_s: float = 120) -> dict[str, Any]:
        """Wait until a submission is scored or failed, and return its JSON."""
        deadline = time.monotonic() + timeout_s
        while True:
            response = httpx2.get(f"{self.url}/api/v1/submissions/{submission_id}", timeout=30)
            assert response.status_code == 200, "\n".join([response.text, *self.log[-60:]])
            submission = response.json()
            if submission["status"] in ENDED:
                return dict(submission)
            assert time.monotonic() < deadline, (
                f"still {submission['status']} after {timeout_s} s: {self.log[-5:]}"
            )
            time.sleep(0.2)


def free_port() -> int:
    """Return a port of 127.0.0.1 that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def distinct_archive(archive: Path, number: int) -> Path:
    """Return a copy of an archive with another SHA-256, beside it: its runtime is ``number`` seconds."""
    copy = archive.with_name(f"{archive.stem}-{number}.zip")
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "submission.json":
                content = json.dumps({**json.loads(content), "runtime": number}).encode()
            target.writestr(name, content)
    return copy


RunServer = Callable[..., AbstractContextManager[Server]]
RunScorer = Callable[[Path, Path], AbstractContextManager[list[str]]]
"""Types of the functions that the fixtures ``running_server`` and ``running_scorer`` return."""


def make_token(state: Path, name: str, db: str = "") -> str:
    """Create a token as ``rebar-leaderboard token`` does, in this process; no server needs to run."""
    state.mkdir(mode=0o700, parents=True, exist_ok=True)
    settings = read_settings(None, {"data": "", "state_dir": state, "db": db})
    with closing(Database(settings.database_url)) as database:
        database.migrate()
        return create_token(database, name)


def submission_row(state: Path, submission_id: str) -> dict[str, Any]:
    """Return the columns of a submission in the SQLite database of a state folder."""
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection:
        connection.row_factory = sqlite3.Row
        query = "SELECT * FROM submissions WHERE id = ?"
        return dict(connection.execute(query, (submission_id,)).fetchone())


@contextmanager
def running_server(
    root: Path, state: Path, *, environment: Mapping[str, str] | None = None, **settings: object
) -> Iterator[Server]:
    """Run ``rebar-leaderboard serve`` on a free port until the block ends; ``settings`` are its options.

    The process leads its own process group, so that its child processes can be killed with it.
    """
    options = [part for name, value in settings.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    arguments = ["serve", "--data", str(root), "--state-dir", str(state), "--port", "0", *options]
    with _running_command(arguments, environment or {}) as (process, log):
        yield Server(_address(process, log), process, state, str(settings.get("db", "")), log)


@contextmanager
def running_scorer(root: Path, state: Path) -> Iterator[list[str]]:
    """Run ``rebar-leaderboard score`` until the block ends; yield its log lines."""
    with _running_command(
        ["score", "--data", str(root), "--state-dir", str(state), "--lease-seconds", "2"], {}
    ) as (_, log):
        yield log


@contextmanager
def _running_command(
    arguments: Sequence[str], environment: Mapping[str, str]
) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """Run a command until the block ends; yield its process and a growing list of its log lines."""
    command = [*_COMMAND, *arguments]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, start_new_session=True, env=_environment(environment)
    )
    log: list[str] = []
    reader = threading.Thread(target=_collect, args=(process, log), daemon=True)
    reader.start()
    try:
        yield process, log
    finally:
        _stop(process)
        reader.join(10)
        assert process.stderr is not None
        process.stderr.close()


_COMMAND = [sys.executable, "-m", "leaderboard"]


def _environment(extra: Mapping[str, str]) -> dict[str, str]:
    return {**os.environ, "PYTHONWARNINGS": "default", **extra}


def _collect(process: subprocess.Popen[str], log: list[str]) -> None:
    assert process.stderr is not None
    log.extend(line.rstrip("\n") for line in process.stderr)  # Extends line by line.


def _address(process: subprocess.Popen[str], log: list[str]) -> str:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        for line in list(log):
            if match := re.match(r"http://\S+", line):
                return match[0]
        assert process.poll() is None, "\n".join(log)
        time.sleep(0.05)
    raise AssertionError(f"no address after {START_S} s: {log}")


def _stop(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(10)
