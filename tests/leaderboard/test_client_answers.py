"""Answers of a scripted leaderboard to ``rebar-bench submit``: bad ones are reported, and nothing is written."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.base.errors import SubmissionError
from rebar_depth_bench.remote.leaderboard_client import LeaderboardClient
from tests.leaderboard.conftest import Refused
from tests.leaderboard.scripted_server import (
    SUBMISSION,
    TOKEN,
    TOKEN_INFO,
    URL,
    ScriptedServer,
    answer,
    submission,
)

ESCAPES = "\x1b]0;owned\x07\x1b[2J\u202e[red]\r\n"


def test_good_answers_are_accepted(
    scripted: ScriptedServer,
    small_archive: Path,
    small_result: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert scripted.submit(small_archive, "--json", str(tmp_path / "r.json")) == 0
    assert (tmp_path / "r.json").read_bytes() == small_result
    captured = capsys.readouterr()
    assert "small" in captured.out
    assert URL in captured.err.splitlines()
    assert scripted.endpoints() == ["token", "submit", "status", "status", "result"]


def test_answers_of_other_versions_are_accepted(scripted: ScriptedServer, small_archive: Path) -> None:
    """An older service has no optional keys, a newer one more; a repeated upload is answered with status 200."""
    optional = ("parameters", "inputs", "uses_ground_truth", "outdated", "result")
    few = submission(small_archive, **dict.fromkeys(optional, ...))
    scripted.answers["token"] = [answer({**TOKEN_INFO, "new": {"key": [1]}})]
    scripted.answers["submit"] = [answer({**few, "new": 1}, 200)]
    scripted.answers["status"] = [answer({**few, "status": "scored", "result": {"protocol": "rebar-9"}})]
    assert scripted.submit(small_archive) == 0


NOT_JSON = {
    "empty": b"",
    "HTML": b"<html><body>Bad Gateway</body></html>",
    "not UTF-8": b"\xff\xfe{}",
    "half": b'{"id": ',
    "deep": b"[" * 200_000 + b"]" * 200_000,
    "deep object": b'{"id":' * 100_000 + b"1" + b"}" * 100_000,
    "long integer": b'{"max_upload_bytes": ' + b"9" * 5000 + b"}",
    "not a number": b'{"max_upload_bytes": NaN}',
    "infinite": b'{"max_upload_bytes": 1e999}',
    "twice": b'{"id": "a", "id": "b"}',
    "surrogate": rb'{"id": "\ud800"}',
    "list": b"[1, 2]",
    "null": b"null",
    "text": b'"token"',
}
TOKEN_ANSWERS: dict[str, Any] = {
    "missing": {key: value for key, value in TOKEN_INFO.items() if key != "max_upload_bytes"},
    "text": {**TOKEN_INFO, "max_upload_bytes": "1000000000"},
    "fraction": {**TOKEN_INFO, "max_upload_bytes": 1e9},
    "true": {**TOKEN_INFO, "max_upload_bytes": True},
    "negative": {**TOKEN_INFO, "max_upload_bytes": -1},
    "zero": {**TOKEN_INFO, "max_upload_bytes": 0},
    "huge": {**TOKEN_INFO, "max_upload_bytes": 1 << 80},
    "list": {**TOKEN_INFO, "max_upload_bytes": [1 << 30]},
    "null": {**TOKEN_INFO, "max_upload_bytes": None},
}
SUBMISSION_CHANGES: dict[str, dict[str, Any]] = {
    "no id": {"id": ...},
    "id with a path": {"id": "../../token"},
    "id with a query": {"id": "a?x=1"},
    "id with a line": {"id": "a\r\nHost: evil"},
    "id of an escape": {"id": "\x1b[31m"},
    "id as number": {"id": 7},
    "empty id": {"id": ""},
    "long id": {"id": "a" * 101},
    "no status": {"status": ...},
    "unknown status": {"status": "cancelled"},
    "status with escapes": {"status": ESCAPES},
    "status as list": {"status": ["scored"]},
    "status as null": {"status": None},
    "no url": {"url": ...},
    "url with escapes": {"url": f"https://example.org/{ESCAPES}"},
    "url of a script": {"url": "javascript:alert(1)"},
    "url of a file": {"url": "file:///etc/passwd"},
    "url as object": {"url": {"x": 1}},
    "long url": {"url": "https://example.org/" + "a" * 100_000},
    "url that turns text around": {"url": "https://example.org/\u202egpj"},
    "reason as list": {"reason": ["x"]},
    "digest as number": {"archive_sha256": 7},
    "digest with escapes": {"archive_sha256": ESCAPES},
    "time as text": {"created_at": ESCAPES},
}


JSON_CASES = [*(("token", name) for name in NOT_JSON), ("submit", "HTML"), ("result", "HTML")]


@pytest.mark.parametrize(("endpoint", "name"), JSON_CASES)
def test_answer_that_is_no_json_object_is_refused(
    endpoint: str, name: str, scripted: ScriptedServer, refused: Refused
) -> None:
    scripted.answers[endpoint] = [answer(NOT_JSON[name], 202 if endpoint == "submit" else 200)]
    refused()
    assert scripted.endpoints()[-1] == endpoint


@pytest.mark.parametrize("content", TOKEN_ANSWERS.values(), ids=TOKEN_ANSWERS)
def test_invalid_token_info_is_refused(content: object, scripted: ScriptedServer, refused: Refused) -> None:
    scripted.answers["token"] = [answer(content)]
    assert re.search(
        r"answer of the leaderboard is not valid: 1 problem\n  - max_upload_bytes: .*, expected a whole", refused()
    )
    assert scripted.endpoints() == ["token"]


@pytest.mark.parametrize("changes", SUBMISSION_CHANGES.values(), ids=SUBMISSION_CHANGES)
@pytest.mark.parametrize("endpoint", ["submit", "status"])
def test_invalid_submission_is_refused(
    endpoint: str, changes: dict[str, Any], scripted: ScriptedServer, small_archive: Path, refused: Refused
) -> None:
    content = submission(small_archive, **changes)
    scripted.answers[endpoint] = [answer(content, 202 if endpoint == "submit" else 200)]
    [key] = changes
    assert re.search(f"1 problem\n  - {key}: (got|missing)", refused())
    assert scripted.endpoints() == (["token", "submit"] if endpoint == "submit" else ["token", "submit", "status"])


@pytest.mark.parametrize(
    ("endpoint", "changes", "words"),
    [
        ("submit", {"archive_sha256": "0" * 64}, "another archive than was sent"),
        ("status", {"id": "another", "status": "scored"}, "on submission another"),
    ],
)
def test_answer_on_another_submission_is_refused(
    endpoint: str,
    changes: dict[str, Any],
    words: str,
    scripted: ScriptedServer,
    small_archive: Path,
    refused: Refused,
) -> None:
    content = submission(small_archive, **changes)
    scripted.answers[endpoint] = [answer(content, 202 if endpoint == "submit" else 200)]
    assert words in refused()


RESULT_CHANGES: dict[str, Any] = {
    "another archive": lambda values: values["submission"].update(sha256="0" * 64),
    "digest with escapes": lambda values: values["submission"].update(sha256=ESCAPES),
    "digest as list": lambda values: values["submission"].update(sha256=[1]),
    "no submission": lambda values: values.pop("submission"),
    "submission as list": lambda values: values.update(submission=[]),
    "another protocol": lambda values: values.update(protocol=ESCAPES),
    "protocol as object": lambda values: values.update(protocol={}),
    "no tables": lambda values: values.pop("tables"),
    "tables as list": lambda values: values.update(tables=[1]),
    "table as text": lambda values: values["tables"].update({"lattice-orbit": ESCAPES}),
    "views as null": lambda values: values.update(views=None),
    "view without id": lambda values: values["views"][0].pop("view_id"),
}


@pytest.mark.parametrize("change", RESULT_CHANGES.values(), ids=RESULT_CHANGES)
def test_invalid_result_is_not_written(
    change: Any, scripted: ScriptedServer, small_result: bytes, refused: Refused
) -> None:
    values = json.loads(small_result)
    change(values)
    scripted.answers["result"] = [answer(values)]
    refused()


FAILED = {**SUBMISSION, "status": "failed"}
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
        answer({**FAILED, "reason": f"no{ESCAPES}more" + "\n1" * 1000}),
        2,
        "no\\x1b]0;owned",
    ),
    "no reason": ("status", answer(FAILED), 2, "scoring failed"),
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
    endpoint: str, response: bytes, status: int, words: str, scripted: ScriptedServer, refused: Refused
) -> None:
    scripted.answers[endpoint] = [response]
    message = refused(status)
    assert words in message
    assert "\nerror: forged" not in message


REJECTIONS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "lines": ({"detail": "no", "problems": ["a: x", "b: y"]}, ["no", "  - a: x", "  - b: y"]),
    "many lines": ({"detail": "no", "problems": ["a"] * 100_000}, ["no", *["  - a"] * 21, "  ... and 99979 more"]),
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
    content: dict[str, Any], lines: list[str], scripted: ScriptedServer, small_archive: Path, refused: Refused
) -> None:
    scripted.answers["submit"] = [answer(content, 422)]
    message = refused(2).rstrip("\n").split("\n")
    assert len(message) == len(lines)
    assert all(expected in shown for expected, shown in zip(lines, message, strict=True))
    with LeaderboardClient(scripted.url, TOKEN) as client, pytest.raises(SubmissionError) as caught:
        client.submit(small_archive)
    assert caught.value.problems == ()
