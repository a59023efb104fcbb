"""``rebar-bench submit`` against a real server, and its limits: redirects, time, size, and what it sends."""

from __future__ import annotations

import json
import os
import re
import socket
import time
from importlib.util import find_spec
from io import BufferedIOBase
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench import SubmissionWriter
from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.cli.submit import read_token
from rebar_depth_bench.remote import leaderboard_client
from rebar_depth_bench.remote.leaderboard_client import AnswerError, LeaderboardClient, ServiceError
from tests.leaderboard.conftest import Refused, SharedServer, WriteArchive
from tests.leaderboard.scripted_server import (
    ID,
    TOKEN,
    TOKEN_INFO,
    ScriptedServer,
    Send,
    answer,
    scripted_server,
    submission,
)
from tests.leaderboard.serving import run_bench

TOKEN_VARIABLE = "REBAR_LEADERBOARD_TOKEN"


def test_submit_prints_same_table_as_score(
    board: SharedServer, tiny_root: Path, write_archive: WriteArchive, tmp_path: Path
) -> None:
    archive = write_archive("by command", 1.3)
    submitted = run_bench(
        "submit", archive, "--url", f"{board.url}/", "--json", tmp_path / "sent.json", token=board.token
    )
    assert submitted.returncode == 0, submitted.stderr
    scored = run_bench("score", archive, "--data", tiny_root, "--json", tmp_path / "own.json")
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
    submitted = run_bench("submit", archive, "--url", board.url, "--token-file", tmp_path / "token", "--no-wait")
    assert submitted.returncode == 0, submitted.stderr
    assert board.server.wait_until_ended(submitted.stdout.strip())["method"] == "impatient"


