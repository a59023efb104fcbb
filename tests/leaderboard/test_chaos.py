"""Kills of server, scorers, database and backups: what is accepted is scored once, and failures are reported."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx2
import numpy as np
import pytest

from leaderboard.db.jobs import MAX_ATTEMPTS
from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import (
    API,
    SCORING,
    Postgres,
    RunPostgres,
    RunServer,
    Server,
    bearer,
    distinct_archive,
    exchange,
    make_token,
    run,
)
from tests.processes import descendants, is_running, processes_below, wait_until
from tests.requirements import Repetitions

UPLOADERS = 2
PAUSE_S = (0.05, 1.5)
REST_S = 0.5
WAIT_S = 120.0
SETTINGS = {"quota": 10_000, "lease_seconds": 2, "workers": 2}


@dataclass
class Uploads:
    """Upload threads, with the ids of accepted submissions and the status codes of all responses."""

    archive: Path
    token: str
    address: Callable[[], str]
    accepted: list[str] = field(default_factory=list)
    begun: list[str] = field(default_factory=list)
    answers: list[int] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)
    numbers: Iterator[int] = field(default_factory=itertools.count)

    def run(self) -> None:
        while not self.ended.is_set():
            archive = distinct_archive(self.archive, next(self.numbers))
            with archive.open("rb") as stream, suppress(httpx2.HTTPError):
                self.begun.append(self.address())
                address, files = self.address() + API, {"archive": stream}
                response = httpx2.post(address, files=files, headers=bearer(self.token), timeout=60)
                self.answers.append(response.status_code)
                if response.status_code == 202:
                    self.accepted.append(response.json()["id"])
            archive.unlink()
            self.ended.wait(REST_S)

    def wait_for(self, more: int) -> None:
        """Wait until ``more`` further uploads are accepted."""
        target = len(self.accepted) + more
        wait_until(lambda: len(self.accepted) >= target, f"{target} uploads are accepted", WAIT_S)


@dataclass
class Service:
    """Server that is restarted after each kill, and its database."""

    running_server: RunServer
    root: Path
    state: Path
    postgres: Postgres | None
    running: ExitStack = field(default_factory=ExitStack)
    server: Server | None = None
    logs: list[list[str]] = field(default_factory=list)
    requeued: Counter[str] = field(default_factory=Counter)

    @property
    def db(self) -> str:
        return "" if self.postgres is None else self.postgres.url

    def start(self) -> None:
        self.running = ExitStack()
        self.server = self.running.enter_context(self.running_server(self.state, db=self.db, **SETTINGS))
        self.logs.append(self.server.log)

    def times_ended(self) -> Counter[str]:
        """Return how often each submission, by the prefix of its id, was finished by any scorer."""
        events = [json.loads(line) for log in self.logs for line in log if line.startswith("{")]
        return Counter(event["submission"] for event in events if event["event"] == "scoring finished")

    def url(self) -> str:
        return "http://127.0.0.1:9" if self.server is None else self.server.url

    def kill_server(self) -> None:
        """Kill only the server process: its child processes must end by themselves."""
        assert self.server is not None
        children = descendants(self.server.process.pid)
        self.server.process.kill()
        self.server.process.wait()
        wait_until(lambda: not any(map(is_running, children)), "what a killed server started has ended")
        self.running.close()
        self.start()

    def kill_scorer(self, rng: np.random.Generator) -> None:
        """Kill a random process that checks or scores an archive."""
        assert self.server is not None
        pid = self.server.process.pid
        scoring = processes_below(pid, SCORING)
        if scoring:
            with suppress(ProcessLookupError):
                os.kill(scoring[rng.integers(len(scoring))], signal.SIGKILL)

    def kill_database(self) -> None:
        """Kill PostgreSQL with all its backends; with SQLite, kill the server, which writes the files itself."""
        if self.postgres is None:
            self.kill_server()
        else:
            self.postgres.kill()
            time.sleep(0.3)
            self.postgres.start()

    def back_up(self, rng: np.random.Generator) -> None:
        """Kill a backup, then make one."""
        command = [sys.executable, "-m", "leaderboard", "backup", str(self.backup), *self.place()]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        time.sleep(rng.uniform(0.5, 2.5))
        process.kill()
        process.wait()
        self.run("backup", self.backup, "--prune")

    def rescore(self) -> None:
        """Queue scored submissions again, against the same dataset."""
        rows = httpx2.get(f"{self.url()}/api/v1/leaderboard?config=lattice-orbit", timeout=60).json()["rows"]
        for row in rows[-2:]:
            if httpx2.get(f"{self.url()}{API}/{row['id']}", timeout=60).json()["status"] == "scored":
                self.run("requeue", row["id"])
                self.requeued[row["id"][:6]] += 1

    def restore(self) -> None:
        """Lose the state folder of a killed server, and restore the backup that was made just before."""
        if self.postgres is not None:
            return
        assert self.server is not None
        self.server.process.kill()
        self.server.process.wait()
        self.running.close()
        self.run("backup", self.backup)
        shutil.rmtree(self.state)
        state = run("backup", self.state, "--state-dir", self.backup)
        assert state.returncode == 0, state.stderr
        self.start()

    def place(self) -> list[str]:
        return ["--state-dir", str(self.state), "--db", self.db]

    def run(self, command: str, *options: object) -> None:
        process = run(command, *options, *self.place())
        assert process.returncode == 0, process.stderr

    @property
    def backup(self) -> Path:
        return self.state.with_name("backup")


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.nightly)])
def service(
    request: pytest.FixtureRequest,
    tiny_root: Path,
    tmp_path: Path,
    running_postgres: RunPostgres,
    running_server: RunServer,
) -> Iterator[Service]:
    with ExitStack() as stack:
        postgres = stack.enter_context(running_postgres()) if request.param == "postgresql" else None
        started_service = Service(running_server, tiny_root, tmp_path / "state", postgres)
        started_service.start()
        yield started_service
        started_service.running.close()


def test_accepted_submissions_are_scored_once(
    service: Service, write_archive: WriteArchive, repetitions: Repetitions
) -> None:
    num_kills = repetitions(6, 30)
    archive = write_archive("chaos", configs=("lattice-orbit",))
    uploads = Uploads(archive, make_token(service.state, "alice", service.db), service.url)
    threads = [threading.Thread(target=uploads.run) for _ in range(UPLOADERS)]
    for thread in threads:
        thread.start()
    rng = np.random.default_rng(20261121)
    kill_actions = [
        service.kill_server,
        lambda: service.back_up(rng),
        lambda: service.kill_scorer(rng),
        service.rescore,
        service.kill_database,
        service.restore,
    ]
    try:
        for k in range(num_kills):
            uploads.wait_for(int(rng.integers(3)))
            time.sleep(rng.uniform(*PAUSE_S))
            kill_actions[k % len(kill_actions)]()
    finally:
        uploads.ended.set()
        for thread in threads:
            thread.join()
    assert service.server is not None
    expected, failed = None, list[str]()
    for submission_id in uploads.accepted:
        submission = service.server.wait_until_ended(submission_id, 300)
        if submission["status"] == "failed":
            assert submission["reason"].startswith(f"scoring was started {MAX_ATTEMPTS} times"), submission[
                "reason"
            ]
            failed.append(submission_id)
            continue
        result = submission["result"]
        assert result["submission"].pop("sha256") == submission["archive_sha256"]
        expected = expected or result
        assert result == expected
    assert len(failed) <= len(uploads.accepted) / 10
    assert len(uploads.accepted) >= num_kills // 2
    assert set(uploads.answers) <= {202, 503}
    rows = httpx2.get(f"{service.url()}/api/v1/leaderboard?config=lattice-orbit", timeout=60).json()["rows"]
    shown = [row["id"] for row in rows]
    # An upload whose response was cut off may have been accepted; its row and archive must then be complete.
    times = service.times_ended()
    assert all(count <= 1 + service.requeued[name] for name, count in times.items())
    assert len(times) >= len(shown) / 2  # A scorer killed right after the commit logs nothing.
    scored = set(uploads.accepted) - set(failed)
    assert scored <= set(shown)
    assert len(shown) - len(scored) <= len(uploads.begun) - uploads.answers.count(202)
    service.run("check", "--data", service.root, "--hash-archives")  # Rows and archives agree.
    service.run("backup", service.backup, "--prune")
    folders = (service.backup, service.state)
    backed_up, stored = ({path.name for path in (folder / "archives").iterdir()} for folder in folders)
    assert backed_up <= stored


PASSWORD = "correct-horse-battery"
WRONG_TOKEN = "rdb_nobody-ever-made-this-token"


def test_database_outage_is_answered_and_logs_have_no_secrets(
    small_archive: Path, tmp_path: Path, running_server: RunServer, running_postgres: RunPostgres
) -> None:
    (tmp_path / "broken.zip").write_bytes(b"no zip")
    with running_postgres() as database:
        db = database.url.replace("board@", f"board:{PASSWORD}@")  # The server ignores the password.
        with running_server(db=db, default_visibility="owner", lease_seconds=5) as server:
            token = server.token("alice")
            first = server.submit_accepted(small_archive, token)
            assert server.submit(small_archive, WRONG_TOKEN).status_code == 401
            assert server.submit(tmp_path / "broken.zip", token).status_code == 422
            invalid = f"GET / HTTP/9.9 {WRONG_TOKEN}\r\nAuthorization: Bearer {WRONG_TOKEN}\r\n\r\n"
            exchange(server.url, invalid.encode())
            assert server.wait_until_ended(first)["status"] == "scored"
            assert server.get("/healthz").status_code == 200
            database.kill()
            away, health = server.get(f"{API}/{first}"), server.get("/healthz")
            wait_until(lambda: any("database unavailable" in line for line in server.log), "the loss is logged")
            database.start()
            wait_until(lambda: server.get("/healthz").status_code == 200, "the database is found again")
            second = server.submit_accepted(small_archive, token)
            assert server.wait_until_ended(second)["status"] == "scored"
    assert (away.status_code, away.headers["Retry-After"], health.status_code) == (503, "10", 503)
    assert "try again" in away.json()["detail"]
    assert PASSWORD not in away.text
    events = [json.loads(line) for line in server.log if line and line != server.url]
    assert all({"event", "level", "timestamp"} <= set(event) for event in events)
    uploads = {"upload accepted", "upload rejected", "scoring started", "scoring finished"}
    assert {event["event"] for event in events} >= {"request", "database unavailable", *uploads}
    for secret in (token[4:], WRONG_TOKEN, PASSWORD, "Authorization", "Bearer", first, second):
        assert not any(secret in line for line in server.log), f"{secret} is in the log"


def test_health_tells_of_a_lost_dataset(tiny_root: Path, tmp_path: Path, running_server: RunServer) -> None:
    data = tmp_path / "data"
    data.mkdir()
    for path in tiny_root.iterdir():
        (data / path.name).symlink_to(path)
    with running_server(root=data, workers=1) as server:
        assert server.get("/healthz").json()["status"] == "ok"
        (data / "manifest.json").unlink()
        response = server.get("/healthz")
        assert (response.status_code, response.json()["status"]) == (503, "failing")
        assert response.json()["problems"] == ["the manifest of the dataset cannot be read"]
