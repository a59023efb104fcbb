"""kill -9 of the server, of scorers and of the database: every accepted submission ends once, none is lost."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from leaderboard.db.jobs import MOST_ATTEMPTS
from tests.leaderboard.conftest import Write
from tests.leaderboard.postgres import Postgres, running_postgres
from tests.leaderboard.processes import descendants, runs
from tests.leaderboard.serving import Server, make_token, running_server
from tests.leaderboard.watching import SCORER, SCORING, processes_below, wait_until

KILLS = 25
"""On each of the two databases."""
UPLOADERS = 2
PAUSE_S = (0.05, 1.5)
REST_S = 0.5
WAIT_S = 120.0
SETTINGS: dict[str, Any] = {
    "quota": 10_000,
    "lease": 2,
    "reads": "1000000/minute",
    "writes": "1000000/minute",
    "scorers": 2,
}


@dataclass
class Uploads:
    """Threads that upload without a pause, and what was accepted: ids by what the server answered."""

    archive: Path
    token: str
    address: Callable[[], str]
    accepted: list[str] = field(default_factory=list)
    begun: list[str] = field(default_factory=list)
    answers: list[int] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        while not self.ended.is_set():
            with self.archive.open("rb") as stream, suppress(httpx2.HTTPError):
                self.begun.append(self.address())
                answer = httpx2.post(
                    f"{self.address()}/api/v1/submissions",
                    files={"archive": stream},
                    headers={"Authorization": f"Bearer {self.token}"},
                    timeout=60,
                )
                self.answers.append(answer.status_code)
                if answer.status_code == 202:
                    self.accepted.append(answer.json()["id"])
            self.ended.wait(REST_S)

    def wait_for(self, more: int) -> None:
        """Wait until so many more are accepted."""
        enough = len(self.accepted) + more
        wait_until(lambda: len(self.accepted) >= enough, f"{enough} uploads are accepted", WAIT_S)


@dataclass
class Service:
    """A server that is started again whenever it was killed, and its database."""

    root: Path
    state: Path
    postgres: Postgres | None
    running: ExitStack = field(default_factory=ExitStack)
    server: Server | None = None
    logs: list[list[str]] = field(default_factory=list)

    @property
    def db(self) -> str:
        return "" if self.postgres is None else self.postgres.url

    def start(self) -> None:
        self.running = ExitStack()
        self.server = self.running.enter_context(running_server(self.root, self.state, db=self.db, **SETTINGS))
        self.logs.append(self.server.log)

    def times_ended(self) -> Counter[str]:
        """Return how often each submission, by the start of its id, was ended by a scorer of any server's."""
        events = [json.loads(line) for log in self.logs for line in log if line.startswith("{")]
        return Counter(event["submission"] for event in events if event["event"] == "ended")

    def url(self) -> str:
        return "http://127.0.0.1:9" if self.server is None else self.server.url

    def kill_server(self) -> None:
        """Kill the server alone: what it started has to end by itself."""
        assert self.server is not None
        children = descendants(self.server.process.pid)
        self.server.process.kill()
        self.server.process.wait()
        wait_until(lambda: not any(map(runs, children)), "what a killed server started has ended")
        self.running.close()
        self.start()

    def kill_scorer(self, rng: np.random.Generator) -> None:
        """Kill one of the processes that score: a scorer, or what it started for an archive."""
        assert self.server is not None
        pid = self.server.process.pid
        scoring = [*processes_below(pid, SCORER), *processes_below(pid, SCORING)]
        if scoring:
            with suppress(ProcessLookupError):
                os.kill(scoring[rng.integers(len(scoring))], signal.SIGKILL)

    def kill_database(self) -> None:
        """Kill PostgreSQL with all its backends; SQLite is the server's own files, which die with it."""
        if self.postgres is None:
            self.kill_server()
        else:
            self.postgres.kill()
            time.sleep(0.3)
            self.postgres.start()


@pytest.fixture(params=["sqlite", "postgresql"])
def service(request: pytest.FixtureRequest, tiny_root: Path, tmp_path: Path) -> Iterator[Service]:
    with ExitStack() as stack:
        postgres = stack.enter_context(running_postgres()) if request.param == "postgresql" else None
        made = Service(tiny_root, tmp_path / "state", postgres)
        made.start()
        yield made
        made.running.close()


def test_every_accepted_submission_ends_once(service: Service, write_archive: Write) -> None:
    archive = write_archive("chaos", configs=("lattice-orbit",))
    uploads = Uploads(archive, make_token(service.state, "alice", service.db), service.url)
    threads = [threading.Thread(target=uploads.run) for _ in range(UPLOADERS)]
    for thread in threads:
        thread.start()
    rng = np.random.default_rng(20261121)
    kinds = [service.kill_server, lambda: service.kill_scorer(rng), service.kill_database]
    try:
        for k in range(KILLS):
            uploads.wait_for(int(rng.integers(3)))
            time.sleep(rng.uniform(*PAUSE_S))
            kinds[k % 3]()
    finally:
        uploads.ended.set()
        for thread in threads:
            thread.join()
    assert service.server is not None
    expected, failed = None, list[str]()
    for submission_id in uploads.accepted:
        ended = service.server.ended(submission_id, 300)
        if ended["status"] == "failed":
            assert ended["reason"].startswith(f"scoring was begun {MOST_ATTEMPTS} times"), ended["reason"]
            failed.append(submission_id)
            continue
        expected = expected or ended["result"]
        assert ended["result"] == expected
    assert len(failed) <= len(uploads.accepted) / 10
    assert len(uploads.accepted) >= KILLS // 2
    assert set(uploads.answers) <= {202, 503}
    rows = httpx2.get(f"{service.url()}/api/v1/leaderboard?config=lattice-orbit", timeout=60).json()["rows"]
    shown = [row["id"] for row in rows]
    # An upload whose answer was cut off may have been accepted: its row and archive are then as whole as others.
    times = service.times_ended()
    assert set(times.values()) == {1}
    assert len(times) >= len(shown) / 2  # a scorer that is killed at once after the commit says nothing
    scored = set(uploads.accepted) - set(failed)
    assert scored <= set(shown)
    assert len(shown) - len(scored) <= len(uploads.begun) - uploads.answers.count(202)
    kept = {path.stem for path in (service.state / "archives").glob("*.zip")}
    assert set(shown) <= kept
