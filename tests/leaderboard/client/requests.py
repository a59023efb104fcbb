"""Submission of an archive to a scripted server, and checks of a refused answer."""

from __future__ import annotations

import hashlib
import time
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.cli.main import main
from tests.leaderboard.client.scripted_server import ID, ScriptedServer

TOKEN = "rdb_secret-of-the-user"
MAX_SECONDS = 20.0
URL = f"https://example.org/submissions/{ID}"
ESCAPES = "\x1b]0;owned\x07\x1b[2J\u202e[red]\r\n"
TOKEN_INFO = {
    "name": "alice",
    "quota": 10,
    "quota_left": 9,
    "max_upload_bytes": 1 << 30,
    "read_rate_limit": "9/minute",
}


def submission(archive: Path, **changes: Any) -> dict[str, Any]:
    """Return the JSON of an accepted submission with some values changed; a value of ``...`` is left out."""
    sha256 = hashlib.sha256(archive.read_bytes()).hexdigest()
    values = {"id": ID, "status": "queued", "url": URL, "method": "m", "reason": None, "archive_sha256": sha256}
    return {key: value for key, value in {**values, **changes}.items() if value is not ...}


def submit(server: ScriptedServer, archive: Path, *options: str) -> int:
    return main(["submit", str(archive), "--url", server.url, *options])


def check_refused(
    server: ScriptedServer,
    archive: Path,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    status: int = 1,
) -> str:
    """Submit, and check the exit status and that nothing is written; return the message."""
    start = time.monotonic()
    assert submit(server, archive, "--json", str(folder / "r.json")) == status
    assert time.monotonic() - start < MAX_SECONDS
    assert list(folder.iterdir()) == []
    captured = capsys.readouterr()
    assert captured.out == ""
    assert all(line.isprintable() and len(line) < 3000 for line in captured.err.split("\n"))
    assert len(captured.err) < 30_000
    assert TOKEN not in captured.err
    return captured.err[captured.err.index("error: ") :]
