"""Content of pages across processes: each change is visible in all, and status 304 where there is none."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from fastapi import FastAPI

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.tokens import create_token
from leaderboard.service import open_service
from leaderboard.web.app import make_app
from tests.leaderboard.boards import (
    add_scored_submission,
    board_settings,
    digest_of_board,
    finish_scoring,
    get_response,
)
from tests.synthetic_dataset import write_dataset

BOARD, API, CSV = (f"{path}?config=lattice" for path in ("/", "/api/v1/leaderboard", "/api/v1/leaderboard.csv"))


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    """Yield the database of a leaderboard whose dataset is beside the state folder."""
    write_dataset(tmp_path / "dataset", ["lattice", "pile"], 1)
    with closing(Database(f"sqlite:///{tmp_path / 'state' / 'leaderboard.sqlite'}")) as opened:
        opened.create_schema()
        jobs.serve_dataset(opened, digest_of_board(opened), rescore=False)
        yield opened


@pytest.fixture
def token(database: Database) -> str:
    return create_token(database, "alice")


@pytest.fixture
def apps(database: Database, tmp_path: Path) -> Iterator[list[FastAPI]]:
    """Return two applications on the same database, like two server processes."""
    settings = board_settings(tmp_path / "state", data=str(tmp_path / "dataset"))
    with ExitStack() as stack:
        yield [make_app(stack.enter_context(open_service(settings))) for _ in range(2)]


def test_version_counts_changes_of_shown_content_alone(database: Database, token: str) -> None:
    def changes(change: Callable[[], object]) -> bool:
        before = database.content_version()
        change()
        return database.content_version() > before

    one = add_scored_submission(database, token, "m", 1.0)
    assert changes(lambda: add_scored_submission(database, token, "n", 1.0))
    assert changes(lambda: submissions.change(database, one, {"public": False}))
    assert changes(lambda: submissions.change(database, one, {"details": '{"licence": "MIT"}'}))
    assert changes(lambda: jobs.serve_dataset(database, "sha256:1", True))
    assert not changes(lambda: jobs.claim(database, "scorer", 60))
    assert not changes(lambda: jobs.renew(database, one, "scorer", 60))
    assert not changes(lambda: jobs.release(database, one, "scorer"))
    assert changes(lambda: finish_scoring(database, one, "m", 2.0))
    assert changes(lambda: jobs.requeue(database, [one]))
    assert changes(lambda: submissions.remove(database, one))


@pytest.mark.slow
@pytest.mark.parametrize("address", ["/", BOARD, API, CSV])
def test_change_by_one_process_is_visible_in_other(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    first_id = add_scored_submission(database, token, "first method", 1.0)
    first_bodies = [get_response(app, address)[2] for app in apps]
    assert first_bodies[0] == first_bodies[1]
    second_id = add_scored_submission(database, token, "second method", 2.0)
    assert all(b"second method" in get_response(app, address)[2] for app in apps)
    submissions.change(database, second_id, {"public": False})
    assert [get_response(app, address)[2] for app in apps] == first_bodies
    submissions.remove(database, first_id)
    assert all(b"first method" not in get_response(app, address)[2] for app in apps)


@pytest.mark.slow
@pytest.mark.parametrize("address", ["/", BOARD, API, CSV, "/submissions/{}"])
def test_etag_returns_304_until_leaderboard_changes(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    address = address.format(add_scored_submission(database, token, "slow", 2.0))
    status, headers, body = get_response(apps[0], address)
    assert (status, headers["cache-control"]) == (200, "no-cache")
    if address != CSV:  # It is too short.
        assert gzip.decompress(get_response(apps[0], address, accept_encoding="gzip")[2]) == body
    for app in apps:
        status, repeated_headers, repeated_body = get_response(
            app, address, if_none_match=f'"x", {headers["etag"]}'
        )
        assert (status, repeated_body, repeated_headers["etag"]) == (304, b"", headers["etag"])
        assert "content-security-policy" in repeated_headers
    add_scored_submission(database, token, "fast", 1.0)  # This one is ranked first.
    status, changed_headers, changed_body = get_response(apps[0], address, if_none_match=headers["etag"])
    assert status == 200
    assert changed_headers["etag"] != headers["etag"]
    assert changed_body != body


@pytest.mark.slow
def test_private_rows_of_token_are_not_stored(apps: list[FastAPI], database: Database, token: str) -> None:
    submission_id = add_scored_submission(database, token, "secret method", 1.0, public=False)
    for address in (API, CSV):
        status, headers, own_body = get_response(apps[0], address, authorization=f"Bearer {token}")
        assert (status, headers["cache-control"]) == (200, "no-store")
        assert b"secret method" in own_body
        assert b"secret method" not in get_response(apps[0], address)[2]
    status, headers, page = get_response(apps[0], f"/submissions/{submission_id}")
    assert (status, headers["cache-control"]) == (200, "no-store")
    assert b"Not on the leaderboard" in page
    submissions.change(database, submission_id, {"public": True})
    assert b"Not on the leaderboard" not in get_response(apps[0], f"/submissions/{submission_id}")[2]
    submissions.remove(database, submission_id)
    assert get_response(apps[0], f"/submissions/{submission_id}")[0] == 404
