"""Response cache of leaderboard pages: up-to-date content across processes, and a bounded size."""

from __future__ import annotations

import asyncio
import gzip
import random
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI
from leaderboard.web.cache import CacheMiddleware
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import Receive, Scope, Send

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.models import increment_content_version
from leaderboard.db.tokens import create_token
from leaderboard.service import open_service
from leaderboard.web.app import make_app
from tests.leaderboard.boards import add_scored_submission, board_settings, call, finish_scoring, get_response
from tests.synthetic_dataset import write_dataset

BOARD, API, CSV = (f"{path}?config=lattice" for path in ("/", "/api/v1/leaderboard", "/api/v1/leaderboard.csv"))


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    """Yield the database of a leaderboard whose dataset is beside the state folder."""
    write_dataset(tmp_path / "dataset", ["lattice", "pile"], 1)
    with closing(Database(f"sqlite:///{tmp_path / 'state' / 'leaderboard.sqlite'}")) as opened:
        opened.migrate()
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
    assert changes(lambda: jobs.requeue_stale(database, "sha256:1", {one}, True))
    assert not changes(lambda: jobs.claim(database, "scorer", 60))
    assert not changes(lambda: jobs.renew(database, one, "scorer", 60))
    assert not changes(lambda: jobs.release(database, one, "scorer"))
    assert changes(lambda: finish_scoring(database, one, "m", 2.0))
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
        compressed = [get_response(apps[0], address, accept_encoding="gzip") for _ in range(2)]
        assert [gzip.decompress(one[2]) for one in compressed] == [body] * 2, "it is compressed once"
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
def test_private_rows_of_token_are_not_cached(apps: list[FastAPI], database: Database, token: str) -> None:
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


@dataclass
class Renderer:
    """ASGI application whose responses state the path and how often it was called."""

    cache_control: bytes = b"no-cache"
    status: int = 200
    size: int = 1
    delay_s: float = 0.0
    calls: list[str] = field(default_factory=list)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.calls.append(scope["path"])
        await asyncio.sleep(self.delay_s)
        headers = [(b"cache-control", self.cache_control), (b"content-type", b"text/plain")]
        await send({"type": "http.response.start", "status": self.status, "headers": headers})
        body = f"{scope['path']} {len(self.calls)} ".encode() * self.size
        await send({"type": "http.response.body", "body": body, "more_body": True})
        await send({"type": "http.response.body", "body": b"end"})


def cached(database: Any, **options: Any) -> tuple[CacheMiddleware, Renderer]:
    """Return the cache before a renderer with the given options, and the renderer."""
    limits = {name: options.pop(name) for name in ("max_bytes",) if name in options}
    renderer = Renderer(**options)
    return CacheMiddleware(renderer, database=database, identity="", **limits), renderer


def test_response_is_rendered_once_per_url_host_and_version(database: Database) -> None:
    app, renderer = cached(database)
    for address in ("/a", "/a", "/b", "/a?x=1", "/a"):
        get_response(app, address)
    assert renderer.calls == ["/a", "/b", "/a"]
    assert get_response(app, "/a")[2] == b"/a 1 end"
    get_response(app, "/a", host="other.example")
    assert len(renderer.calls) == 4, "pages may contain the address of the service"
    with database.write() as session:
        increment_content_version(session)
    assert get_response(app, "/a")[2] == b"/a 5 end"


@pytest.mark.parametrize(("cache_control", "status"), [(b"no-store", 200), (b"no-cache", 404)])
def test_other_responses_are_passed_on(database: Database, cache_control: bytes, status: int) -> None:
    app, _ = cached(database, cache_control=cache_control, status=status)
    answers = [get_response(app, "/a") for _ in range(2)]
    assert [(found, body) for found, _, body in answers] == [(status, b"/a 1 end"), (status, b"/a 2 end")]
    assert all("etag" not in headers for _, headers, _ in answers)


def test_request_with_token_is_passed_on(database: Database) -> None:
    app, _ = cached(database)
    get_response(app, "/a")
    assert get_response(app, "/a", authorization="Bearer x")[2] == b"/a 2 end"


def test_full_cache_is_emptied_and_stays_correct(database: Database) -> None:
    app, renderer = cached(database, size=20, max_bytes=250)
    for name in "aabcab":
        assert get_response(app, f"/{name}")[2].startswith(f"/{name} ".encode())
    assert renderer.calls[:3] == ["/a", "/b", "/c"]
    assert len(renderer.calls) > 3, "the limit holds fewer than three responses"


def test_response_is_kept_compressed_and_not(database: Database) -> None:
    renderer = Renderer(size=500)
    app = CacheMiddleware(GZipMiddleware(renderer), database=database, identity="")
    _, headers, body = get_response(app, "/a")
    for accepted in ("br, gzip", "gzip;q=0.5", "*, gzip"):  # None of them is a key of its own.
        _, compressed_headers, compressed = get_response(app, "/a", accept_encoding=accepted)
    assert (headers["vary"], compressed_headers["vary"]) == ("Accept-Encoding", "Accept-Encoding")
    assert compressed_headers["content-encoding"] == "gzip"
    assert len(compressed) < len(body) / 10
    assert gzip.decompress(compressed) == body.replace(b" 1 ", b" 2 ")
    assert renderer.calls == ["/a", "/a"]


def test_concurrent_requests_render_once(database: Database) -> None:
    app, _ = cached(database, delay_s=0.05)

    async def request_all() -> list[bytes]:
        return [body for _, _, body in await asyncio.gather(*(call(app, "/a") for _ in range(32)))]

    assert asyncio.run(request_all()) == [b"/a 1 end"] * 32


class NumberedReads:
    """Database of a server whose every read takes a while and returns its number; the first may fail."""

    file = None

    def __init__(self, *, fails: bool = False) -> None:
        self.reads, self.fails = 0, fails

    def content_version(self) -> int:
        self.reads += 1
        time.sleep(0.002)
        if self.fails:
            self.fails = False
            raise PoolTimeoutError
        return self.reads


def test_version_is_not_older_than_the_request() -> None:
    database = NumberedReads()
    app, _ = cached(database)

    async def is_fresh(wait_s: float) -> bool:
        await asyncio.sleep(wait_s)
        before = database.reads
        etag = (await call(app, "/a"))[1]["etag"]
        return int(etag.rpartition("-")[2].rstrip('"')) > before

    async def request_all() -> list[bool]:
        rng = random.Random(5)
        return await asyncio.gather(*(is_fresh(rng.uniform(0, 0.1)) for _ in range(50)))

    assert all(asyncio.run(request_all()))


def test_failed_read_is_passed_on_and_retried() -> None:
    app, _ = cached(NumberedReads(fails=True))
    assert "etag" not in get_response(app, "/a")[1]
    assert "etag" in get_response(app, "/a")[1]
