"""``rebar-bench submit`` against a real server."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.errors import InputError, SubmissionError
from rebar_depth_bench.leaderboard_client import Leaderboard, ServiceError
from tests.leaderboard.conftest import Shared, Write
from tests.leaderboard.serving import Server, running_server

TOKEN = "REBAR_LEADERBOARD_TOKEN"


def run(*arguments: str | Path, token: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != TOKEN}
    command = [sys.executable, "-m", "rebar_depth_bench", *map(str, arguments)]
    return subprocess.run(
        command,
        env={**environment, "COLUMNS": "200", **({} if token is None else {TOKEN: token})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.fixture(scope="module")
def strict(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that takes one small archive a day of a token, and scores none in time."""
    settings: dict[str, Any] = {"quota": 1, "max_upload": 2_000_000, "score_time": 0.01}
    with running_server(tiny_root, tmp_path_factory.mktemp("strict") / "state", **settings) as server:
        yield server


def test_submit_prints_the_table_that_score_prints(
    board: Shared, tiny_root: Path, write_archive: Write, tmp_path: Path
) -> None:
    archive = write_archive("by command", 1.3)
    sent = run("submit", archive, "--url", f"{board.url}/", "--json", tmp_path / "sent.json", token=board.token)
    assert sent.returncode == 0, sent.stderr
    own = run("score", archive, "--data", tiny_root, "--json", tmp_path / "own.json")
    assert sent.stdout == own.stdout
    assert "by command" in sent.stdout
    assert (tmp_path / "sent.json").read_bytes() == (tmp_path / "own.json").read_bytes()
    lines = sent.stderr.splitlines()
    size = archive.stat().st_size
    assert f"uploading: {size} of {size}" in lines
    assert any(line.startswith(f"{board.url}/submissions/") for line in lines)
    assert board.token not in sent.stderr + sent.stdout


def test_without_waiting_the_id_is_printed(board: Shared, write_archive: Write, tmp_path: Path) -> None:
    (tmp_path / "token").write_text(f"{board.token}\n")
    archive = write_archive("impatient", configs=("lattice-orbit",))
    sent = run("submit", archive, "--url", board.url, "--token-file", tmp_path / "token", "--no-wait")
    assert sent.returncode == 0, sent.stderr
    assert board.server.ended(sent.stdout.strip())["method"] == "impatient"


def test_a_refused_archive_is_told_as_check_tells_it(board: Shared, tiny_root: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip")
    sent = run("submit", broken, "--url", board.url, token=board.token)
    own = run("check", broken, "--data", tiny_root)
    assert (sent.returncode, own.returncode) == (2, 2)
    reasons = [line.removeprefix("error: ") for line in own.stderr.splitlines() if "zip" in line]
    assert reasons
    assert reasons[-1].rpartition("broken.zip: ")[2] in sent.stderr


@pytest.mark.parametrize(
    ("token", "words"),
    [(None, f"no token: set {TOKEN}, or give --token-file FILE"), ("rdb_wrong", "the token is unknown")],
)
def test_a_token_that_is_missing_or_wrong(
    board: Shared, write_archive: Write, token: str | None, words: str
) -> None:
    sent = run("submit", write_archive("x"), "--url", board.url, token=token)
    assert sent.returncode == 2
    assert words in sent.stderr
    assert "Traceback" not in sent.stderr


@pytest.mark.parametrize(
    ("url", "status"),
    [("http://127.0.0.1:9", 1), ("localhost:80", 2), ("no address", 2), ("ftp://127.0.0.1/", 2), ("http://[", 1)],
)
def test_a_service_that_is_not_there(write_archive: Write, url: str, status: int) -> None:
    sent = run("submit", write_archive("x"), "--url", url, token="rdb_x")
    assert sent.returncode == status
    assert sent.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in sent.stderr


@pytest.mark.parametrize(("path", "token"), [("", "rdb_wrong"), ("/nope", None)])
def test_what_is_wrong_is_told_before_anything_is_sent(
    board: Shared, write_archive: Write, path: str, token: str | None
) -> None:
    sent = run("submit", write_archive("x"), "--url", f"{board.url}{path}", token=token or board.token)
    assert sent.returncode == 2
    assert "uploading" not in sent.stderr


def test_what_fails_says_why_and_the_quota_is_told(strict: Server, write_archive: Write) -> None:
    token = strict.token("alice")
    small = write_archive("small", configs=("lattice-orbit",))
    failed = run("submit", small, "--url", strict.url, token=token)
    assert failed.returncode == 2
    assert "scoring failed: scoring took longer than the 0.01 s this service allows" in failed.stderr
    again = run("submit", small, "--url", strict.url, token=token)
    assert again.returncode == 2
    assert "this token has made its 1 submissions of today (UTC)" in again.stderr


def test_an_archive_that_is_too_large_is_told(strict: Server, tmp_path: Path) -> None:
    large = tmp_path / "large.zip"
    large.write_bytes(bytes(2_200_000))
    with (
        Leaderboard(strict.url, strict.token("bob")) as leaderboard,
        pytest.raises(InputError, match="larger than 2000000"),
    ):
        leaderboard.submit(large)


def test_the_library_raises_what_the_command_says(board: Shared, tmp_path: Path) -> None:
    with Leaderboard(board.url, board.token) as leaderboard:
        with pytest.raises(InputError, match="cannot be read"):
            leaderboard.submit(tmp_path / "missing.zip")
        (tmp_path / "broken.zip").write_bytes(b"x")
        with pytest.raises(SubmissionError) as refused:
            leaderboard.submit(tmp_path / "broken.zip")
        assert refused.value.problems
        with pytest.raises(ServiceError, match="answered 404"):
            leaderboard.result("nope")
        found = json.loads(leaderboard.result(board.ids["good"]))
        assert found["submission"]["method"] == "good"
    with Leaderboard("http://127.0.0.1:9", "x") as nobody, pytest.raises(ServiceError, match="no answer"):
        nobody.result("x")
