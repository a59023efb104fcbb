"""A leaderboard as it runs: the real command in a process of its own."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

START_S = 120.0
ENDED = ("scored", "failed")


@dataclass
class Server:
    """A server that runs: its address, its process, its folder, and the lines it has written."""

    url: str
    process: subprocess.Popen[str]
    state: Path
    db: str = ""
    log: list[str] = field(default_factory=list)

    def token(self, name: str) -> str:
        """Make a token as an operator does."""
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

    def accepted(self, archive: Path, token: str) -> str:
        """Upload an archive that is sound and return its id."""
        answer = self.submit(archive, token)
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def ended(self, submission_id: str, timeout_s: float = 120) -> dict[str, Any]:
        """Wait until a submission is scored or failed, and return it."""
        limit = time.monotonic() + timeout_s
        while True:
            answer = httpx2.get(f"{self.url}/api/v1/submissions/{submission_id}", timeout=30)
            assert answer.status_code == 200, "\n".join([answer.text, *self.log[-60:]])
            found = answer.json()
            if found["status"] in ENDED:
                return dict(found)
            assert time.monotonic() < limit, f"still {found['status']} after {timeout_s} s: {self.log[-5:]}"
            time.sleep(0.2)


def make_token(state: Path, name: str, db: str = "") -> str:
    """Make a token with ``rebar-leaderboard token``, whether a server runs or not."""
    command = [*_COMMAND, "token", name, "--state", str(state), *(["--db", db] if db else [])]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=_environment({})).stdout.strip()


@contextmanager
def running_server(
    root: Path, state: Path, *, environment: Mapping[str, str] | None = None, **settings: object
) -> Iterator[Server]:
    """Run ``rebar-leaderboard serve`` on a free port until the block ends; ``settings`` are its options.

    The process leads a group of its own, so that what it started ends with it whatever happens.
    """
    options = [part for name, value in settings.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    arguments = ["serve", "--data", str(root), "--state", str(state), "--port", "0", *options]
    with _started(arguments, environment or {}) as (process, log):
        yield Server(_address(process, log), process, state, str(settings.get("db", "")), log)


@contextmanager
def running_scorer(root: Path, state: Path) -> Iterator[list[str]]:
    """Run ``rebar-leaderboard score`` until the block ends; yield the lines that it writes."""
    with _started(["score", "--data", str(root), "--state", str(state), "--lease", "2"], {}) as (_, log):
        yield log


@contextmanager
def _started(
    arguments: Sequence[str], environment: Mapping[str, str]
) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """Run a command until the block ends; yield its process, and its lines as they come."""
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


def _environment(more: Mapping[str, str]) -> dict[str, str]:
    return {**os.environ, "PYTHONWARNINGS": "default", **more}


def _collect(process: subprocess.Popen[str], log: list[str]) -> None:
    assert process.stderr is not None
    log.extend(line.rstrip("\n") for line in process.stderr)  # seen line by line


def _address(process: subprocess.Popen[str], log: list[str]) -> str:
    limit = time.monotonic() + START_S
    while time.monotonic() < limit:
        for line in list(log):
            if found := re.match(r"http://\S+", line):
                return found[0]
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
