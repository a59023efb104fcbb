"""Answers of a leaderboard that are not valid: the client refuses them and writes nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.scoring.result import disclosed_json
from tests.leaderboard.client.requests import ESCAPES, TOKEN_INFO, URL, check_refused, submission, submit
from tests.leaderboard.client.scripted_server import ScriptedServer, answer


def test_good_answers_are_accepted(
    server: ScriptedServer, archive: Path, result_json: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert submit(server, archive, "--json", str(tmp_path / "r.json")) == 0
    assert (tmp_path / "r.json").read_bytes() == result_json
    captured = capsys.readouterr()
    assert "scripted" in captured.out
    assert URL in captured.err.splitlines()
    assert server.endpoints() == ["token", "submit", "status", "status", "result"]


def test_answers_of_other_versions_are_accepted(server: ScriptedServer, archive: Path) -> None:
    """An older service has fewer keys, a newer one more; a repeated upload is answered with status 200."""
    few = submission(archive, archive_sha256=..., reason=..., method=...)
    server.answers["token"] = [answer({"max_upload_bytes": 1 << 30, "new": {"key": [1]}})]
    server.answers["submit"] = [answer({**few, "new": 1}, 200)]
    server.answers["status"] = [answer({**few, "status": "scored", "result": {"protocol": "rebar-9"}})]
    assert submit(server, archive) == 0


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
    "missing": {"name": "alice"},
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
    "digest of another archive": {"archive_sha256": "0" * 64},
    "digest as number": {"archive_sha256": 7},
    "digest with escapes": {"archive_sha256": ESCAPES},
}


@pytest.mark.parametrize("body", NOT_JSON.values(), ids=NOT_JSON)
@pytest.mark.parametrize("endpoint", ["token", "submit", "result"])
def test_answer_that_is_no_json_object_is_refused(
    endpoint: str,
    body: bytes,
    server: ScriptedServer,
    archive: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    server.answers[endpoint] = [answer(body, 202 if endpoint == "submit" else 200)]
    check_refused(server, archive, tmp_path, capsys)
    assert server.endpoints()[-1] == endpoint


@pytest.mark.parametrize("content", TOKEN_ANSWERS.values(), ids=TOKEN_ANSWERS)
def test_invalid_token_info_is_refused(
    content: object, server: ScriptedServer, archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.answers["token"] = [answer(content)]
    assert "answer of the leaderboard is not valid" in check_refused(server, archive, tmp_path, capsys)
    assert server.endpoints() == ["token"]


@pytest.mark.parametrize("changes", SUBMISSION_CHANGES.values(), ids=SUBMISSION_CHANGES)
@pytest.mark.parametrize("endpoint", ["submit", "status"])
def test_invalid_submission_is_refused(
    endpoint: str,
    changes: dict[str, Any],
    server: ScriptedServer,
    archive: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if endpoint == "status" and "archive_sha256" in changes:
        changes = {"id": "another"}
    server.answers[endpoint] = [answer(submission(archive, **changes), 202 if endpoint == "submit" else 200)]
    check_refused(server, archive, tmp_path, capsys)
    assert server.endpoints() == (["token", "submit"] if endpoint == "submit" else ["token", "submit", "status"])


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
    change: Any,
    server: ScriptedServer,
    archive: Path,
    result_json: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    values = json.loads(result_json)
    change(values)
    server.answers["result"] = [answer(values)]
    check_refused(server, archive, tmp_path, capsys)


DISCLOSED_CHANGES = {
    **{name: change for name, change in RESULT_CHANGES.items() if "view" not in name},
    "many tables": lambda values: values.update(tables={str(k): {} for k in range(20_000)}),
    "rank error above 1": lambda values: values["tables"]["lattice-orbit"].update(rank_error=1.5),
    "coverage as text": lambda values: values["tables"]["lattice-orbit"].update(coverage=ESCAPES),
    "mark without a result": lambda values: values.clear() or values.update(hidden_truth=True),
}


@pytest.mark.parametrize("change", DISCLOSED_CHANGES.values(), ids=DISCLOSED_CHANGES)
def test_invalid_disclosed_result_is_not_written(
    change: Any,
    server: ScriptedServer,
    archive: Path,
    result_json: bytes,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    values = json.loads(disclosed_json(result_json))
    change(values)
    server.answers["result"] = [answer(values)]
    check_refused(server, archive, tmp_path, capsys)


def test_disclosed_result_is_printed_and_written(
    server: ScriptedServer, archive: Path, result_json: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.answers["result"] = [answer(disclosed_json(result_json))]
    assert submit(server, archive, "--json", str(tmp_path / "r.json")) == 0
    assert (tmp_path / "r.json").read_bytes() == disclosed_json(result_json)
    error = json.loads(result_json)["tables"]["lattice-orbit"]["rank_error"]
    assert f"lattice-orbit: rank error {error:.3f}, coverage 100.0 %\n" in capsys.readouterr().out
