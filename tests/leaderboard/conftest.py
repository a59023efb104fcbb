"""Servers that most of these tests share, with submissions of every kind, and the browser."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from rebar_depth_bench import SubmissionWriter, load
from tests.leaderboard.postgres import Postgres, running_postgres
from tests.leaderboard.serving import Server, make_token, running_server

HOSTILE = "<script>alert(1)</script>\"'&amp;{{ 7 * 7 }}"
DESCRIPTION = "first line\n<b>second</b>\u202egnp\x1b[31m"

Write = Callable[..., Path]


@dataclass(frozen=True)
class Shared:
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
def write_archive(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Write:
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
def postgres() -> Iterator[Postgres]:
    """A PostgreSQL server for all tests."""
    with running_postgres() as server:
        yield server


@pytest.fixture(scope="session", params=["sqlite", "postgresql"])
def new_database(request: pytest.FixtureRequest) -> Callable[[], str]:
    """Make empty databases, given as ``--db`` takes them: what stands on this runs on SQLite and on PostgreSQL."""
    if request.param == "sqlite":
        return lambda: ""
    server: Postgres = request.getfixturevalue("postgres")
    return lambda: server.new_database(f"board_{secrets.token_hex(4)}")


@pytest.fixture(scope="session")
def board(
    tiny_root: Path,
    write_archive: Write,
    tmp_path_factory: pytest.TempPathFactory,
    new_database: Callable[[], str],
) -> Iterator[Shared]:
    """A server that scores, with a board of five submissions and error maps of two views."""
    db, state = new_database(), tmp_path_factory.mktemp("board") / "state"
    archives = {
        "good": write_archive("good", 1.01, url="https://example.org/good", description="plain words"),
        "near": write_archive("near", 0.8, uses_intrinsics=True),
        "far": write_archive("far", 2.5, configs=("lattice",)),
        "holes": write_archive("holes", 1.0, 0.3),
        "hostile": write_archive(HOSTILE, 1.4, description=DESCRIPTION, url="https://example.org/?a=1&b=<i>"),
    }
    with running_server(tiny_root, state, db=db, error_maps=2, quota=100, reads="60000/minute") as server:
        token = server.token("Müller & <Söhne>")
        ids = {name: server.accepted(path, token) for name, path in archives.items()}
        for submission_id in ids.values():
            assert server.ended(submission_id)["status"] == "scored"
        yield Shared(server, token, ids)


@pytest.fixture(scope="session")
def waiting(
    tiny_root: Path,
    write_archive: Write,
    tmp_path_factory: pytest.TempPathFactory,
    new_database: Callable[[], str],
) -> Iterator[Shared]:
    """A server that scores nothing, where owners publish: a failed, a scored and two queued submissions."""
    db, state = new_database(), tmp_path_factory.mktemp("waiting") / "state"
    token = make_token(state, "bob", db)
    common: dict[str, Any] = {"db": db, "public": "owner", "error_maps": 1}
    archive = write_archive("slow")
    with running_server(tiny_root, state, score_time=0.01, **common) as server:
        failed = server.accepted(archive, token)
        assert server.ended(failed)["status"] == "failed"
    with running_server(tiny_root, state, **common) as server:
        scored = server.accepted(archive, token)
        assert server.ended(scored)["status"] == "scored"
    with running_server(tiny_root, state, scorers=0, quota=5, max_upload=2_000_000, **common) as server:
        ids = {"failed": failed, "scored": scored}
        ids |= {name: server.accepted(archive, token) for name in ("next", "later")}
        yield Shared(server, token, ids)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """The system's Chromium, headless. Without one these tests fail: the pages are then not shown to work.

    Playwright's event loop runs as long as this lives, so it ends with the module: others have loops of their own.
    """
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.fail("there is no chromium on the PATH, expected the system's: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()
