"""Limits of the leaderboard's client: redirects, time, size, and what it sends."""

from __future__ import annotations

import os
import re
import time
from io import BufferedIOBase
from pathlib import Path

import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.remote import leaderboard_client
from rebar_depth_bench.remote.leaderboard_client import AnswerError, LeaderboardClient, ServiceError
from tests.leaderboard.client.requests import TOKEN, check_refused, submission, submit
from tests.leaderboard.client.scripted_server import ID, ScriptedServer, Send, answer, scripted_server


@pytest.mark.parametrize("status", [300, 301, 302, 303, 307, 308])
@pytest.mark.parametrize("endpoint", ["token", "submit", "status", "result"])
def test_redirect_is_not_followed(
    endpoint: str, status: int, server: ScriptedServer, archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaderboard_client, "MAX_FAILED_POLLS", 0)
    with scripted_server() as other:
        other.answers = dict(server.answers)
        server.answers[endpoint] = [answer(b"", status, {"Location": f"{other.url}/api/v1/token"})]
        assert submit(server, archive) == 1
        assert other.requests == []


def test_token_is_sent_to_the_leaderboard_only(server: ScriptedServer, archive: Path) -> None:
    assert submit(server, archive) == 0
    assert all(f"Bearer {TOKEN}" in head for _, head in server.requests)
    assert all(re.search("accept-encoding: identity", head, re.IGNORECASE) for _, head in server.requests)


def endless(prefix: bytes, chunk: bytes, pause_s: float = 0.0) -> Send:
    """Return an answer that never ends: ``prefix`` and then ``chunk`` again and again."""

    def send(stream: BufferedIOBase) -> None:
        stream.write(prefix)
        while True:
            stream.write(chunk)
            stream.flush()
            time.sleep(pause_s)

    return send


def silent(stream: BufferedIOBase) -> None:
    time.sleep(60)


HEAD = b"HTTP/1.1 200 OK\r\n"
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n"
ENDLESS: dict[str, Send] = {
    "body": endless(HEAD + b"Content-Length: 10000000000\r\n\r\n", b"[" * 65536),
    "body without length": endless(HEAD + b"\r\n", b" " * 65536),
    "chunks": endless(CHUNKED, b"10000\r\n" + b" " * 65536 + b"\r\n"),
    "small chunks": endless(CHUNKED, b"1\r\n \r\n" * 1000),
    "headers": endless(HEAD, b"X: y\r\n" * 1000),
    "early answers": endless(b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 100),
    "slow body": endless(HEAD + b"Content-Length: 1000\r\n\r\n", b" ", 0.1),
    "slow headers": endless(HEAD, b"X", 0.1),
    "slow chunks": endless(CHUNKED, b"1\r\n \r\n", 0.1),
    "nothing": silent,
}


ENDLESS_CASES = [
    *(("token", kind) for kind in ENDLESS),
    *((endpoint, kind) for endpoint in ("submit", "status", "result") for kind in ("chunks", "slow headers")),
]


@pytest.mark.slow
@pytest.mark.parametrize(("endpoint", "kind"), ENDLESS_CASES)
def test_endless_answer_ends_with_an_error(
    endpoint: str,
    kind: str,
    server: ScriptedServer,
    archive: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("REQUEST_TIMEOUT_S", "RESULT_TIMEOUT_S", "UPLOAD_TIMEOUT_S"):
        monkeypatch.setattr(leaderboard_client, name, 0.8)
    monkeypatch.setattr(leaderboard_client, "MAX_FAILED_POLLS", 1)
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", "10000000")
    server.answers[endpoint] = [ENDLESS[kind]]
    message = check_refused(server, archive, tmp_path, capsys)
    assert re.search("time limit|too large|no response", message)


def test_unknown_states_are_asked_once_and_failures_again(
    server: ScriptedServer, archive: Path, tmp_path: Path
) -> None:
    """A proxy may fail for a while; a leaderboard that answers with an unknown status will do so again."""
    good = submission(archive)
    failures = [answer(b"<html>", 502), answer(b"<html>"), b"", answer({"detail": "slow down"}, 429)]
    server.answers["status"] = [*failures, answer(good), answer({**good, "status": "scored"})]
    assert submit(server, archive) == 0
    assert server.endpoints().count("status") == len(failures) + 2
    server.answers["status"] = [answer({**good, "status": "paused"})]
    with LeaderboardClient(server.url, TOKEN) as client, pytest.raises(AnswerError, match="paused"):
        client.wait(ID)


@pytest.mark.parametrize("status", ["queued", "scoring"])
def test_wait_ends_after_its_limit(
    status: str, server: ScriptedServer, archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.answers["status"] = [answer(submission(archive, status=status))]
    start = time.monotonic()
    assert submit(server, archive, "--wait", "0.5", "--json", str(tmp_path / "r.json")) == 1
    assert 0.5 <= time.monotonic() - start < 10
    message = capsys.readouterr().err.splitlines()[-1]
    assert f"{server.url}/submissions/{ID}" in message
    assert f"still {status}" in message
    assert not (tmp_path / "r.json").exists()


def test_wait_limit_holds_for_a_request(server: ScriptedServer, archive: Path) -> None:
    server.answers["status"] = [silent]
    start = time.monotonic()
    assert submit(server, archive, "--wait", "0.5") == 1
    assert time.monotonic() - start < 10


@pytest.mark.parametrize(
    "options",
    [("--wait", "5", "--no-wait"), ("--wait", "0"), ("--wait", "-1"), ("--wait", "x"), ("--wait", "nan")],
)
def test_invalid_wait_exits_2(options: tuple[str, ...], archive: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["submit", str(archive), "--url", "http://127.0.0.1:9", *options])
    assert caught.value.code == 2


@pytest.mark.parametrize("submission_id", ["../token", "a/b", "", "a?b", "\x1b", "a" * 200])
def test_id_that_is_no_part_of_a_url_is_refused(submission_id: str, server: ScriptedServer) -> None:
    with LeaderboardClient(server.url, TOKEN) as client:
        for call in (client.wait, client.result):
            with pytest.raises(InputError, match="is not the id of a submission"):
                call(submission_id)
    assert server.requests == []


@pytest.mark.parametrize("token", ["ä", "a\nb", "a\x1b", "\ud800"])
def test_token_that_is_no_header_is_refused(token: str) -> None:
    with pytest.raises(InputError, match="printable ASCII"):
        LeaderboardClient("http://127.0.0.1:9", token)


def test_archive_that_is_no_file_is_refused(
    server: ScriptedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe.zip")
    for path in (tmp_path / "pipe.zip", tmp_path, Path("/dev/zero")):
        assert submit(server, path) == 2
        assert "cannot be read" in capsys.readouterr().err
    assert server.endpoints() == ["token"] * 3


def test_result_of_another_archive_is_refused_by_library(
    server: ScriptedServer, archive: Path, result_json: bytes
) -> None:
    with LeaderboardClient(server.url, TOKEN) as client:
        accepted = client.submit(archive)
        assert client.result(accepted.id, accepted.archive_sha256)[1] == result_json
        with pytest.raises(ServiceError, match="is of the archive"):
            client.result(accepted.id, "0" * 64)
