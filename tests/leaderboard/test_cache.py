"""Response cache of leaderboard pages: up-to-date content across processes, and a bounded size."""

from __future__ import annotations

import asyncio
import gzip
import json
import random
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from fastapi import FastAPI
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.models import increment_content_version
from leaderboard.db.submissions import Quota, Upload
from leaderboard.db.tokens import create_token, find_token
from leaderboard.scoring.sandbox import Outcome
from leaderboard.service import open_service
from leaderboard.settings import read_settings
from leaderboard.web.app import make_app
from leaderboard.web.cache import CacheMiddleware
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.submission import SubmissionMeta
from tests.bench.reporting.results import result, scored_view
from tests.synthetic_dataset import scale_errors, write_dataset

CONFIGS = ("lattice", "pile")
BOARD, API, CSV = (
    "/?config=lattice",
    "/api/v1/leaderboard?config=lattice",
    "/api/v1/leaderboard.csv?config=lattice",
)


def add_scored_submission(
    database: Database, token: str, method: str, error: float, *, public: bool = True
) -> str:
    """Insert a scored submission of both configs, as a server and a scorer do."""
    record = find_token(database, token)
    assert record is not None
    submission_id = submissions.new_id()
    upload = Upload(SubmissionMeta(method=method), submission_id * 2, 1, digest_of_board(database))
    submissions.accept(database, submission_id, record, upload, Quota(1000, 1 << 40), public)
    finish_scoring(database, submission_id, method, error)
    return submission_id


def digest_of_board(database: Database) -> str:
    """Return the digest of the dataset that is beside the state folder, if there is one."""
    assert database.file is not None
    root = database.file.parents[1] / "dataset"
    return open_folder(root).digest if root.is_dir() else "sha256:0"


def finish_scoring(database: Database, submission_id: str, method: str, error: float) -> None:
    assert jobs.claim(database, "scorer", 60) == submission_id
    result_dict = result(scored_view("lattice/0000"), scored_view("pile/0000"), method=method).to_dict()
    assert jobs.finish(
        database, submission_id, "scorer", Outcome(json.dumps(scale_errors(result_dict, error)).encode())
    )


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "dataset", CONFIGS, 1)
    return tmp_path / "dataset"


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    opened = Database(f"sqlite:///{tmp_path / 'state' / 'leaderboard.sqlite'}")
    opened.migrate()
    yield opened
    opened.close()


@pytest.fixture
def token(database: Database) -> str:
    return create_token(database, "alice")


@pytest.fixture
def apps(data: Path, tmp_path: Path) -> Iterator[list[FastAPI]]:
    """Return two applications on the same database, like two server processes."""
    settings = read_settings(None, {"data": str(data), "state_dir": tmp_path / "state"})
    with ExitStack() as stack:
        yield [make_app(stack.enter_context(open_service(settings))) for _ in range(2)]


