"""API of real servers, on SQLite and on PostgreSQL."""

from __future__ import annotations

import csv
import html
import io
import json
import os
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx2
import pytest

from leaderboard.db import submissions
from tests import requirements
from tests.leaderboard.boards import board_settings, opened
from tests.leaderboard.conftest import SharedServer, WriteArchive, filled_board
from tests.leaderboard.serving import API, Postgres, RunServer, Server, distinct_archive, run_bench

QUOTA = 6


@pytest.fixture(scope="module")
def postgres_board(
    write_archive: WriteArchive, postgres: Postgres, running_server: RunServer
) -> Iterator[SharedServer]:
    """Return a server with five submissions on PostgreSQL; the tests of pages and client use one on SQLite."""
    with filled_board(running_server, write_archive, postgres.new_database("api")) as shared:
        yield shared


@pytest.fixture(scope="session")
def private_server(new_database: Callable[[], str], running_server: RunServer) -> Iterator[Server]:
    """Return a server whose submissions are private by default, with a quota of six per day and token."""
    with running_server(db=new_database(), default_visibility="owner", quota=QUOTA) as server:
        yield server


@pytest.mark.parametrize("kind", ["good", "far", "holes", "hostile"])
def test_result_json_equals_command_line_output(
    postgres_board: SharedServer, tiny_root: Path, tmp_path: Path, kind: str
) -> None:
    stored_archive = postgres_board.server.state / "archives" / f"{postgres_board.ids[kind]}.zip"
    run_bench("score", stored_archive, "--data", tiny_root, "--json", tmp_path / "own.json")
    expected = (tmp_path / "own.json").read_bytes()
    assert postgres_board.server.get(f"{API}/{postgres_board.ids[kind]}/result.json").content == expected
    assert postgres_board.server.get(f"{API}/{postgres_board.ids[kind]}").json()["result"] == json.loads(expected)
    rows = {row["id"]: row for row in postgres_board.server.rows()}
    assert rows[postgres_board.ids[kind]]["table"] == json.loads(expected)["tables"]["lattice"]


def test_csv_has_same_rows_as_json(postgres_board: SharedServer) -> None:
    response = postgres_board.server.get("/api/v1/leaderboard.csv?config=lattice")
    assert response.headers["content-type"] == "text/csv; charset=utf-8"
    lines = list(csv.DictReader(io.StringIO(response.text)))
    for line, row in zip(lines, postgres_board.server.rows(), strict=True):
        assert line["id"] == row["id"]
        assert line["rank"] == ("" if row["rank"] is None else str(row["rank"]))
        assert float(line["native_rmse_cm"]) == row["table"]["native"]["rmse_cm"]
        assert float(line["within_10mm"]) == row["table"]["within_mm"]["10"]


def test_accepted_upload_returns_url_of_submission(private_server: Server, small_archive: Path) -> None:
    token = private_server.token("where")
    response = private_server.submit(small_archive, token)
    assert response.status_code == 202
    accepted = response.json()
    assert accepted["status"] == "queued"
    assert accepted["url"] == f"{private_server.url}/submissions/{accepted['id']}"
    assert response.headers["location"] == f"{API}/{accepted['id']}"
    submission = private_server.wait_until_ended(accepted["id"])
    assert (submission["status"], submission["method"], submission["reason"]) == ("scored", "small", None)
    assert submission["result"]["submission"]["sha256"] == submission["archive_sha256"]
    assert httpx2.get(accepted["url"]).status_code == 200


def test_predictions_that_are_not_metric_are_refused(private_server: Server, write_archive: WriteArchive) -> None:
    token = private_server.token("relative")
    relative = write_archive("relative", configs=("lattice-orbit",), prediction="affine-disparity")
    response = private_server.submit(relative, token)
    assert response.status_code == 422
    [problem] = response.json()["problems"]
    assert "the predictions are of the kind affine-disparity, expected metric ones" in problem
    assert private_server.get("/api/v1/token", token).json()["quota_left"] == QUOTA


def test_quota_holds_for_concurrent_uploads_and_deletions(private_server: Server, small_archive: Path) -> None:
    token, other_token = private_server.token("eager"), private_server.token("patient")
    with ThreadPoolExecutor(10) as pool:
        archives = [distinct_archive(small_archive, number) for number in range(10)]
        responses = list(pool.map(lambda archive: private_server.submit(archive, token), archives))
    accepted = [response.json()["id"] for response in responses if response.status_code == 202]
    assert sorted(response.status_code for response in responses) == [202] * QUOTA + [429] * 4
    assert private_server.call("DELETE", f"{API}/{accepted[0]}", token).status_code == 204
    rejected = private_server.submit(distinct_archive(small_archive, 10), token)
    assert rejected.status_code == 429
    assert rejected.json()["detail"].startswith(f"the quota of {QUOTA} submissions per day (UTC) is used up")
    assert private_server.submit(small_archive, other_token).status_code == 202
    assert {private_server.wait_until_ended(submission_id)["status"] for submission_id in accepted[1:]} == {
        "scored"
    }
    stored_ids = {path.stem for path in (private_server.state / "archives").glob("*.zip")}
    assert stored_ids >= set(accepted[1:])
    assert accepted[0] not in stored_ids


