"""Servers that most of these tests share, with submissions of every kind, archives, and the browser."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from leaderboard.db import jobs, submissions
from leaderboard.db.tokens import create_token
from leaderboard.scoring.sandbox import Outcome
from rebar_depth_bench import SubmissionWriter, load
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.scoring.columns import METRICS
from rebar_depth_bench.scoring.result import DatasetIdentity
from rebar_depth_bench.submission.declaration import Declaration
from tests.bench.reporting.results import changed, result, scored_view
from tests.leaderboard import serving
from tests.leaderboard.boards import OTHER_DIGEST, accept, board_settings, claimed, opened
from tests.leaderboard.serving import Postgres, RunPostgres, RunServer, Server, make_token

HOSTILE = "<script>alert(1)</script>\"'&amp;{{ 7 * 7 }}"
DESCRIPTION = "first line\n<b>second</b>\u202egnp\x1b[31m"

WriteArchive = Callable[..., Path]
"""Type of the function that the fixture of the same name returns."""


@dataclass(frozen=True)
class SharedServer:
    """A server, a token of it, and the ids of its submissions by what they are."""

    server: Server
    token: str
    ids: Mapping[str, str]

    @property
    def url(self) -> str:
        return self.server.url

    def page(self, kind: str) -> str:
        """Return the address of a submission's page."""
        return f"{self.url}/submissions/{self.ids[kind]}"


