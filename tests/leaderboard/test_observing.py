"""Observability of a service: logs without secrets, and health with and without a database."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import httpx2
import pytest

from tests.leaderboard.serving import Postgres, RunPostgres, RunServer, Server
from tests.processes import wait_until

PASSWORD = "correct-horse-battery"
WRONG_TOKEN = "rdb_nobody-ever-made-this-token"


@dataclass(frozen=True)
class ServiceRun:
    """Service on PostgreSQL that has accepted and rejected uploads and survived a database outage."""

    server: Server
    token: str
    ids: tuple[str, ...]
    health: tuple[int, ...]
    away: httpx2.Response


def with_password(url: str) -> str:
    """Return ``url`` with a password, which the PostgreSQL server of the tests ignores."""
    return url.replace("board@", f"board:{PASSWORD}@")


def health(server: Server) -> int:
    return int(httpx2.get(f"{server.url}/healthz", timeout=60).status_code)


def send_invalid_http(server: Server) -> None:
    """Send an invalid HTTP request with a header that must not be logged."""
    address = urlsplit(server.url)
    with socket.create_connection((str(address.hostname), int(address.port or 0)), timeout=30) as connection:
        connection.sendall(f"GET / HTTP/9.9 {WRONG_TOKEN}\r\nAuthorization: Bearer {WRONG_TOKEN}\r\n\r\n".encode())
        connection.recv(1000)


def restart_database(server: Server, database: Postgres, page: str) -> tuple[tuple[int, ...], httpx2.Response]:
    before = health(server)
    database.kill()
    try:
        away = httpx2.get(page, timeout=60)
        during = health(server)
        wait_until(lambda: any("database unavailable" in line for line in server.log), "the loss is logged")
    finally:
        database.start()
    wait_until(lambda: health(server) == 200, "the database is found again")
    return (before, during, health(server)), away


@pytest.fixture(scope="module")
def run(
    small_archive: Path,
    tmp_path_factory: pytest.TempPathFactory,
    running_server: RunServer,
    running_postgres: RunPostgres,
) -> Iterator[ServiceRun]:
    folder = tmp_path_factory.mktemp("observing")
    (folder / "broken.zip").write_bytes(b"no zip")
    with running_postgres() as database:
        db = with_password(database.url)
        with running_server(folder / "state", db=db, default_visibility="owner", lease_seconds=5) as server:
            token = server.token("alice")
            first = server.submit_accepted(small_archive, token)
            assert server.submit(small_archive, WRONG_TOKEN).status_code == 401
            assert server.submit(folder / "broken.zip", token).status_code == 422
            send_invalid_http(server)
            assert server.wait_until_ended(first)["status"] == "scored"
            page = f"{server.url}/api/v1/submissions/{first}"
            health_codes, away = restart_database(server, database, page)
            second = server.submit_accepted(small_archive, token)
            assert server.wait_until_ended(second)["status"] == "scored"
            delete = httpx2.delete(page, headers={"Authorization": f"Bearer {token}"})
            assert delete.status_code == 204
            # A request is logged after its response has been sent.
            wait_until(lambda: any('"status": 204' in line for line in server.log), "the deletion is logged")
            yield ServiceRun(server, token, (first, second), health_codes, away)


def test_health_is_503_during_database_outage(run: ServiceRun) -> None:
    assert run.health == (200, 503, 200)
    assert run.away.status_code == 503
    assert run.away.headers["Retry-After"] == "10"
    assert "try again" in run.away.json()["detail"]
    assert PASSWORD not in run.away.text


def test_logs_are_json_lines_without_secrets(run: ServiceRun) -> None:
    log = [line for line in run.server.log if line]
    assert log[0] == run.server.url
    events = [json.loads(line) for line in log[1:]]
    for event in events:
        assert {"event", "level", "timestamp"} <= set(event), event
    text = "\n".join(log)
    for secret in (run.token, run.token[4:], WRONG_TOKEN, PASSWORD, "Authorization", "Bearer", *run.ids):
        assert secret not in text, f"{secret} is in the log"


def test_logs_contain_expected_events(run: ServiceRun) -> None:
    events = [json.loads(line) for line in run.server.log[1:] if line]
    event_names = {event["event"] for event in events}
    assert {
        "request",
        "upload accepted",
        "upload rejected",
        "scoring started",
        "scoring finished",
        "database unavailable",
    } <= event_names
    assert any("nvalid HTTP request" in name for name in event_names), "messages of uvicorn are not logged"
    accepted = [event for event in events if event["event"] == "upload accepted"]
    assert [event["submission"] for event in accepted] == [submission_id[:6] for submission_id in run.ids]
    assert {event["token"] for event in accepted} == {"alice"}
    statuses = {event["status"] for event in events if event["event"] == "request"}
    assert {200, 202, 204, 401, 422, 503} <= statuses
