"""Response cache of leaderboard pages: up-to-date content across processes, and a bounded size."""

from __future__ import annotations

import asyncio
import json
import random
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest
from anyio import CapacityLimiter
from fastapi import FastAPI

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.jobs import Outcome
from leaderboard.db.rankings import (
    LeaderboardEntry,
    RankingVersion,
    leaderboard_entries,
    ranking_version,
    ranking_versions,
)
from leaderboard.db.submissions import Upload
from leaderboard.db.tokens import create_token, find_token
from leaderboard.service import open_service
from leaderboard.settings import read_settings
from leaderboard.web.app import make_app
from leaderboard.web.cache import CachedBody, CacheState, CoalescedRead, RenderedBody, ResponseCache, get_or_render
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
    upload = Upload(SubmissionMeta(method=method), "0" * 64, 1, "sha256:0")
    submissions.accept(database, submission_id, record, upload, 1000, public)
    finish_scoring(database, submission_id, method, error)
    return submission_id


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


def get_response(app: FastAPI, address: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Call an ASGI application directly; return status, headers and body."""
    path, _, query = address.partition("?")
    messages: list[dict] = []

    async def receive() -> dict:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: dict) -> None:
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
    asyncio.run(app(scope, receive, send))  # type: ignore[arg-type]
    response_headers = {name.decode(): value.decode() for name, value in messages[0]["headers"]}
    return messages[0]["status"], response_headers, b"".join(message.get("body", b"") for message in messages[1:])


def test_ranking_versions_match_rows_after_random_changes(database: Database, token: str) -> None:
    rng = random.Random(3)
    ids: list[str] = []
    rows_by_version: dict[tuple[str, RankingVersion], list[LeaderboardEntry]] = {}
    for step in range(40):
        action = rng.choice(["add", "add", "hide", "show", "remove"]) if ids else "add"
        if action == "add":
            ids.append(
                add_scored_submission(database, token, f"m{step}", rng.uniform(0.5, 2), public=rng.random() < 0.7)
            )
        elif action == "remove":
            submissions.remove(database, ids.pop(rng.randrange(len(ids))))
        else:
            submissions.publish(database, rng.choice(ids), action == "show")
        versions = ranking_versions(database)
        for config in CONFIGS:
            rows = leaderboard_entries(database, config)
            assert versions.get(config, RankingVersion()) == ranking_version(rows)
            assert rows_by_version.setdefault((config, ranking_version(rows)), rows) == rows


def test_rescored_row_has_new_ranking_version(database: Database, token: str) -> None:
    submission_id = add_scored_submission(database, token, "m", 1.0)
    before = ranking_versions(database)["lattice"]
    jobs.requeue_stale_submissions(database, "sha256:1")
    finish_scoring(database, submission_id, "m", 2.0)
    after = ranking_versions(database)["lattice"]
    assert after.ids == before.ids
    assert after != before


@pytest.mark.parametrize("address", ["/", BOARD, API, CSV])
def test_change_by_one_process_is_visible_in_other(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    first_id = add_scored_submission(database, token, "first method", 1.0)
    first_bodies = [get_response(app, address)[2] for app in apps]
    assert first_bodies[0] == first_bodies[1]
    second_id = add_scored_submission(database, token, "second method", 2.0)
    assert all(b"second method" in get_response(app, address)[2] for app in apps)
    submissions.publish(database, second_id, False)
    assert [get_response(app, address)[2] for app in apps] == first_bodies
    submissions.remove(database, first_id)
    assert all(b"first method" not in get_response(app, address)[2] for app in apps)


@pytest.mark.parametrize("address", ["/", BOARD, API, CSV, "/submissions/{}"])
def test_etag_returns_304_until_leaderboard_changes(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    address = address.format(add_scored_submission(database, token, "slow", 2.0))
    status, headers, body = get_response(apps[0], address)
    assert (status, headers["cache-control"]) == (200, "no-cache")
    for app in apps:
        status, repeated_headers, repeated_body = get_response(
            app, address, if_none_match=f'"x", W/{headers["etag"]}'
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
    submissions.publish(database, submission_id, True)
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


def render(name: str, content: bytes) -> RenderedBody:
    return (name,), content


def test_cache_evicts_least_recently_used_bodies() -> None:
    cache = ResponseCache(100)
    for name in "abc":
        cache.get((name,), partial(render, name, name.encode() * 40))
        cache.get(("a",), lambda: render("a", b"a" * 40))
    assert [bool(cache.lookup((name,))) for name in "abc"] == [True, False, True]
    cache.get(("large",), lambda: render("large", bytes(101)))
    assert not any(cache.lookup((name,)) for name in ("a", "b", "c", "large"))


def test_body_is_cached_under_key_of_rendering() -> None:
    cache = ResponseCache()
    assert cache.get(("old",), lambda: render("new", b"x")).content == b"x"
    assert cache.lookup(("old",)) is None
    assert cache.lookup(("new",)) is not None


def test_concurrent_requests_render_once() -> None:
    cache, times = ResponseCache(), []

    def slow_render() -> RenderedBody:
        times.append(time.monotonic())
        time.sleep(0.05)
        return render("a", b"x")

    async def request_all() -> list[CachedBody]:
        cache_state = CacheState(CoalescedRead(dict), cache, CapacityLimiter(1))
        return await asyncio.gather(*(get_or_render(cache_state, ("a",), slow_render) for _ in range(32)))

    bodies = asyncio.run(request_all())
    assert len(times) == 1
    assert len({id(body) for body in bodies}) == 1


def test_coalesced_read_is_not_older_than_request() -> None:
    reads, lock = [0], threading.Lock()

    def read() -> int:
        with lock:
            reads[0] += 1
            number = reads[0]
        time.sleep(0.01)
        return number

    async def is_fresh(shared: CoalescedRead[int], wait_s: float) -> bool:
        await asyncio.sleep(wait_s)
        before = reads[0]
        return await shared.get() > before

    async def request_all() -> list[bool]:
        shared, rng = CoalescedRead(read), random.Random(5)
        return await asyncio.gather(*(is_fresh(shared, rng.uniform(0, 0.1)) for _ in range(200)))

    assert all(asyncio.run(request_all()))
    assert reads[0] < 200


def test_failed_coalesced_read_raises_for_all_and_is_retried() -> None:
    failures = [OSError("away")]

    def read() -> int:
        if failures:
            raise failures.pop()
        return 7

    async def ask_both() -> tuple[Sequence[BaseException | int], int]:
        shared = CoalescedRead(read)
        first = await asyncio.gather(shared.get(), shared.get(), return_exceptions=True)
        return first, await shared.get()

    first, second = asyncio.run(ask_both())
    assert [type(error) for error in first] == [OSError, OSError]
    assert second == 7


def test_cancelled_request_does_not_cancel_coalesced_read() -> None:
    def read() -> int:
        time.sleep(0.05)
        return 7

    async def cancel_one() -> int:
        shared = CoalescedRead(read)
        cancelled, waiting = asyncio.create_task(shared.get()), asyncio.create_task(shared.get())
        await asyncio.sleep(0.01)
        cancelled.cancel()
        return await waiting

    assert asyncio.run(cancel_one()) == 7