@pytest.fixture(scope="session")
def write_archive(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> WriteArchive:
    """Write the true depth times ``scale`` as an archive; a share of ``holes`` has no prediction."""
    columns = ["view_id", "left_depth"]
    truth = {
        config: [(row["view_id"], row["left_depth"]) for row in load(tiny_root, config, columns=columns)]
        for config in ("lattice", "lattice-orbit")
    }

    def write(
        method: str,
        scale: float = 1.0,
        holes: float = 0.0,
        configs: tuple[str, ...] = ("lattice", "lattice-orbit"),
        **meta: Any,
    ) -> Path:
        path = tmp_path_factory.mktemp("archive") / "submission.zip"
        rng = np.random.default_rng(7)
        with SubmissionWriter(path, method, **meta) as writer:
            for view_id, depth_m in (view for config in configs for view in truth[config]):
                noisy_m = scale * depth_m * (1 + 0.01 * rng.standard_normal(depth_m.shape))
                writer.add(view_id, np.where(rng.random(depth_m.shape) < holes, 0.0, noisy_m).astype(np.float32))
        return path

    return write


@pytest.fixture(scope="session")
def small_archive(write_archive: WriteArchive) -> Path:
    """Write an archive of the two views of ``lattice-orbit`` by the method ``small``."""
    return write_archive("small", configs=("lattice-orbit",))


@pytest.fixture(scope="session")
def running_server(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> RunServer:
    """Run ``rebar-leaderboard serve`` until a block ends: of the tiny dataset and in a new folder unless given."""

    def run(
        state: Path | None = None, *, root: Path = tiny_root, **options: Any
    ) -> AbstractContextManager[Server]:
        return serving.running_server(root, state or tmp_path_factory.mktemp("board") / "state", **options)

    return run


@pytest.fixture(scope="session")
def running_postgres() -> RunPostgres:
    """Run a PostgreSQL server of its own until a block ends."""
    return serving.running_postgres


@pytest.fixture(scope="session")
def postgres(running_postgres: RunPostgres) -> Iterator[Postgres]:
    """Run one PostgreSQL server for all tests."""
    with running_postgres() as server:
        yield server


@pytest.fixture(scope="session", params=["sqlite", "postgresql"])
def new_database(request: pytest.FixtureRequest) -> Callable[[], str]:
    """Make empty databases, given as ``--db`` takes them: once on SQLite and once on PostgreSQL."""
    if request.param == "sqlite":
        return lambda: ""
    server: Postgres = request.getfixturevalue("postgres")
    return lambda: server.new_database(f"board_{secrets.token_hex(4)}")


@contextmanager
def filled_board(running_server: RunServer, write_archive: WriteArchive, db: str = "") -> Iterator[SharedServer]:
    """Run a server that scores, with five scored submissions."""
    archives = {
        "good": write_archive("good", 1.01, url="https://example.org/good", description="plain words"),
        "near": write_archive("near", 0.8, inputs="rgb+K", uses_ground_truth=False),
        "far": write_archive("far", 2.5, configs=("lattice",)),
        "holes": write_archive("holes", 1.0, 0.3, inputs="stereo", uses_ground_truth=True),
        "hostile": write_archive(HOSTILE, 1.4, description=DESCRIPTION, url="https://example.org/?a=1&b=<i>"),
    }
    with running_server(db=db, quota=100) as server:
        token = server.token("Müller & <Söhne>")
        ids = {name: server.submit_accepted(path, token) for name, path in archives.items()}
        for submission_id in ids.values():
            assert server.wait_until_ended(submission_id)["status"] == "scored"
        yield SharedServer(server, token, ids)


@pytest.fixture(scope="session")
def board(write_archive: WriteArchive, running_server: RunServer) -> Iterator[SharedServer]:
    """Run the server with five submissions on SQLite."""
    with filled_board(running_server, write_archive) as shared:
        yield shared


@pytest.fixture(scope="session")
def waiting(
    write_archive: WriteArchive, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[SharedServer]:
    """A server that scores nothing, where owners publish: a failed, a scored and two queued submissions."""
    state = tmp_path_factory.mktemp("waiting") / "state"
    token, archive = make_token(state, "bob"), write_archive("slow")
    common: dict[str, Any] = {"default_visibility": "owner"}
    ids = {}
    for name, limits in (("failed", {"score_time": 0.01}), ("scored", {})):
        with running_server(state, workers=0, **common) as server:
            ids[name] = server.submit_accepted(archive, token)
        with running_server(state, **limits, **common) as server:
            assert server.wait_until_ended(ids[name])["status"] == name
    with running_server(state, workers=0, quota=5, max_upload=2_000_000, **common) as server:
        ids |= {name: server.submit_accepted(archive, token) for name in ("next", "later")}
        yield SharedServer(server, token, ids)


LONG_NAME = "a method whose name is as long as a name may be, " * 4 + "full"
"""Name of 200 characters."""
LINKS = {"dataset_url": "https://example.org/data", "paper_url": "https://example.org/paper"}


@pytest.fixture(scope="session")
def crowded(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[SharedServer]:
    """A server that scores nothing, with rows of ``lattice`` of every kind.

    ``worse`` is a second row of ``method 3``, and ``truth`` declares the use of ground truth.
    """
    state, digest = tmp_path_factory.mktemp("crowded") / "state", open_folder(tiny_root).digest
    errors = {f"method {number}": 0.02 + 0.01 * number for number in range(12)}
    errors |= {"baseline": 0.3, "worse": 0.5, LONG_NAME: 0.05, "huge": 9.0, "truth": 0.01, "outdated": 0.01}
    ids = {}
    with opened(board_settings(state)) as (database, _):
        jobs.serve_dataset(database, digest, rescore=False)
        token = create_token(database, "x" * 100)
        organiser = serving.run("token", "org", "--baseline", "--state-dir", state).stdout.strip()
        for name, error in errors.items():
            view = scored_view("lattice/0000", error)
            if name == "huge":
                native = zip(METRICS, (1e30, 1e32, 1e32, 0.0), strict=True)
                errors = {f"native.{metric}": value for metric, value in native}
                view = changed(view, {"rank_error": 1.0, "scale": 1e-30, **errors})
            views = [replace(view, view_id=f"lattice/{8 * index:04d}") for index in range(80)]
            method = "method 3" if name == "worse" else name
            content = result(*views, method=method, declared=Declaration("rgb", name == "truth"))
            scored_on = OTHER_DIGEST if name == "outdated" else digest
            content = replace(content, dataset=DatasetIdentity(scored_on, "1"))
            ids[name] = accept(database, organiser if name == "baseline" else token, method=method)
            assert claimed(database, "scorer") == ids[name]
            assert jobs.finish(database, ids[name], "scorer", Outcome(scored_on, content.to_json()))
            details = json.dumps({"seconds_per_view": 1e18, "code_url": "https://example.org/code"})
            declared = {"inputs": "rgb", "uses_ground_truth": name == "truth", "details": details}
            submissions.change(database, ids[name], declared)
        kept = {"status": "scored", "archive_deleted_at": time.time()}
        submissions.change(database, ids["outdated"], kept)
    with running_server(state, workers=0, **LINKS) as server:
        yield SharedServer(server, token, ids)


@pytest.fixture(scope="module")
def chromium(chromium_program: str) -> Iterator[Browser]:
    """The system's Chromium, headless.

    Playwright's event loop runs as long as this lives, so it ends with the module: others have loops of their own.
    """
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_program, args=["--no-sandbox"])
        yield browser
        browser.close()