def test_rejected_archive_has_same_message_as_check(board: SharedServer, tiny_root: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip")
    submitted = run_bench("submit", broken, "--url", board.url, token=board.token)
    checked = run_bench("check", broken, "--data", tiny_root)
    assert (submitted.returncode, checked.returncode) == (2, 2)
    reasons = [line.removeprefix("error: ") for line in checked.stderr.splitlines() if "zip" in line]
    assert reasons
    assert reasons[-1].rpartition("broken.zip: ")[2] in submitted.stderr


@pytest.mark.parametrize(
    ("path", "token", "words"),
    [
        ("", None, f"no token: set {TOKEN_VARIABLE}, or give --token-file FILE"),
        ("", "rdb_wrong", "the token is unknown"),
        ("/nope", "rdb_wrong", "Not Found"),
    ],
)
def test_wrong_token_or_url_is_reported_before_upload(
    board: SharedServer, small_archive: Path, path: str, token: str | None, words: str
) -> None:
    process = run_bench("submit", small_archive, "--url", f"{board.url}{path}", token=token)
    assert process.returncode == 2
    assert words in process.stderr
    assert "uploading" not in process.stderr


def test_token_file_of_windows_is_read(tmp_path: Path) -> None:
    """Set-Content -Encoding utf8 of PowerShell 5.1 begins a file with a byte order mark."""
    (tmp_path / "token").write_bytes(b"\xef\xbb\xbfrdb_x\r\n")
    assert read_token(str(tmp_path / "token")) == "rdb_x"


@pytest.mark.parametrize("content", [b"", b" \n", b"\x1b[2J", "rdb_x".encode("utf-16")])
def test_token_file_without_a_token_exits_2(tmp_path: Path, content: bytes) -> None:
    token = tmp_path / "token"
    token.write_bytes(content)
    process = run_bench("submit", tmp_path / "a.zip", "--url", "http://127.0.0.1:9", "--token-file", token)
    assert process.returncode == 2
    assert f"{token}: " in process.stderr


@pytest.mark.parametrize(
    ("url", "status"),
    [("http://127.0.0.1:9", 1), ("localhost:80", 2), ("no address", 2), ("ftp://127.0.0.1/", 2), ("http://[", 1)],
)
def test_unreachable_service_or_invalid_url_is_reported(small_archive: Path, url: str, status: int) -> None:
    process = run_bench("submit", small_archive, "--url", url, token="rdb_x")
    assert process.returncode == status
    assert process.stderr.splitlines()[-1].startswith("error: ")


PROXIES = [
    name for proxy in ("http_proxy", "https_proxy", "all_proxy", "no_proxy") for name in (proxy, proxy.upper())
]
CERTIFICATES = ("SSL_CERT_FILE", "SSL_CERT_DIR", "SSLKEYLOGFILE")


@pytest.fixture
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Remove what the environment says of proxies and certificates."""
    for name in (*PROXIES, *CERTIFICATES):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.mark.parametrize(
    ("name", "value", "shown", "remedy"),
    [
        pytest.param(
            "ALL_PROXY",
            "socks5://u:secret@127.0.0.1:9",
            "socks5://127.0.0.1:9",
            "httpx2[socks]",
            marks=pytest.mark.skipif(find_spec("socksio") is not None, reason="SOCKS is supported here"),
        ),
        ("HTTP_PROXY", "ftp://127.0.0.1:9", "ftp://127.0.0.1:9", "http://HOST:PORT"),
        ("https_proxy", "socks4://u:secret@[::1]:9", "socks4://[::1]:9", "NO_PROXY=*"),
        ("HTTP_PROXY", "http://[::1", "http://[::1", "http://HOST:PORT"),
        ("SSL_CERT_FILE", "/nowhere/ca.pem", "/nowhere/ca.pem", "No such file or directory"),
        ("SSL_CERT_FILE", __file__, __file__, "no certificate"),
        ("SSL_CERT_DIR", "/nowhere/certs", "/nowhere/certs", "no such folder"),
        ("SSLKEYLOGFILE", "/nowhere/keys", "/nowhere/keys", "No such file or directory"),
    ],
)
def test_unusable_variable_of_http_is_named(
    name: str, value: str, shown: str, remedy: str, small_archive: Path, no_proxy: pytest.MonkeyPatch
) -> None:
    no_proxy.setenv("SSL_CERT_DIR", str(small_archive.parent))  # SSLKEYLOGFILE is read with certificates only.
    no_proxy.setenv(name, value)
    process = run_bench("submit", small_archive, "--url", "http://127.0.0.1:9", token=TOKEN)
    assert process.returncode == 2
    [line] = process.stderr.splitlines()
    assert line.startswith(f"error: {name}={shown}: ")
    assert remedy in line
    assert "secret" not in line


def test_proxy_that_does_not_answer_is_named(
    scripted: ScriptedServer, small_archive: Path, no_proxy: pytest.MonkeyPatch
) -> None:
    """A local leaderboard is behind the proxy, too, unless NO_PROXY has its address."""
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        proxy = f"127.0.0.1:{unused.getsockname()[1]}"
        no_proxy.setenv("HTTP_PROXY", f"http://u:secret@{proxy}")
        process = run_bench("submit", small_archive, "--url", scripted.url, token=TOKEN)
        assert (process.returncode, scripted.requests) == (1, [])
        assert (
            f"through the proxy {proxy} (HTTP_PROXY=http://{proxy}; NO_PROXY=127.0.0.1 avoids it)"
            in process.stderr
        )
        assert "secret" not in process.stderr
        scripted.answers = {"token": [answer({}, 500)]}
        no_proxy.setenv("NO_PROXY", "127.0.0.1")
        process = run_bench("submit", small_archive, "--url", scripted.url, token=TOKEN)
    assert (process.returncode, scripted.endpoints()) == (1, ["token"])
    assert proxy not in process.stderr


def test_answer_of_a_proxy_names_it(
    scripted: ScriptedServer, small_archive: Path, no_proxy: pytest.MonkeyPatch
) -> None:
    no_proxy.setenv("all_proxy", scripted.url)
    scripted.answers = {"token": [answer(b"<html>no upstream</html>", 503)]}
    process = run_bench("submit", small_archive, "--url", "http://board.invalid", token=TOKEN)
    assert process.returncode == 1
    assert f"through the proxy {scripted.url.removeprefix('http://')} (all_proxy={scripted.url};" in process.stderr
    assert "the response status is 503" in process.stderr


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


@pytest.mark.parametrize("status", [300, 301, 302, 303, 307, 308])
@pytest.mark.parametrize("endpoint", ["token", "submit", "status", "result"])
def test_redirect_is_not_followed(
    endpoint: str, status: int, scripted: ScriptedServer, small_archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaderboard_client, "MAX_FAILED_POLLS", 0)
    with scripted_server() as other:
        other.answers = dict(scripted.answers)
        scripted.answers[endpoint] = [answer(b"", status, {"Location": f"{other.url}/api/v1/token"})]
        assert scripted.submit(small_archive) == 1
        assert other.requests == []


def test_too_large_archive_is_not_sent(scripted: ScriptedServer, small_archive: Path, refused: Refused) -> None:
    scripted.answers["token"] = [answer({**TOKEN_INFO, "max_upload_bytes": 2000})]
    assert f"has {small_archive.stat().st_size} bytes, expected at most 2000" in refused(2)
    assert scripted.endpoints() == ["token"]


def test_predictions_that_are_not_metric_are_not_sent(scripted: ScriptedServer, tmp_path: Path) -> None:
    archive = tmp_path / "relative.zip"
    with SubmissionWriter(archive, "net", prediction="affine-disparity") as writer:
        for number in range(2000):
            writer.add(f"lattice/{number:04d}", np.ones((2, 2), np.float32))
    with (
        LeaderboardClient(scripted.url, TOKEN) as client,
        pytest.raises(SubmissionError, match="affine-disparity"),
    ):
        client.submit(archive)
    assert scripted.requests == []


def test_token_is_sent_to_the_leaderboard_only(scripted: ScriptedServer, small_archive: Path) -> None:
    assert scripted.submit(small_archive) == 0
    assert all(f"Bearer {TOKEN}" in head for _, head in scripted.requests)
    assert all(re.search("accept-encoding: identity", head, re.IGNORECASE) for _, head in scripted.requests)


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
    endpoint: str, kind: str, scripted: ScriptedServer, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("REQUEST_TIMEOUT_S", "RESULT_TIMEOUT_S", "UPLOAD_TIMEOUT_S"):
        monkeypatch.setattr(leaderboard_client, name, 0.8)
    monkeypatch.setattr(leaderboard_client, "MAX_FAILED_POLLS", 1)
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", "10000000")
    scripted.answers[endpoint] = [ENDLESS[kind]]
    assert re.search("time limit|too large|no response", refused())


def test_unknown_states_are_asked_once_and_failures_again(scripted: ScriptedServer, small_archive: Path) -> None:
    """A proxy may fail for a while; a leaderboard that answers with an unknown status will do so again."""
    good = submission(small_archive)
    failures = [answer(b"<html>", 502), answer(b"<html>"), b"", answer({"detail": "slow down"}, 429)]
    scripted.answers["status"] = [*failures, answer(good), answer({**good, "status": "scored"})]
    assert scripted.submit(small_archive) == 0
    assert scripted.endpoints().count("status") == len(failures) + 2
    scripted.answers["status"] = [answer({**good, "status": "paused"})]
    with LeaderboardClient(scripted.url, TOKEN) as client, pytest.raises(AnswerError, match="paused"):
        client.wait(ID)


@pytest.mark.parametrize("status", ["queued", "scoring"])
def test_wait_ends_after_its_limit(
    status: str, scripted: ScriptedServer, small_archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scripted.answers["status"] = [answer(submission(small_archive, status=status))]
    start = time.monotonic()
    assert scripted.submit(small_archive, "--wait", "0.5", "--json", str(tmp_path / "r.json")) == 1
    assert 0.5 <= time.monotonic() - start < 10
    message = capsys.readouterr().err.splitlines()[-1]
    assert f"{scripted.url}/submissions/{ID}" in message
    assert f"still {status}" in message
    assert not (tmp_path / "r.json").exists()


def test_wait_limit_holds_for_a_request(scripted: ScriptedServer, small_archive: Path) -> None:
    scripted.answers["status"] = [silent]
    start = time.monotonic()
    assert scripted.submit(small_archive, "--wait", "0.5") == 1
    assert time.monotonic() - start < 10


@pytest.mark.parametrize(
    "options",
    [("--wait", "5", "--no-wait"), ("--wait", "0"), ("--wait", "-1"), ("--wait", "x"), ("--wait", "nan")],
)
def test_invalid_wait_exits_2(options: tuple[str, ...], small_archive: Path) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["submit", str(small_archive), "--url", "http://127.0.0.1:9", *options])
    assert caught.value.code == 2


@pytest.mark.parametrize("submission_id", ["../token", "a/b", "", "a?b", "\x1b", "a" * 200])
def test_id_that_is_no_part_of_a_url_is_refused(submission_id: str, scripted: ScriptedServer) -> None:
    with LeaderboardClient(scripted.url, TOKEN) as client:
        for call in (client.wait, client.result):
            with pytest.raises(InputError, match="is not the id of a submission"):
                call(submission_id)
    assert scripted.requests == []


@pytest.mark.parametrize("token", ["ä", "a\nb", "a\x1b", "\ud800"])
def test_token_that_is_no_header_is_refused(token: str) -> None:
    with pytest.raises(InputError, match="printable ASCII"):
        LeaderboardClient("http://127.0.0.1:9", token)


def test_archive_that_is_no_file_is_refused(
    scripted: ScriptedServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "pipe.zip")
    for path in (tmp_path / "pipe.zip", tmp_path, Path("/dev/zero")):
        assert scripted.submit(path) == 2
        assert "cannot be read" in capsys.readouterr().err
    assert scripted.endpoints() == ["token"] * 3


def test_result_of_another_archive_is_refused_by_library(
    scripted: ScriptedServer, small_archive: Path, small_result: bytes
) -> None:
    with LeaderboardClient(scripted.url, TOKEN) as client:
        accepted = client.submit(small_archive)
        assert client.result(accepted.id, accepted.archive_sha256)[1] == small_result
        with pytest.raises(ServiceError, match="is of the archive"):
            client.result(accepted.id, "0" * 64)