def get_response(app: ASGIApp, address: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Call an ASGI application directly; return status, headers and body."""
    return asyncio.run(call(app, address, **headers))


async def call(app: ASGIApp, address: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    path, _, query = address.partition("?")
    messages: list[Message] = []

    async def receive() -> Message:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Message) -> None:
        messages.append(message)

    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": "GET",
        "scheme": "http",
        "path": path,
        "raw_path": path.encode(),
        "root_path": "",
        "query_string": query.encode(),
        "headers": [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()],
        "client": ("127.0.0.1", 1),
        "server": ("localhost", 80),
    }
    await app(scope, receive, send)
    response_headers = {name.decode(): value.decode() for name, value in messages[0]["headers"]}
    return messages[0]["status"], response_headers, b"".join(message.get("body", b"") for message in messages[1:])


def test_every_change_of_shown_content_increments_the_version(database: Database, token: str) -> None:
    def version_after(change: Callable[[], object]) -> int:
        before = database.content_version()
        change()
        return database.content_version() - before

    submission_id = add_scored_submission(database, token, "m", 1.0)
    assert version_after(lambda: add_scored_submission(database, token, "n", 1.0)) > 0
    assert version_after(lambda: submissions.change(database, submission_id, {"public": False})) > 0
    assert (
        version_after(lambda: submissions.change(database, submission_id, {"details": '{"licence": "MIT"}'})) > 0
    )
    assert version_after(lambda: jobs.requeue_stale(database, "sha256:1", {submission_id}, True)) > 0
    assert version_after(lambda: finish_scoring(database, submission_id, "m", 2.0)) > 0
    assert version_after(lambda: submissions.remove(database, submission_id)) > 0


def test_claims_and_renewals_keep_the_version(database: Database, token: str) -> None:
    submission_id = add_scored_submission(database, token, "m", 1.0)
    assert jobs.requeue_stale(database, "sha256:1", {submission_id}, True) == 1
    before = database.content_version()
    assert jobs.claim(database, "scorer", 60) == submission_id
    assert jobs.renew(database, submission_id, "scorer", 60)
    jobs.release(database, submission_id, "scorer")
    assert database.content_version() == before


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


@pytest.mark.parametrize("address", ["/", BOARD, API, "/openapi.json"])
def test_responses_are_compressed_once(apps: list[FastAPI], database: Database, token: str, address: str) -> None:
    add_scored_submission(database, token, "m", 2.0)
    plain = get_response(apps[0], address)[2]
    for _ in range(2):
        _, headers, body = get_response(apps[0], address, accept_encoding="gzip")
        assert headers["content-encoding"] == "gzip"
        assert gzip.decompress(body) == plain


@pytest.mark.parametrize("address", ["/", BOARD, API, CSV, "/submissions/{}"])
def test_etag_returns_304_until_leaderboard_changes(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    address = address.format(add_scored_submission(database, token, "slow", 2.0))
    status, headers, body = get_response(apps[0], address)
    assert (status, headers["cache-control"]) == (200, "no-cache")
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


def test_cache_separates_urls_and_sort_orders(apps: list[FastAPI], database: Database, token: str) -> None:
    for number in range(3):
        add_scored_submission(database, token, f"m{number}", 1.0 + number)
    addresses = ["/", BOARD, f"{BOARD}&sort=-rmse", "/?config=pile", API, CSV]
    bodies = [get_response(apps[0], address)[2] for address in addresses]
    assert len(set(bodies)) == len(bodies)
    assert [get_response(apps[0], address)[2] for address in addresses] == bodies


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


def test_response_is_rendered_once_per_url_host_and_version(database: Database) -> None:
    renderer = Renderer()
    app = CacheMiddleware(renderer, database=database, identity="")
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
    renderer = Renderer(cache_control, status)
    app = CacheMiddleware(renderer, database=database, identity="")
    answers = [get_response(app, "/a") for _ in range(2)]
    assert [(found, body) for found, _, body in answers] == [(status, b"/a 1 end"), (status, b"/a 2 end")]
    assert all("etag" not in headers for _, headers, _ in answers)


def test_request_with_token_is_passed_on(database: Database) -> None:
    app = CacheMiddleware(Renderer(), database=database, identity="")
    get_response(app, "/a")
    assert get_response(app, "/a", authorization="Bearer x")[2] == b"/a 2 end"


def test_full_cache_is_emptied_and_stays_correct(database: Database) -> None:
    renderer = Renderer(size=20)
    app = CacheMiddleware(renderer, database=database, identity="", max_bytes=250)
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
    renderer = Renderer(delay_s=0.05)
    app = CacheMiddleware(renderer, database=database, identity="")

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
    database, renderer = NumberedReads(), Renderer()
    app = CacheMiddleware(renderer, database=database, identity="")  # type: ignore[arg-type]

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
    app = CacheMiddleware(Renderer(), database=NumberedReads(fails=True), identity="")  # type: ignore[arg-type]
    assert "etag" not in get_response(app, "/a")[1]
    assert "etag" in get_response(app, "/a")[1]
