"""What a service tells its operator: logs without secrets, metrics that add up, health as the database is."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.leaderboard.conftest import Write
from tests.leaderboard.postgres import Postgres, running_postgres
from tests.leaderboard.serving import Server, running_server
from tests.leaderboard.watching import wait_until

PASSWORD = "correct-horse-battery"
WRONG_TOKEN = "rdb_nobody-ever-made-this-token"
UPLOAD = ("POST", "/api/v1/submissions")


@dataclass(frozen=True)
class Run:
    """A service on PostgreSQL that has accepted, refused, lost its database and found it again."""

    server: Server
    token: str
    ids: tuple[str, ...]
    health: tuple[int, ...]
    away: httpx2.Response


def with_password(url: str) -> str:
    """The tests' PostgreSQL trusts everybody, whatever the password."""
    return url.replace("board@", f"board:{PASSWORD}@")


def health(server: Server) -> int:
    return int(httpx2.get(f"{server.url}/healthz", timeout=60).status_code)


def talk_nonsense(server: Server) -> None:
    """Send what is no HTTP, with a header that must not be logged."""
    address = urlsplit(server.url)
    with socket.create_connection((str(address.hostname), int(address.port or 0)), timeout=30) as connection:
        connection.sendall(f"GET / HTTP/9.9 {WRONG_TOKEN}\r\nAuthorization: Bearer {WRONG_TOKEN}\r\n\r\n".encode())
        connection.recv(1000)


def lose_and_find(server: Server, database: Postgres, page: str) -> tuple[tuple[int, ...], httpx2.Response]:
    before = health(server)
    database.kill()
    try:
        away = httpx2.get(page, timeout=60)
        during = health(server)
        wait_until(lambda: any("database away" in line for line in server.log), "the loss is logged")
    finally:
        database.start()
    wait_until(lambda: health(server) == 200, "the database is found again")
    return (before, during, health(server)), away


@pytest.fixture(scope="module")
def run(tiny_root: Path, write_archive: Write, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    folder = tmp_path_factory.mktemp("observing")
    archive = write_archive("small", configs=("lattice-orbit",))
    (folder / "broken.zip").write_bytes(b"no zip")
    with running_postgres() as database:
        db = with_password(database.url)
        with running_server(tiny_root, folder / "state", db=db, public="owner", lease=5) as server:
            token = server.token("alice")
            first = server.accepted(archive, token)
            assert server.submit(archive, WRONG_TOKEN).status_code == 401
            assert server.submit(folder / "broken.zip", token).status_code == 422
            talk_nonsense(server)
            assert server.ended(first)["status"] == "scored"
            page = f"{server.url}/api/v1/submissions/{first}"
            told, away = lose_and_find(server, database, page)
            second = server.accepted(archive, token)
            assert server.ended(second)["status"] == "scored"
            delete = httpx2.delete(page, headers={"Authorization": f"Bearer {token}"})
            assert delete.status_code == 204
            yield Run(server, token, (first, second), told, away)


def test_health_follows_the_database(run: Run) -> None:
    assert run.health == (200, 503, 200)
    assert run.away.status_code == 503
    assert run.away.headers["Retry-After"] == "10"
    assert "try again" in run.away.json()["detail"]
    assert PASSWORD not in run.away.text


def test_logs_are_json_a_line_and_hold_no_secret(run: Run) -> None:
    log = [line for line in run.server.log if line]
    assert log[0] == run.server.url
    events = [json.loads(line) for line in log[1:]]
    for event in events:
        assert {"event", "level", "timestamp"} <= set(event), event
    whole = "\n".join(log)
    for secret in (run.token, run.token[4:], WRONG_TOKEN, PASSWORD, "Authorization", "Bearer", *run.ids):
        assert secret not in whole, f"{secret} is in the log"


def test_logs_tell_what_happened(run: Run) -> None:
    events = [json.loads(line) for line in run.server.log[1:] if line]
    named = {event["event"] for event in events}
    assert {"request", "accepted", "refused", "scoring", "ended", "database away"} <= named
    assert any("nvalid HTTP request" in name for name in named), "uvicorn's own complaints are lost"
    accepted = [event for event in events if event["event"] == "accepted"]
    assert [event["submission"] for event in accepted] == [one[:6] for one in run.ids]
    assert {event["token"] for event in accepted} == {"alice"}
    statuses = {event["status"] for event in events if event["event"] == "request"}
    assert {200, 202, 204, 401, 422, 503} <= statuses


def test_metrics_count_what_was_done(run: Run) -> None:
    answer = httpx2.get(f"{run.server.url}/metrics", timeout=30)
    assert answer.headers["Content-Type"].startswith("text/plain")
    families = {family.name: family for family in text_string_to_metric_families(answer.text)}
    requests = {
        (sample.labels["method"], sample.labels["route"], sample.labels["status"]): sample.value
        for sample in families["rebar_requests"].samples
        if sample.name == "rebar_requests_total"
    }
    assert {status: requests[(*UPLOAD, status)] for status in ("202", "401", "422")} == {
        "202": 2,
        "401": 1,
        "422": 1,
    }
    assert requests[("DELETE", "/api/v1/submissions/{submission_id}", "204")] == 1
    assert requests[("GET", "/healthz", "503")] >= 1
    seconds = {
        (sample.labels["method"], sample.labels["route"]): sample.value
        for sample in families["rebar_request_seconds"].samples
        if sample.name == "rebar_request_seconds_count"
    }
    assert seconds[UPLOAD] == 4
    waiting = {sample.labels["status"]: sample.value for sample in families["rebar_submissions"].samples}
    assert waiting == {"queued": 0, "scoring": 0, "scored": 1, "failed": 0, "deleted": 1}
    for one in run.ids:
        assert one not in answer.text
