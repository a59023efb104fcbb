"""Error answers and rejections of a leaderboard: the client reports them, shortened and escaped."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.base.errors import SubmissionError
from rebar_depth_bench.remote.leaderboard_client import LeaderboardClient
from tests.leaderboard.client.requests import ESCAPES, TOKEN, TOKEN_INFO, URL, check_refused
from tests.leaderboard.client.scripted_server import ID, ScriptedServer, answer

ERRORS: dict[str, tuple[str, bytes, int, str]] = {
    "unknown token": ("token", answer({"detail": "the token is unknown"}, 401), 2, "the token is unknown"),
    "wrong URL": ("token", answer({"detail": "Not Found"}, 404), 2, "Not Found"),
    "quota": ("submit", answer({"detail": "the quota is used up"}, 429), 2, "the quota is used up"),
    "too large": ("submit", answer({"detail": "at most 9 bytes"}, 413), 2, "at most 9 bytes"),
    "proxy's limit": ("submit", answer(b"<html>413</html>", 413), 2, "the response status is 413"),
    "bad gateway": ("submit", answer(b"<html>502</html>", 502), 1, "the response status is 502"),
    "database": ("token", answer({"detail": "try again later"}, 503), 1, "try again later"),
    "gone": ("status", answer({"detail": "no such submission"}, 404), 2, "no such submission"),
    "no result": ("result", answer({"detail": "x"}, 404), 1, "status for the result is 404"),
    "detail as list": ("token", answer({"detail": [{"msg": "x"}]}, 422), 2, "the response status is 422"),
    "detail as number": ("token", answer({"detail": 7}, 500), 1, "the response status is 500"),
    "blank detail": ("token", answer({"detail": " \n"}, 403), 2, "the response status is 403"),
    "detail with escapes": ("token", answer({"detail": f"no{ESCAPES}error: forged"}, 401), 2, "no\ufffd"),
    "long detail": ("token", answer({"detail": "x" * 1_000_000}, 401), 2, "xxx"),
    "many lines": ("token", answer({"detail": "x\n" * 100_000}, 401), 2, "x x x"),
    "reason with escapes": (
        "status",
        answer({"id": ID, "url": URL, "status": "failed", "reason": f"no{ESCAPES}more" + "\n1" * 1000}),
        2,
        "no\\x1b]0;owned",
    ),
    "no reason": ("status", answer({"id": ID, "url": URL, "status": "failed"}), 2, "scoring failed"),
    "no HTTP": ("token", b"SSH-2.0-OpenSSH\r\n", 1, "no response"),
    "binary": ("token", bytes(range(256)) * 100, 1, "no response"),
    "closed": ("token", b"", 1, "no response"),
    "cut body": ("token", answer(TOKEN_INFO)[:-20], 1, "no response"),
    "two lengths": ("token", answer(TOKEN_INFO, headers={"content-length": "5"}), 1, "no response"),
    "status line with escapes": ("token", b"HTTP/1.1 \x1b[2J\r\n\r\n", 1, "no response"),
    "long header": ("token", b"HTTP/1.1 200 OK\r\nX: " + b"a" * 500_000 + b"\r\n\r\n", 1, "no response"),
    "many headers": ("token", b"HTTP/1.1 200 OK\r\n" + b"X: a\r\n" * 100_000 + b"\r\n", 1, "no response"),
    "bad chunk": ("token", b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", 1, "no response"),
    "compressed": (
        "token",
        answer(gzip.compress(bytes(1 << 24)), headers={"Content-Encoding": "gzip"}),
        1,
        "expected 200 with a JSON object",
    ),
    "cookies": (
        "token",
        answer({}, 401, {"Set-Cookie": "a=" + "b" * 10_000 + "; Expires=" + "9" * 1000}),
        2,
        "401",
    ),
}


@pytest.mark.parametrize(("endpoint", "response", "status", "words"), ERRORS.values(), ids=ERRORS)
def test_error_answer_is_reported(
    endpoint: str,
    response: bytes,
    status: int,
    words: str,
    server: ScriptedServer,
    archive: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    server.answers[endpoint] = [response]
    message = check_refused(server, archive, tmp_path, capsys, status)
    assert words in message
    assert "\nerror: forged" not in message


REJECTIONS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "lines": ({"detail": "no", "problems": ["a: x", "b: y"]}, ["no", "  - a: x", "  - b: y"]),
    "many lines": (
        {"detail": "no", "problems": ["a"] * 100_000},
        ["no", *["  - a"] * 21, "  ... and 99979 more"],
    ),
    "lines of other types": ({"detail": "no", "problems": [1, None, ["x"], {"y": 1}, "a"]}, ["no", "  - a"]),
    "problems as text": ({"detail": "no", "problems": "abc"}, ["no"]),
    "problems as number": ({"detail": "no", "problems": 7}, ["no"]),
    "problems as object": ({"detail": "no", "problems": {"a": 1}}, ["no"]),
    "lines with escapes": ({"detail": "no", "problems": [f"a{ESCAPES}b"]}, ["no", "  - a\ufffd]0;owned"]),
    "nothing": ({}, ["rejected"]),
    "long line": ({"detail": "no", "problems": ["x" * 800_000]}, ["no", "  - x"]),
    "details of other types": ({"detail": "no", "problem_details": [{"code": "new"}, 7]}, ["no"]),
    "details as text": ({"detail": "no", "problem_details": "abc"}, ["no"]),
}


@pytest.mark.parametrize(("content", "lines"), REJECTIONS.values(), ids=REJECTIONS)
def test_rejection_is_reported(
    content: dict[str, Any],
    lines: list[str],
    server: ScriptedServer,
    archive: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    server.answers["submit"] = [answer(content, 422)]
    message = check_refused(server, archive, tmp_path, capsys, 2).rstrip("\n").split("\n")
    assert len(message) == len(lines)
    assert all(expected in shown for expected, shown in zip(lines, message, strict=True))
    with LeaderboardClient(server.url, TOKEN) as client, pytest.raises(SubmissionError) as caught:
        client.submit(archive)
    assert caught.value.problems == ()
