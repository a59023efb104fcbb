"""Kept answers: they are what would be made now, whichever process changed the board, and no more are kept."""

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

from benchmarks.filled_board import varied
from benchmarks.synthetic_dataset import write_dataset
from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.jobs import Outcome
from leaderboard.db.rankings import BoardRow, Stamp, board, stamp_of, stamps, standings
from leaderboard.db.submissions import Upload
from leaderboard.db.tokens import create_token, find_token
from leaderboard.settings import read_settings
from leaderboard.web.app import make_app
from leaderboard.web.cache import Body, KeptBodies, Made, SharedRead, Shelf, shelved
from leaderboard.web.context import open_service
from rebar_depth_bench.submission import SubmissionMeta
from tests.bench.reporting.results import result, scored

CONFIGS = ("lattice", "pile")
BOARD, API, CSV = (
    "/?config=lattice",
    "/api/v1/leaderboard?config=lattice",
    "/api/v1/leaderboard.csv?config=lattice",
)


def add(database: Database, token: str, method: str, error: float, *, public: bool = True) -> str:
    """Put a scored submission of both configs on the board, as a server and a scorer do."""
    record = find_token(database, token)
    assert record is not None
    submission_id = submissions.new_id()
    upload = Upload(SubmissionMeta(method), "0" * 64, 1, "sha256:0")
    submissions.accept(database, submission_id, record, upload, 1000, public)
    score(database, submission_id, method, error)
    return submission_id


def score(database: Database, submission_id: str, method: str, error: float) -> None:
    assert jobs.claim(database, "scorer", 60) == submission_id
    found = result(scored("lattice/0000"), scored("pile/0000"), method=method).to_dict()
    assert jobs.finish(database, submission_id, "scorer", Outcome(json.dumps(varied(found, error)).encode()))


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
    """Two applications on one database, as two servers would be."""
    settings = read_settings(None, {"data": str(data), "state": tmp_path / "state"})
    with ExitStack() as stack:
        yield [make_app(stack.enter_context(open_service(settings))) for _ in range(2)]


