"""Content of pages across processes: each change is visible in all, and status 304 where there is none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import httpx2
import pytest
from starlette.testclient import TestClient

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.tokens import create_token
from leaderboard.service import open_service
from leaderboard.web.app import make_app
from rebar_depth_bench.data.manifest import open_folder
from tests.leaderboard.boards import accept, board_settings, score_all
from tests.leaderboard.serving import bearer
from tests.synthetic_dataset import write_dataset

BOARD, API, CSV = (f"{path}?config=lattice" for path in ("/", "/api/v1/leaderboard", "/api/v1/leaderboard.csv"))


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    """Yield the database of a leaderboard whose dataset is beside the state folder."""
    write_dataset(tmp_path / "dataset", ["lattice"], 1)
    with closing(Database(f"sqlite:///{tmp_path / 'state' / 'leaderboard.sqlite'}")) as opened:
        opened.create_schema()
        jobs.serve_dataset(opened, open_folder(tmp_path / "dataset").digest, rescore=False)
        yield opened


@pytest.fixture
def token(database: Database) -> str:
    return create_token(database, "alice")


@pytest.fixture
def clients(database: Database, tmp_path: Path) -> Iterator[list[httpx2.Client]]:
    """Yield clients of two applications on the same database, like two server processes."""
    settings = board_settings(tmp_path / "state", data=str(tmp_path / "dataset"))
    with ExitStack() as stack:
        yield [
            TestClient(make_app(stack.enter_context(open_service(settings))), base_url="http://localhost")
            for _ in range(2)
        ]


def add_scored(database: Database, token: str, method: str, *, public: bool = True) -> str:
    """Add a scored submission and return its id."""
    submission_id = accept(database, token, method=method, public=public)
    score_all(database)
    return submission_id


def test_version_counts_changes_of_shown_content_alone(database: Database, token: str) -> None:
    def changes(change: Callable[[], object]) -> bool:
        before = database.content_version()
        change()
        return database.content_version() > before

    one = add_scored(database, token, "m")
    assert changes(lambda: add_scored(database, token, "n"))
    assert changes(lambda: submissions.change(database, one, {"public": False}))
    assert changes(lambda: submissions.change(database, one, {"details": '{"licence": "MIT"}'}))
    assert changes(lambda: jobs.serve_dataset(database, "sha256:1", True))
    assert not changes(lambda: jobs.claim(database, "scorer", 60))
    assert not changes(lambda: jobs.renew(database, one, "scorer", 60))
    assert not changes(lambda: jobs.release(database, one, "scorer"))
    assert changes(lambda: score_all(database))
    assert changes(lambda: jobs.requeue(database, [one]))
    assert changes(lambda: submissions.remove(database, one))


@pytest.mark.slow
@pytest.mark.parametrize("address", ["/", BOARD, API, CSV])
def test_change_by_one_process_is_visible_in_other(
    clients: list[httpx2.Client], database: Database, token: str, address: str
) -> None:
    first_id = add_scored(database, token, "first method")
    first_texts = [client.get(address).text for client in clients]
    assert first_texts[0] == first_texts[1]
    second_id = add_scored(database, token, "second method")
    assert all("second method" in client.get(address).text for client in clients)
    submissions.change(database, second_id, {"public": False})
    assert [client.get(address).text for client in clients] == first_texts
    submissions.remove(database, first_id)
    assert all("first method" not in client.get(address).text for client in clients)


@pytest.mark.slow
@pytest.mark.parametrize("address", ["/", BOARD, API, CSV, "/submissions/{}"])
def test_etag_returns_304_until_leaderboard_changes(
    clients: list[httpx2.Client], database: Database, token: str, address: str
) -> None:
    address = address.format(add_scored(database, token, "first"))
    plain, packed = (clients[0].get(address, headers={"accept-encoding": name}) for name in ("identity", "gzip"))
    assert (plain.status_code, plain.headers["cache-control"]) == (200, "no-cache")
    assert packed.content == plain.content
    assert (packed.headers.get("content-encoding") == "gzip") == (address != CSV)  # It is too short.
    for client in clients:
        repeated = client.get(address, headers={"if-none-match": f'"x", {plain.headers["etag"]}'})
        assert (repeated.status_code, repeated.content) == (304, b"")
        assert repeated.headers["etag"] == plain.headers["etag"]
        assert "content-security-policy" in repeated.headers
    add_scored(database, token, "second")
    changed = clients[0].get(address, headers={"if-none-match": plain.headers["etag"]})
    assert changed.status_code == 200
    assert changed.headers["etag"] != plain.headers["etag"]
    assert changed.content != plain.content


@pytest.mark.slow
def test_private_rows_of_token_are_not_stored(
    clients: list[httpx2.Client], database: Database, token: str
) -> None:
    submission_id = add_scored(database, token, "secret method", public=False)
    for address in (API, CSV):
        own = clients[0].get(address, headers=bearer(token))
        assert (own.status_code, own.headers["cache-control"]) == (200, "no-store")
        assert "secret method" in own.text
        assert "secret method" not in clients[0].get(address).text
    page = clients[0].get(f"/submissions/{submission_id}")
    assert (page.status_code, page.headers["cache-control"]) == (200, "no-store")
    assert "Not on the leaderboard" in page.text
    submissions.change(database, submission_id, {"public": True})
    assert "Not on the leaderboard" not in clients[0].get(f"/submissions/{submission_id}").text
    submissions.remove(database, submission_id)
    assert clients[0].get(f"/submissions/{submission_id}").status_code == 404
