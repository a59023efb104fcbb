"""The API of real servers, on SQLite and on PostgreSQL."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx2
import pytest

from rebar_depth_bench import load
from tests.leaderboard.conftest import Shared, Write
from tests.leaderboard.serving import Server, running_server

API = "/api/v1/submissions"
OWNERS_QUOTA = 6


def call(server: Server, method: str, path: str, token: str | None = None, **content: Any) -> httpx2.Response:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    return httpx2.request(method, f"{server.url}{path}", headers=headers, timeout=60, **content)


def rows(server: Server, token: str | None = None, config: str = "lattice") -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = call(server, "GET", f"/api/v1/leaderboard?config={config}", token).json()["rows"]
    return found


@pytest.fixture(scope="session")
def owners(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, new_database: Callable[[], str]
) -> Iterator[Server]:
    """A server that scores, keeps submissions to their owners, and takes six a day of a token."""
    state = tmp_path_factory.mktemp("owners") / "state"
    settings: dict[str, Any] = {
        "db": new_database(),
        "public": "owner",
        "quota": OWNERS_QUOTA,
        "writes": "1000/minute",
    }
    with running_server(tiny_root, state, **settings) as server:
        yield server


@pytest.fixture(scope="session")
def small(write_archive: Write) -> Path:
    return write_archive("small", configs=("lattice-orbit",))


@pytest.fixture
def broken(tiny_root: Path, tmp_path: Path) -> Path:
    """An archive of one view, which is no array; the config's others are missing."""
    with zipfile.ZipFile(tmp_path / "broken.zip", "w") as archive:
        archive.writestr("submission.json", json.dumps({"method": "x"}))
        archive.writestr(f"{view_ids(tiny_root)[0]}.npy", b"no array")
    return tmp_path / "broken.zip"


def view_ids(root: Path) -> list[str]:
    return [str(row["view_id"]) for row in load(root, "lattice", columns=["view_id"])]


@pytest.mark.parametrize("kind", ["good", "far", "holes", "hostile"])
def test_the_result_is_the_command_lines_byte_for_byte(
    board: Shared, tiny_root: Path, tmp_path: Path, kind: str
) -> None:
    kept = board.server.state / "archives" / f"{board.ids[kind]}.zip"
    command = [sys.executable, "-m", "rebar_depth_bench", "score", str(kept), "--data", str(tiny_root), "--json"]
    subprocess.run([*command, str(tmp_path / "own.json")], check=True, capture_output=True)
    own = (tmp_path / "own.json").read_bytes()
    assert call(board.server, "GET", f"{API}/{board.ids[kind]}/result.json").content == own
    assert call(board.server, "GET", f"{API}/{board.ids[kind]}").json()["result"] == json.loads(own)


def test_rows_are_ranked_by_native_abs_rel_and_incomplete_ones_are_not(board: Shared) -> None:
    found = rows(board.server)
    ranked = [row for row in found if row["rank"] is not None]
    assert [row["rank"] for row in ranked] == list(range(1, len(ranked) + 1))
    assert found[: len(ranked)] == ranked
    errors = [row["table"]["native"]["abs_rel"] for row in ranked]
    assert errors == sorted(errors)
    assert board.ids["good"] == ranked[0]["id"]
    assert board.ids["holes"] in {row["id"] for row in found if row["rank"] is None}
    assert board.ids["far"] not in {row["id"] for row in rows(board.server, config="lattice-orbit")}
    result = call(board.server, "GET", f"{API}/{ranked[0]['id']}").json()["result"]
    assert ranked[0]["table"] == result["tables"]["lattice"]


def test_the_csv_has_the_same_rows_and_no_formula(board: Shared) -> None:
    answer = call(board.server, "GET", "/api/v1/leaderboard.csv?config=lattice")
    assert answer.headers["content-type"] == "text/csv; charset=utf-8"
    lines = list(csv.DictReader(io.StringIO(answer.text)))
    for line, row in zip(lines, rows(board.server), strict=True):
        assert line["id"] == row["id"]
        assert line["rank"] == ("" if row["rank"] is None else str(row["rank"]))
        assert float(line["native_rmse_cm"]) == row["table"]["native"]["rmse_cm"]
        assert float(line["within_10mm"]) == row["table"]["within_mm"]["10"]