def test_token_states_quota_and_limits(private_server: Server, small_archive: Path) -> None:
    assert private_server.get("/api/v1/token").status_code == 401
    token = private_server.token("curious about limits")
    before = private_server.get("/api/v1/token", token).json()
    private_server.submit_accepted(small_archive, token)
    after = private_server.get("/api/v1/token", token).json()
    assert (before["name"], before["quota"], before["quota_left"]) == ("curious about limits", QUOTA, QUOTA)
    used = {"quota_left": QUOTA - 1, "quota_bytes_left": before["quota_bytes"] - small_archive.stat().st_size}
    assert after == before | used
    assert before["max_upload_bytes"] > 0


def test_private_submission_is_visible_to_owner_only(private_server: Server, write_archive: WriteArchive) -> None:
    token, other_token = private_server.token("shy"), private_server.token("curious")
    submission_id = private_server.submit_accepted(write_archive("hidden", 1.1), token)
    assert private_server.wait_until_ended(submission_id)["public"] is False
    assert submission_id not in {row["id"] for row in private_server.rows()}
    assert submission_id not in {row["id"] for row in private_server.rows(other_token)}
    [own_row] = [row for row in private_server.rows(token) if row["id"] == submission_id]
    assert own_row["rank"] is None
    assert submission_id not in private_server.get("/api/v1/leaderboard.csv?config=lattice").text

    def publish(public: object, sender: str | None) -> httpx2.Response:
        return private_server.call("PATCH", f"{API}/{submission_id}", sender, json={"public": public})

    refused = [publish(True, other_token), publish(True, None), publish("perhaps", token)]
    assert [response.status_code for response in refused] == [403, 401, 422]
    assert publish(True, token).json()["public"] is True
    [public_row] = [row for row in private_server.rows() if row["id"] == submission_id]
    assert public_row["rank"] is not None
    assert publish(False, token).json()["public"] is False
    assert submission_id not in {row["id"] for row in private_server.rows()}


def test_curl_commands_of_the_page_submit_list_edit_and_delete(
    private_server: Server, write_archive: WriteArchive
) -> None:
    requirements.require("uploads")
    token, archive = private_server.token("curl"), write_archive("by curl", 1.05)
    submission_id = private_server.submit_accepted(archive, token)
    private_server.wait_until_ended(submission_id)
    page = private_server.get("/how-to-submit").text
    (script,) = re.findall(r'id="manage">(.*?)</pre>', page, re.DOTALL)
    variables, *commands = re.split(r"\n(?=curl)", html.unescape(script).replace("ARCHIVE", str(archive)))
    environment = {**os.environ, "REBAR_LEADERBOARD_TOKEN": token}
    answers = []
    for command in commands:
        call = command.replace("/ID", f"/{submission_id}").replace("curl ", "curl -sS -w '\n%{http_code}' ")
        script = f"{variables}\n{call}"
        done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True, env=environment)
        body, _, status = done.stdout.rpartition("\n")
        answers.append((status, json.loads(body or "{}")))
    (sent, known), (listed, owned), (changed, edited), (deleted, _) = answers
    assert (sent, listed, changed, deleted) == ("200", "200", "200", "204")
    assert known["id"] == submission_id
    assert [(own["id"], own["public"]) for own in owned["submissions"]] == [(submission_id, False)]
    assert (edited["public"], edited["code_url"]) == (True, "https://example.org")
    assert private_server.get(f"{API}/{submission_id}").status_code == 404


def test_always_public_submission_cannot_be_hidden(postgres_board: SharedServer) -> None:
    path = f"{API}/{postgres_board.ids['good']}"
    response = postgres_board.server.call("PATCH", path, postgres_board.token, json={"public": False})
    assert (response.status_code, response.json()["detail"]) == (
        403,
        "every submission of this leaderboard is public; delete it to remove its rows",
    )
    assert postgres_board.server.get(path).json()["public"] is True


def test_lone_surrogate_is_422(private_server: Server, small_archive: Path) -> None:
    token = private_server.token("broken text")
    submission_id = private_server.submit_accepted(small_archive, token)
    keys = ("description", "url", "code_url", "licence", "training_data", "parameters", "public", "a\\ud800")
    for key in keys:
        body = b'{"%s": "https://example.org/\\ud800"}' % key.encode()
        response = private_server.call("PATCH", f"{API}/{submission_id}", token, content=body)
        assert response.status_code == 422, (key, response.text)


