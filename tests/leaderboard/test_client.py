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

from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.remote.leaderboard_client import LeaderboardClient, ServiceError
from tests.leaderboard.conftest import SharedServer, WriteArchive
from tests.leaderboard.serving import RunServer, Server

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
def strict_server(tmp_path_factory: pytest.TempPathFactory, running_server: RunServer) -> Iterator[Server]:
    """Return a server with a quota of one, a small size limit and a scoring time limit that always expires."""
    settings: dict[str, Any] = {"quota": 1, "max_upload": 2_000_000, "score_time": 0.01}
    with running_server(tmp_path_factory.mktemp("strict") / "state", **settings) as server:
        yield server


def test_submit_prints_same_table_as_score(
    board: SharedServer, tiny_root: Path, write_archive: WriteArchive, tmp_path: Path
) -> None:
    archive = write_archive("by command", 1.3)
    submitted = run(
        "submit", archive, "--url", f"{board.url}/", "--json", tmp_path / "sent.json", token=board.token
    )
    assert submitted.returncode == 0, submitted.stderr
    scored = run("score", archive, "--data", tiny_root, "--json", tmp_path / "own.json")
    assert submitted.stdout == scored.stdout
    assert "by command" in submitted.stdout
    assert (tmp_path / "sent.json").read_bytes() == (tmp_path / "own.json").read_bytes()
    lines = submitted.stderr.splitlines()
    size = archive.stat().st_size
    assert f"uploading: {size} of {size}" in lines
    assert any(line.startswith(f"{board.url}/submissions/") for line in lines)
    assert board.token not in submitted.stderr + submitted.stdout


def test_no_wait_prints_submission_id(board: SharedServer, write_archive: WriteArchive, tmp_path: Path) -> None:
    (tmp_path / "token").write_text(f"{board.token}\n")
    archive = write_archive("impatient", configs=("lattice-orbit",))
    submitted = run("submit", archive, "--url", board.url, "--token-file", tmp_path / "token", "--no-wait")
    assert submitted.returncode == 0, submitted.stderr
    assert board.server.wait_until_ended(submitted.stdout.strip())["method"] == "impatient"


def test_rejected_archive_has_same_message_as_check(board: SharedServer, tiny_root: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip")
    submitted = run("submit", broken, "--url", board.url, token=board.token)
    checked = run("check", broken, "--data", tiny_root)
    assert (submitted.returncode, checked.returncode) == (2, 2)
    reasons = [line.removeprefix("error: ") for line in checked.stderr.splitlines() if "zip" in line]
    assert reasons
    assert reasons[-1].rpartition("broken.zip: ")[2] in submitted.stderr


@pytest.mark.parametrize(
    ("token", "words"),
    [(None, f"no token: set {TOKEN}, or give --token-file FILE"), ("rdb_wrong", "the token is unknown")],
)
def test_missing_or_unknown_token_exits_2(
    board: SharedServer, write_archive: WriteArchive, token: str | None, words: str
) -> None:
    process = run("submit", write_archive("x"), "--url", board.url, token=token)
    assert process.returncode == 2
    assert words in process.stderr
    assert "Traceback" not in process.stderr


@pytest.mark.parametrize("content", ["", " \n", "\x1b[2J"])
def test_token_file_without_a_token_exits_2(tmp_path: Path, content: str) -> None:
    token = tmp_path / "token"
    token.write_text(content)
    process = run("submit", tmp_path / "a.zip", "--url", "http://127.0.0.1:9", "--token-file", token)
    assert process.returncode == 2
    assert f"{token}: " in process.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("url", "status"),
    [("http://127.0.0.1:9", 1), ("localhost:80", 2), ("no address", 2), ("ftp://127.0.0.1/", 2), ("http://[", 1)],
)
def test_unreachable_service_or_invalid_url_is_reported(
    write_archive: WriteArchive, url: str, status: int
) -> None:
    process = run("submit", write_archive("x"), "--url", url, token="rdb_x")
    assert process.returncode == status
    assert process.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in process.stderr


@pytest.mark.parametrize(("path", "token"), [("", "rdb_wrong"), ("/nope", None)])
def test_wrong_token_or_url_is_reported_before_upload(
    board: SharedServer, write_archive: WriteArchive, path: str, token: str | None
) -> None:
    process = run("submit", write_archive("x"), "--url", f"{board.url}{path}", token=token or board.token)
    assert process.returncode == 2
    assert "uploading" not in process.stderr


def test_scoring_failure_and_exceeded_quota_are_reported(strict_server: Server, small_archive: Path) -> None:
    token = strict_server.token("alice")
    failed = run("submit", small_archive, "--url", strict_server.url, token=token)
    assert failed.returncode == 2
    assert "scoring failed: scoring took longer than the limit of 0.01 s" in failed.stderr
    over_quota = run("submit", small_archive, "--url", strict_server.url, token=token)
    assert over_quota.returncode == 2
    assert "the quota of 1 submissions per day (UTC) is used up" in over_quota.stderr


def test_too_large_archive_is_reported(strict_server: Server, tmp_path: Path) -> None:
    large = tmp_path / "large.zip"
    large.write_bytes(bytes(2_200_000))
    with (
        LeaderboardClient(strict_server.url, strict_server.token("bob")) as leaderboard,
        pytest.raises(InputError, match="expected at most 2000000"),
    ):
        leaderboard.submit(large)


def test_client_library_raises_errors_of_command(board: SharedServer, tmp_path: Path) -> None:
    with LeaderboardClient(board.url, board.token) as leaderboard:
        with pytest.raises(InputError, match="cannot be read"):
            leaderboard.submit(tmp_path / "missing.zip")
        (tmp_path / "broken.zip").write_bytes(b"x")
        with pytest.raises(SubmissionError) as raised:
            leaderboard.submit(tmp_path / "broken.zip")
        assert "the file is not a zip" in str(raised.value)
        assert raised.value.problems
        with pytest.raises(ServiceError, match="status for the result is 404"):
            leaderboard.result("nope")
        scored, scored_json = leaderboard.result(board.ids["good"])
        assert scored.submission.method == json.loads(scored_json)["submission"]["method"] == "good"
    with (
        LeaderboardClient("http://127.0.0.1:9", "x") as unreachable,
        pytest.raises(ServiceError, match="no response"),
    ):
        unreachable.result("x")