def test_an_accepted_upload_says_where_it_is(owners: Server, small: Path) -> None:
    token = owners.token("where")
    answer = owners.submit(small, token)
    assert answer.status_code == 202
    accepted = answer.json()
    assert accepted["status"] == "queued"
    assert accepted["url"] == f"{owners.url}/submissions/{accepted['id']}"
    assert answer.headers["location"] == f"{API}/{accepted['id']}"
    ended = owners.ended(accepted["id"])
    assert (ended["status"], ended["method"], ended["reason"]) == ("scored", "small", None)
    assert ended["result"]["submission"]["sha256"] == ended["archive_sha256"]
    assert httpx2.get(accepted["url"]).status_code == 200


@pytest.mark.parametrize("header", [None, "Bearer rdb_wrong", "Basic YTpi", "Bearer", "Bearer \udcff"])
def test_without_a_token_that_is_known_nothing_is_taken(owners: Server, small: Path, header: str | None) -> None:
    headers = {} if header is None else {"Authorization": header.encode("utf-8", "surrogateescape")}
    with small.open("rb") as stream:
        answer = httpx2.post(f"{owners.url}{API}", files={"archive": stream}, headers=headers, timeout=60)
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"] == "Bearer"
    assert "token" in answer.json()["detail"]


def test_a_refused_archive_says_every_problem_and_costs_nothing(
    owners: Server, tiny_root: Path, small: Path, broken: Path
) -> None:
    token = owners.token("clumsy")
    for _ in range(OWNERS_QUOTA + 1):
        answer = owners.submit(broken, token)
        assert answer.status_code == 422
    problems = answer.json()["problems"]
    for view_id in view_ids(tiny_root):
        assert any(view_id in problem for problem in problems), problems
    assert not any(str(owners.state) in problem for problem in problems)
    assert owners.submit(small, token).status_code == 202


def test_the_quota_holds_for_uploads_at_once_and_deleting_gives_nothing_back(owners: Server, small: Path) -> None:
    token, other = owners.token("eager"), owners.token("patient")
    with ThreadPoolExecutor(10) as pool:
        answers = list(pool.map(lambda _: owners.submit(small, token), range(10)))
    accepted = [answer.json()["id"] for answer in answers if answer.status_code == 202]
    assert sorted(answer.status_code for answer in answers) == [202] * OWNERS_QUOTA + [429] * 4
    assert call(owners, "DELETE", f"{API}/{accepted[0]}", token).status_code == 204
    refused = owners.submit(small, token)
    assert refused.status_code == 429
    assert refused.json()["detail"].startswith(f"this token has made its {OWNERS_QUOTA} submissions of today")
    assert owners.submit(small, other).status_code == 202
    assert {owners.ended(one)["status"] for one in accepted[1:]} == {"scored"}
    kept = {path.stem for path in (owners.state / "archives").glob("*.zip")}
    assert kept >= set(accepted[1:])
    assert accepted[0] not in kept


def test_a_submission_is_its_owners_until_published(owners: Server, write_archive: Write) -> None:
    mine, other = owners.token("shy"), owners.token("curious")
    one = owners.accepted(write_archive("hidden", 1.1), mine)
    assert owners.ended(one)["public"] is False
    assert one not in {row["id"] for row in rows(owners)}
    assert one not in {row["id"] for row in rows(owners, other)}
    [own] = [row for row in rows(owners, mine) if row["id"] == one]
    assert own["rank"] is None
    assert one not in call(owners, "GET", "/api/v1/leaderboard.csv?config=lattice").text
    assert call(owners, "PATCH", f"{API}/{one}", other, json={"public": True}).status_code == 403
    assert call(owners, "PATCH", f"{API}/{one}", None, json={"public": True}).status_code == 401
    assert call(owners, "PATCH", f"{API}/{one}", mine, json={"public": "perhaps"}).status_code == 422
    assert call(owners, "PATCH", f"{API}/{one}", mine, json={"public": True}).json()["public"] is True
    [shown] = [row for row in rows(owners) if row["id"] == one]
    assert shown["rank"] is not None
    assert call(owners, "PATCH", f"{API}/{one}", mine, json={"public": False}).json()["public"] is False
    assert one not in {row["id"] for row in rows(owners)}


def test_what_is_public_by_setting_stays_public(board: Shared) -> None:
    path = f"{API}/{board.ids['good']}"
    refused = call(board.server, "PATCH", path, board.token, json={"public": False})
    assert (refused.status_code, refused.json()["detail"]) == (403, "every submission is public here")
    assert call(board.server, "GET", path).json()["public"] is True


