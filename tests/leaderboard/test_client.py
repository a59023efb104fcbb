"""``rebar-bench submit`` against a real server, and against a scripted one that answers wrongly, late or never."""

from __future__ import annotations

import gzip
import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench import SubmissionWriter, score
from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.cli.submit import read_token
from rebar_depth_bench.remote import leaderboard_client
from rebar_depth_bench.remote.leaderboard_client import LeaderboardClient
from tests.leaderboard.conftest import SharedServer, WriteArchive
from tests.leaderboard.scripted_server import (
    ID,
    TOKEN,
    TOKEN_INFO,
    URL,
    ScriptedServer,
    Send,
    answer,
    scripted_server,
    submission,
)
from tests.leaderboard.serving import run_bench

ESCAPES = "\x1b]0;owned\x07\x1b[2J\u202e[red]\r\n"
Refused = Callable[..., str]


@pytest.fixture(scope="session")
def small_result(small_archive: Path, tiny_root: Path) -> bytes:
    """Return the result of ``small_archive`` as JSON."""
    return score(small_archive, tiny_root).to_json()


@pytest.fixture
def scripted(
    small_archive: Path, small_result: bytes, monkeypatch: pytest.MonkeyPatch
) -> Iterator[ScriptedServer]:
    """Run a server that accepts and scores ``small_archive``; tests replace its answers."""
    monkeypatch.setattr(leaderboard_client, "POLL_INTERVAL_S", 0.01)
    monkeypatch.setenv("REBAR_LEADERBOARD_TOKEN", TOKEN)
    with scripted_server() as script:
        script.answers = {
            "token": [answer(TOKEN_INFO)],
            "submit": [answer(submission(small_archive), 202)],
            "status": [answer(submission(small_archive, status=status)) for status in ("queued", "scored")],
            "result": [answer(small_result)],
        }
        yield script