def test_only_owner_can_delete_submission(private_server: Server, write_archive: WriteArchive) -> None:
    token, other_token = private_server.token("tidy"), private_server.token("nosy")
    submission_id = private_server.submit_accepted(write_archive("short-lived"), token)
    private_server.wait_until_ended(submission_id)
    private_server.call("PATCH", f"{API}/{submission_id}", token, json={"public": True})
    assert private_server.call("DELETE", f"{API}/{submission_id}", other_token).status_code == 403
    assert private_server.call("DELETE", f"{API}/{submission_id}").status_code == 401
    assert submission_id in {row["id"] for row in private_server.rows()}
    assert private_server.call("DELETE", f"{API}/{submission_id}", token).status_code == 204
    for path in (f"{API}/{submission_id}", f"{API}/{submission_id}/result.json", f"/submissions/{submission_id}"):
        assert private_server.get(path).status_code == 404, path
    assert private_server.call("DELETE", f"{API}/{submission_id}", token).status_code == 404
    assert submission_id not in {row["id"] for row in private_server.rows(token)}
    assert not (private_server.state / "archives" / f"{submission_id}.zip").exists()


def test_method_name_that_cannot_be_seen_is_refused(private_server: Server, write_archive: WriteArchive) -> None:
    token, archives = private_server.token("invisible"), private_server.state / "archives"
    stored = set(archives.iterdir())
    response = private_server.submit(write_archive("\u3164", configs=("lattice-orbit",)), token)
    assert response.status_code == 422, response.text
    assert response.json()["problems"][0].startswith("submission.json: method: ")
    assert set(archives.iterdir()) == stored
    assert private_server.get(API, token).json() == {"submissions": []}


def test_best_rows_of_a_method_have_ranks_of_their_own(crowded: SharedServer) -> None:
    def rows(path: str) -> list[dict[str, Any]]:
        return list(crowded.server.get(f"/api/v1/{path}").json()["rows"])

    every, best = rows("leaderboard?config=lattice"), rows("leaderboard?config=lattice&best=1")
    ids = [row["id"] for row in every if row["id"] != crowded.ids["worse"]]
    assert len(ids) == len(every) - 1
    overall = rows("overall?best=1")
    csv_text = crowded.server.get("/api/v1/leaderboard.csv?config=lattice&best=1").text
    lines = list(csv.DictReader(io.StringIO(csv_text)))
    for shown in (best, lines):
        assert [row["id"] for row in shown] == ids
        assert [row["id"] for row in shown if str(row["baseline"]).lower() == "true"] == [crowded.ids["baseline"]]
    [last, last_of_best] = [
        row["rank"] for shown in (every, best) for row in shown if row["id"] == crowded.ids["huge"]
    ]
    assert last_of_best == last - 1, "the row that is left out is before the last"
    assert {row["id"]: row["rank"] for row in overall} == {row["id"]: row["rank"] for row in best}


def test_quota_counts_the_submissions_of_today(private_server: Server, small_archive: Path) -> None:
    """A clock that was ahead, or yesterday's submissions, do not use it up."""
    token = private_server.token("traveller")
    times = (0.0, -86400.0, 400 * 86400.0)
    ids = [private_server.submit_accepted(distinct_archive(small_archive, 50 + k), token) for k in range(3)]
    settings = board_settings(private_server.state, db=private_server.db)
    with opened(settings) as (database, _):
        for submission_id, shift_s in zip(ids, times, strict=True):
            submissions.change(database, submission_id, {"created_at": time.time() + shift_s})
    assert private_server.get("/api/v1/token", token).json()["quota_left"] == QUOTA - 1


def test_all_responses_have_security_headers(postgres_board: SharedServer) -> None:
    for method, path in (("GET", "/"), ("GET", "/healthz"), ("GET", "/nope"), ("POST", API), ("PUT", "/")):
        headers = postgres_board.server.call(method, path).headers
        assert "default-src 'none'" in headers["content-security-policy"], path
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "server" not in headers


@pytest.mark.parametrize(
    "path", ["/", "/healthz", "/static/page.css", "/api/v1/leaderboard?config=lattice", "/no"]
)
def test_head_requests_return_the_headers_of_get(postgres_board: SharedServer, path: str) -> None:
    head, get = (postgres_board.server.call(method, path) for method in ("HEAD", "GET"))
    assert (head.status_code, head.content) == (get.status_code, b"")
    same = ("content-type", "cache-control", "etag")
    assert [head.headers.get(name) for name in same] == [get.headers.get(name) for name in same]


def test_archive_damaged_in_storage_fails_alone(
    tmp_path: Path, small_archive: Path, new_database: Callable[[], str], running_server: RunServer
) -> None:
    state, db = tmp_path / "state", new_database()
    with running_server(state, db=db, workers=0) as server:
        token = server.token("alice")
        ids = [server.submit_accepted(small_archive, token) for _ in range(3)]
    stored_archive = state / "archives" / f"{ids[1]}.zip"
    content = bytearray(stored_archive.read_bytes())
    content[2000:2100] = bytes(100)
    stored_archive.write_bytes(content)
    with running_server(state, db=db) as server:
        submissions = [server.wait_until_ended(submission_id) for submission_id in ids]
        assert [submission["status"] for submission in submissions] == ["scored", "failed", "scored"]
        assert "the stored archive has another SHA-256" in submissions[1]["reason"]
        assert str(state) not in submissions[1]["reason"]
        assert {row["id"] for row in server.rows(config="lattice-orbit")} == {ids[0], ids[2]}