def test_only_the_owner_deletes_and_then_it_is_gone(owners: Server, write_archive: Write) -> None:
    mine, other = owners.token("tidy"), owners.token("nosy")
    one = owners.accepted(write_archive("short-lived"), mine)
    owners.ended(one)
    call(owners, "PATCH", f"{API}/{one}", mine, json={"public": True})
    assert call(owners, "DELETE", f"{API}/{one}", other).status_code == 403
    assert call(owners, "DELETE", f"{API}/{one}").status_code == 401
    assert one in {row["id"] for row in rows(owners)}
    assert call(owners, "DELETE", f"{API}/{one}", mine).status_code == 204
    for path in (f"{API}/{one}", f"{API}/{one}/result.json", f"/submissions/{one}"):
        assert call(owners, "GET", path).status_code == 404, path
    assert call(owners, "DELETE", f"{API}/{one}", mine).status_code == 404
    assert one not in {row["id"] for row in rows(owners, mine)}
    assert not (owners.state / "archives" / f"{one}.zip").exists()


def test_without_the_setting_no_error_map_is_made(owners: Server, small: Path) -> None:
    one = owners.accepted(small, owners.token("secret truth"))
    owners.ended(one)
    views = call(owners, "GET", f"{API}/{one}/result.json").json()["views"]
    assert views
    for view in views:
        path = f"/submissions/{one}/error-maps/{view['view_id']}.webp"
        assert call(owners, "GET", path).status_code == 404


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("/api/v1/leaderboard?config=street", "no config 'street', expected one of lattice, lattice-orbit"),
        ("/api/v1/leaderboard.csv?config=street", "no config 'street'"),
        (f"{API}/{'x' * 22}", "no such submission"),
        (f"{API}/{'x' * 22}/result.json", "no such submission"),
        ("/api/v2/leaderboard", "Not Found"),
    ],
)
def test_what_is_not_there_is_said(board: Shared, path: str, words: str) -> None:
    answer = call(board.server, "GET", path)
    assert answer.status_code == 404
    assert words in answer.json()["detail"]


def test_a_config_must_be_named(board: Shared) -> None:
    answer = call(board.server, "GET", "/api/v1/leaderboard")
    assert answer.status_code == 422
    assert answer.json()["problems"] == ["query.config: Field required"]


def test_no_answer_is_without_security_headers(board: Shared) -> None:
    for method, path in (("GET", "/"), ("GET", "/healthz"), ("GET", "/nope"), ("POST", API), ("PUT", "/")):
        headers = call(board.server, method, path).headers
        assert "default-src 'none'" in headers["content-security-policy"], path
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert "server" not in headers


@pytest.mark.parametrize("path", ["/", "/healthz"])
def test_a_monitor_may_ask_for_the_head_alone(board: Shared, path: str) -> None:
    answer = call(board.server, "HEAD", path)
    assert (answer.status_code, answer.content) == (200, b"")


def test_an_address_that_asks_too_often_is_held_back(tiny_root: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"reads": "5/hour", "writes": "2/hour", "scorers": 0}
    with running_server(tiny_root, tmp_path / "state", **settings) as server:
        reads = [call(server, "GET", "/openapi.json").status_code for _ in range(7)]
        assert reads == [200] * 5 + [429] * 2
        writes = [call(server, "POST", API).status_code for _ in range(4)]
        assert writes == [401] * 2 + [429] * 2
        assert call(server, "GET", "/healthz").status_code == 200
        held = httpx2.get(server.url, headers={"Accept": "text/html"})
        assert (held.status_code, held.headers["retry-after"]) == (429, "60")
        assert "too many requests from this address" in held.text
        assert "<h1" in held.text


def test_a_damaged_archive_fails_alone(
    tiny_root: Path, tmp_path: Path, small: Path, new_database: Callable[[], str]
) -> None:
    state, db = tmp_path / "state", new_database()
    with running_server(tiny_root, state, db=db, scorers=0) as server:
        token = server.token("alice")
        ids = [server.accepted(small, token) for _ in range(3)]
    kept = state / "archives" / f"{ids[1]}.zip"
    content = bytearray(kept.read_bytes())
    content[2000:2100] = bytes(100)
    kept.write_bytes(content)
    with running_server(tiny_root, state, db=db) as server:
        ended = [server.ended(one) for one in ids]
        assert [one["status"] for one in ended] == ["scored", "failed", "scored"]
        assert "lattice-orbit/" in ended[1]["reason"]
        assert str(state) not in ended[1]["reason"]
        assert {row["id"] for row in rows(server, config="lattice-orbit")} == {ids[0], ids[2]}