def ask(app: FastAPI, address: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Ask an application without a server between; return status, headers, body."""
    path, _, query = address.partition("?")
    sent: list[dict] = []

    async def receive() -> dict:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: dict) -> None:
        sent.append(message)

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
    told = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], told, b"".join(message.get("body", b"") for message in sent[1:])


def test_stamps_are_those_of_the_rows_whatever_happens(database: Database, token: str) -> None:
    rng = random.Random(3)
    ids: list[str] = []
    seen: dict[tuple[str, Stamp], list[BoardRow]] = {}
    for step in range(40):
        kind = rng.choice(["add", "add", "hide", "show", "remove"]) if ids else "add"
        if kind == "add":
            ids.append(add(database, token, f"m{step}", rng.uniform(0.5, 2), public=rng.random() < 0.7))
        elif kind == "remove":
            submissions.remove(database, ids.pop(rng.randrange(len(ids))))
        else:
            submissions.publish(database, rng.choice(ids), kind == "show")
        now = stamps(database)
        for config in CONFIGS:
            rows = board(database, config)
            assert now.get(config, Stamp()) == stamp_of(rows) == stamp_of(standings(database, config))
            assert seen.setdefault((config, stamp_of(rows)), rows) == rows


def test_a_row_that_is_scored_anew_has_another_stamp(database: Database, token: str) -> None:
    one = add(database, token, "m", 1.0)
    before = stamps(database)["lattice"]
    jobs.queue_again(database, "sha256:1")
    score(database, one, "m", 2.0)
    after = stamps(database)["lattice"]
    assert after.ids == before.ids
    assert after != before


@pytest.mark.parametrize("address", ["/", BOARD, API, CSV])
def test_what_one_process_changes_the_other_shows_at_once(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    kept = add(database, token, "first method", 1.0)
    first = [ask(app, address)[2] for app in apps]
    assert first[0] == first[1]
    other = add(database, token, "second method", 2.0)
    assert all(b"second method" in ask(app, address)[2] for app in apps)
    submissions.publish(database, other, False)
    assert [ask(app, address)[2] for app in apps] == first
    submissions.remove(database, kept)
    assert all(b"first method" not in ask(app, address)[2] for app in apps)


@pytest.mark.parametrize("address", ["/", BOARD, API, CSV, "/submissions/{}"])
def test_who_has_an_answer_is_told_so_until_it_changes(
    apps: list[FastAPI], database: Database, token: str, address: str
) -> None:
    address = address.format(add(database, token, "slow", 2.0))
    status, told, body = ask(apps[0], address)
    assert (status, told["cache-control"]) == (200, "no-cache")
    for app in apps:
        status, again, nothing = ask(app, address, if_none_match=f'"x", W/{told["etag"]}')
        assert (status, nothing, again["etag"]) == (304, b"", told["etag"])
        assert "content-security-policy" in again
    add(database, token, "fast", 1.0)  # takes the first rank
    status, changed, other = ask(apps[0], address, if_none_match=told["etag"])
    assert status == 200
    assert changed["etag"] != told["etag"]
    assert other != body


def test_a_token_s_own_rows_are_never_kept_for_others(apps: list[FastAPI], database: Database, token: str) -> None:
    hidden = add(database, token, "secret method", 1.0, public=False)
    for address in (API, CSV):
        status, told, own = ask(apps[0], address, authorization=f"Bearer {token}")
        assert (status, told["cache-control"]) == (200, "no-store")
        assert b"secret method" in own
        assert b"secret method" not in ask(apps[0], address)[2]
    status, told, page = ask(apps[0], f"/submissions/{hidden}")
    assert (status, told["cache-control"]) == (200, "no-store")
    assert b"Not on the board" in page
    submissions.publish(database, hidden, True)
    assert b"Not on the board" not in ask(apps[0], f"/submissions/{hidden}")[2]
    submissions.remove(database, hidden)
    assert ask(apps[0], f"/submissions/{hidden}")[0] == 404


def test_orders_and_addresses_are_kept_apart(apps: list[FastAPI], database: Database, token: str) -> None:
    for number in range(3):
        add(database, token, f"m{number}", 1.0 + number)
    addresses = ["/", BOARD, f"{BOARD}&sort=-rmse", "/?config=pile", API, CSV]
    bodies = [ask(apps[0], address)[2] for address in addresses]
    assert len(set(bodies)) == len(bodies)
    assert [ask(apps[0], address)[2] for address in addresses] == bodies


def made(name: str, content: bytes) -> Made:
    return (name,), content


def test_no_more_bytes_are_kept_than_are_allowed_and_the_last_asked_for_stay() -> None:
    kept = KeptBodies(100)
    for name in "abc":
        kept.get((name,), partial(made, name, name.encode() * 40))
        kept.get(("a",), lambda: made("a", b"a" * 40))
    assert [bool(kept.found((name,))) for name in "abc"] == [True, False, True]
    kept.get(("large",), lambda: made("large", bytes(101)))
    assert not any(kept.found((name,)) for name in ("a", "b", "c", "large"))


def test_a_body_is_kept_under_what_it_was_made_of() -> None:
    kept = KeptBodies()
    assert kept.get(("old",), lambda: made("new", b"x")).content == b"x"
    assert kept.found(("old",)) is None
    assert kept.found(("new",)) is not None


def test_of_many_who_want_the_same_one_makes_it() -> None:
    kept, times = KeptBodies(), []

    def make() -> Made:
        times.append(time.monotonic())
        time.sleep(0.05)
        return made("a", b"x")

    async def many() -> list[Body]:
        shelf = Shelf(SharedRead(dict), kept, CapacityLimiter(1))
        return await asyncio.gather(*(shelved(shelf, ("a",), make) for _ in range(32)))

    found = asyncio.run(many())
    assert len(times) == 1
    assert len({id(one) for one in found}) == 1


def test_a_shared_read_is_never_older_than_its_request() -> None:
    reads, lock = [0], threading.Lock()

    def read() -> int:
        with lock:
            reads[0] += 1
            number = reads[0]
        time.sleep(0.01)
        return number

    async def one(shared: SharedRead[int], wait_s: float) -> bool:
        await asyncio.sleep(wait_s)
        before = reads[0]
        return await shared.get() > before

    async def many() -> list[bool]:
        shared, rng = SharedRead(read), random.Random(5)
        return await asyncio.gather(*(one(shared, rng.uniform(0, 0.1)) for _ in range(200)))

    assert all(asyncio.run(many()))
    assert reads[0] < 200


def test_a_shared_read_that_fails_tells_all_and_is_tried_again() -> None:
    failures = [OSError("away")]

    def read() -> int:
        if failures:
            raise failures.pop()
        return 7

    async def ask_both() -> tuple[Sequence[BaseException | int], int]:
        shared = SharedRead(read)
        first = await asyncio.gather(shared.get(), shared.get(), return_exceptions=True)
        return first, await shared.get()

    first, second = asyncio.run(ask_both())
    assert [type(one) for one in first] == [OSError, OSError]
    assert second == 7


def test_who_goes_away_takes_no_answer_from_others() -> None:
    def read() -> int:
        time.sleep(0.05)
        return 7

    async def leave() -> int:
        shared = SharedRead(read)
        gone, stays = asyncio.create_task(shared.get()), asyncio.create_task(shared.get())
        await asyncio.sleep(0.01)
        gone.cancel()
        return await stays

    assert asyncio.run(leave()) == 7