@pytest.fixture
def refused(
    scripted: ScriptedServer, small_archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Refused:
    """Submit to the scripted server, and check exit status and that nothing is written; return the message."""

    def check(status: int = 1, *options: str) -> str:
        start = time.monotonic()
        assert scripted.submit(small_archive, "--json", str(tmp_path / "r.json"), *options) == status
        assert time.monotonic() - start < 20
        assert list(tmp_path.iterdir()) == []
        captured = capsys.readouterr()
        assert captured.out == ""
        assert all(line.isprintable() and len(line) < 3000 for line in captured.err.split("\n"))
        assert len(captured.err) < 30_000
        assert TOKEN not in captured.err
        return captured.err[captured.err.index("error: ") :]

    return check


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


def test_rejected_archive_has_the_problems_of_check(board: SharedServer, tiny_root: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip")
    submitted = run_bench("submit", broken, "--url", board.url, token=board.token)
    assert submitted.returncode == 2
    checked = run_bench("check", broken, "--data", tiny_root).stderr.splitlines()[-1]
    assert checked.rpartition("broken.zip: ")[2] in submitted.stderr
    client = LeaderboardClient(board.url, board.token)
    with pytest.raises(SubmissionError) as raised:
        client.submit(broken)
    assert [problem.code for problem in raised.value.problems] == ["syntax"]
    with pytest.raises(InputError, match="cannot be read"):
        client.submit(tmp_path)


@pytest.mark.parametrize(
    ("path", "token", "words"),
    [
        ("", None, "no token: set REBAR_LEADERBOARD_TOKEN, or give --token-file FILE"),
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


@pytest.mark.parametrize(
    ("url", "status"), [("http://127.0.0.1:9", 1), ("no address", 2), ("ftp://127.0.0.1/", 2), ("http://[", 1)]
)
def test_unreachable_service_or_invalid_url_is_reported(small_archive: Path, url: str, status: int) -> None:
    process = run_bench("submit", small_archive, "--url", url, token="rdb_x")
    assert process.returncode == status
    assert process.stderr.splitlines()[-1].startswith("error: ")


def test_token_is_sent_to_the_leaderboard_with_every_request(
    scripted: ScriptedServer, small_archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert scripted.submit(small_archive) == 0
    assert URL in capsys.readouterr().err.splitlines()
    assert scripted.endpoints() == ["token", "submit", "status", "status", "result"]
    assert all(f"Bearer {TOKEN}" in head for _, head in scripted.requests)
    assert all(re.search("accept-encoding: identity", head, re.IGNORECASE) for _, head in scripted.requests)


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
    ("name", "value", "shown", "reason"),
    [
        pytest.param(
            "ALL_PROXY",
            "socks5://u:secret@127.0.0.1:9",
            "socks5://127.0.0.1:9",
            "socksio",
            marks=pytest.mark.skipif(find_spec("socksio") is not None, reason="SOCKS is supported here"),
        ),
        ("HTTP_PROXY", "ftp://127.0.0.1:9", "ftp://127.0.0.1:9", "scheme"),
        ("https_proxy", "socks4://u:secret@[::1]:9", "socks4://[::1]:9", "scheme"),
        ("HTTP_PROXY", "http://[::1", "http://[::1", "Invalid port"),
        ("SSL_CERT_FILE", "/nowhere/ca.pem", "/nowhere/ca.pem", "No such file or directory"),
        ("SSL_CERT_FILE", __file__, __file__, "no certificate"),
        ("SSLKEYLOGFILE", "/nowhere/keys", "/nowhere/keys", "No such file or directory"),
    ],
)
def test_unusable_variable_of_http_is_named(
    name: str, value: str, shown: str, reason: str, small_archive: Path, no_proxy: pytest.MonkeyPatch
) -> None:
    no_proxy.setenv("SSL_CERT_DIR", str(small_archive.parent))  # SSLKEYLOGFILE is read with certificates only.
    no_proxy.setenv(name, value)
    process = run_bench("submit", small_archive, "--url", "http://127.0.0.1:9", token=TOKEN)
    assert process.returncode == 2
    [line] = process.stderr.splitlines()
    assert line.startswith("error: ")
    assert f"{name}={shown}" in line
    assert reason in line
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
        assert f"through the proxy HTTP_PROXY=http://{proxy} (NO_PROXY=127.0.0.1 avoids it)" in process.stderr
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
    assert f"through the proxy all_proxy={scripted.url} (NO_PROXY=board.invalid avoids it)" in process.stderr
    assert "the response status is 503" in process.stderr


@pytest.mark.parametrize("endpoint", ["token", "submit", "status", "result"])
def test_redirect_is_not_followed(
    endpoint: str, scripted: ScriptedServer, small_archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaderboard_client, "MAX_FAILED_POLLS", 0)
    with scripted_server() as other:
        other.answers = dict(scripted.answers)
        scripted.answers[endpoint] = [answer(b"", 307, {"Location": f"{other.url}/api/v1/token"})]
        assert scripted.submit(small_archive) == 1
        assert other.requests == []


def test_answers_with_more_keys_are_accepted(scripted: ScriptedServer, small_archive: Path) -> None:
    """The keys are those of a newer service. A repeated upload is answered with status 200."""
    known = submission(small_archive)
    scripted.answers["token"] = [answer({**TOKEN_INFO, "new": {"key": [1]}})]
    scripted.answers["submit"] = [answer({**known, "new": 1}, 200)]
    scripted.answers["status"] = [answer({**known, "status": "scored", "result": {"protocol": "rebar-9"}})]
    assert scripted.submit(small_archive) == 0


def test_too_large_archive_is_not_sent(scripted: ScriptedServer, small_archive: Path, refused: Refused) -> None:
    scripted.answers["token"] = [answer({**TOKEN_INFO, "max_upload_bytes": 2000})]
    assert f"has {small_archive.stat().st_size} bytes, expected at most 2000" in refused(2)
    assert scripted.endpoints() == ["token"]


def test_predictions_that_are_not_metric_are_not_sent(scripted: ScriptedServer, tmp_path: Path) -> None:
    archive = tmp_path / "relative.zip"
    with SubmissionWriter(archive, "net", prediction="affine-disparity") as writer:
        writer.add("lattice/0000", np.ones((2, 2), np.float32))
    with pytest.raises(SubmissionError, match="affine-disparity"):
        LeaderboardClient(scripted.url, TOKEN).submit(archive)
    assert scripted.requests == []


def endless(head: bytes, part: bytes, pause_s: float) -> Send:
    """Return an answer that never ends: ``head`` and then ``part`` again and again."""

    def send(stream: BufferedIOBase) -> None:
        stream.write(head)
        while True:
            stream.write(part)
            stream.flush()
            time.sleep(pause_s)

    return send


CHUNKED = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
ENDLESS = {
    "large": endless(CHUNKED, b"10000\r\n" + b" " * 65536 + b"\r\n", 0.0),
    "slow": endless(CHUNKED, b"1\r\n \r\n", 0.1),
    "slow headers": endless(b"HTTP/1.1 200 OK\r\n", b"X", 0.1),
}


@pytest.mark.slow
@pytest.mark.parametrize("endpoint", ["token", "submit", "status", "result"])
@pytest.mark.parametrize("kind", ENDLESS)
def test_endless_answer_ends_with_an_error(
    endpoint: str, kind: str, scripted: ScriptedServer, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("REQUEST_TIMEOUT_S", "RESULT_TIMEOUT_S", "UPLOAD_TIMEOUT_S"):
        monkeypatch.setattr(leaderboard_client, name, 15.0 if kind == "large" else 0.8)
    monkeypatch.setattr(leaderboard_client, "MAX_FAILED_POLLS", 1)
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", "10000000")
    scripted.answers[endpoint] = [ENDLESS[kind]]
    assert ("too large" if kind == "large" else "no complete response within the time limit") in refused()


def test_failed_status_requests_are_repeated(scripted: ScriptedServer, small_archive: Path) -> None:
    """A proxy may fail for a while."""
    good = submission(small_archive)
    failures = [answer(b"<html>", 502), answer(b"<html>"), b"", answer({"detail": "slow down"}, 429)]
    scripted.answers["status"] = [*failures, answer(good), answer({**good, "status": "scored"})]
    assert scripted.submit(small_archive) == 0
    assert scripted.endpoints().count("status") == len(failures) + 2


@pytest.mark.parametrize("status", ["scoring", "not scored"])
def test_wait_ends_after_its_limit(
    status: str, scripted: ScriptedServer, small_archive: Path, refused: Refused
) -> None:
    """The service answers that it is scoring, or not at all."""
    late = answer(submission(small_archive, status=status)) if status == "scoring" else lambda _: time.sleep(60)
    scripted.answers["status"] = [late]
    message = refused(1, "--wait", "0.5")
    assert f"{scripted.url}/submissions/{ID}: the submission is still {status} after 0.5 s" in message


def test_result_of_another_archive_is_refused(
    scripted: ScriptedServer, small_result: bytes, refused: Refused
) -> None:
    values = json.loads(small_result)
    values["submission"]["sha256"] = "0" * 64
    scripted.answers["result"] = [answer(values)]
    assert "is of the archive with SHA-256 000" in refused()


NO_JSON = "the answer of the leaderboard is not valid: 1 problem"
BAD_ANSWERS: dict[str, tuple[str, bytes, int, str]] = {
    "unknown token": ("token", answer({"detail": "the token is unknown"}, 401), 2, "the token is unknown"),
    "quota": ("submit", answer({"detail": "the quota is used up"}, 429), 2, "the quota is used up"),
    "proxy's limit": ("submit", answer(b"<html>413</html>", 413), 2, "the response status is 413"),
    "bad gateway": ("submit", answer(b"<html>502</html>", 502), 1, "the response status is 502"),
    "gone": ("status", answer({"detail": "no such submission"}, 404), 2, "no such submission"),
    "no result": ("result", answer({"detail": "x"}, 404), 1, "has the response status 404"),
    "detail as list": ("token", answer({"detail": [{"msg": "x"}]}, 422), 2, "the response status is 422"),
    "detail with escapes": ("token", answer({"detail": f"no{ESCAPES}error: forged"}, 401), 2, "no\ufffd"),
    "long detail": ("token", answer({"detail": "x\n" * 500_000}, 401), 2, "x x x"),
    "HTML": ("token", answer(b"<html></html>"), 1, NO_JSON),
    "deep": ("token", answer(b'{"id":' * 100_000 + b"1" + b"}" * 100_000), 1, NO_JSON),
    "limit as text": ("token", answer({**TOKEN_INFO, "max_upload_bytes": "1"}), 1, "  - max_upload_bytes: got"),
    "result without tables": ("result", answer({"protocol": ESCAPES}), 1, "result"),
    "no HTTP": ("token", b"SSH-2.0-OpenSSH\r\n", 1, "no response"),
    "closed": ("token", b"", 1, "no response"),
    "cut body": ("token", answer(TOKEN_INFO)[:-20], 1, "no response"),
    "compressed": (
        "token",
        answer(gzip.compress(bytes(1 << 24)), headers={"Content-Encoding": "gzip"}),
        1,
        NO_JSON,
    ),
}


@pytest.mark.parametrize(("endpoint", "response", "status", "words"), BAD_ANSWERS.values(), ids=BAD_ANSWERS)
def test_bad_answer_is_reported(
    endpoint: str, response: bytes, status: int, words: str, scripted: ScriptedServer, refused: Refused
) -> None:
    scripted.answers[endpoint] = [response]
    message = refused(status)
    assert words in message
    assert "\nerror: forged" not in message


@pytest.mark.parametrize(
    ("endpoint", "changes", "status", "words"),
    [
        ("submit", {"id": ...}, 1, "  - id: missing"),
        ("submit", {"id": "../../token"}, 1, "  - id: got"),
        ("submit", {"url": "javascript:alert(1)"}, 1, "  - url: got"),
        ("submit", {"url": f"https://example.org/{ESCAPES}"}, 1, "  - url: got"),
        ("submit", {"archive_sha256": "0" * 64}, 1, "another archive than was sent"),
        ("status", {"status": ESCAPES}, 1, "  - status: got"),
        ("status", {"id": "another", "status": "scored"}, 1, "the answer is on another"),
        ("status", {"status": "failed", "reason": f"no{ESCAPES}" + "\n1" * 1000}, 2, "no\\x1b]0;owned"),
        ("status", {"status": "failed"}, 2, "scoring failed"),
    ],
)
def test_answer_on_an_invalid_other_or_failed_submission_is_reported(
    endpoint: str,
    changes: dict[str, Any],
    status: int,
    words: str,
    scripted: ScriptedServer,
    small_archive: Path,
    refused: Refused,
) -> None:
    content = submission(small_archive, **changes)
    scripted.answers[endpoint] = [answer(content, 202 if endpoint == "submit" else 200)]
    assert words in refused(status)


REJECTIONS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "many lines": ({"detail": "no", "problems": ["a"] * 100_000, "problem_details": []}, ["no", *["  - a"] * 21]),
    "lines with escapes": (
        {"detail": "no", "problems": [f"a{ESCAPES}b"], "problem_details": []},
        ["no", "  - a\ufffd]0;owned"],
    ),
    "lines of other types": ({"detail": "no", "problems": [1, None, "a"], "problem_details": []}, ["no"]),
    "without lines": ({"detail": "no"}, ["no"]),
    "nothing": ({}, ["the response status is 422"]),
}


@pytest.mark.parametrize(("content", "lines"), REJECTIONS.values(), ids=REJECTIONS)
def test_rejection_is_reported(
    content: dict[str, Any], lines: list[str], scripted: ScriptedServer, refused: Refused
) -> None:
    scripted.answers["submit"] = [answer(content, 422)]
    message = refused(2).rstrip("\n").split("\n")
    assert len(message) == len(lines)
    assert all(expected in shown for expected, shown in zip(lines, message, strict=True))
