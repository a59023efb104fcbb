"""Database on SQLite and PostgreSQL: schema, tokens, and the queue of jobs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from pathlib import Path
from threading import Barrier

import pytest
from sqlalchemy import Engine, create_engine, inspect

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.jobs import MAX_ATTEMPTS
from leaderboard.db.models import SCHEMA, Base
from leaderboard.db.rankings import read_ranking
from leaderboard.db.submissions import result_content, shown_results
from leaderboard.db.tokens import create_token, find_token, list_tokens, replace_token, revoke_token
from leaderboard.scoring.sandbox import Outcome
from leaderboard.settings import MAX_LEASE_S
from rebar_depth_bench.base.errors import InputError
from tests.bench.reporting.results import result, scored_view
from tests.leaderboard.boards import DIGEST, accept, board_settings, claimed, result_bytes

LEASE_S = 60.0


@pytest.fixture
def url(new_database: Callable[[], str], tmp_path: Path) -> str:
    """Return the SQLAlchemy URL of an empty database."""
    return board_settings(tmp_path, db=new_database()).database_url


@pytest.fixture
def database(url: str) -> Iterator[Database]:
    with closing(Database(url)) as opened:
        opened.create_schema()
        yield opened


@pytest.fixture
def alice(database: Database) -> str:
    return create_token(database, "alice")


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    """Yield a separate engine for the database."""
    new_engine = create_engine(url)
    yield new_engine
    new_engine.dispose()


def test_tables_are_created_once_beside_those_of_others(url: str, engine: Engine) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE foreign_table (id INTEGER)")
    for turn in range(2):
        with closing(Database(url)) as database:
            database.create_schema()
            if not turn:
                token = create_token(database, "alice")
            assert find_token(database, token) is not None
    assert set(inspect(engine).get_table_names()) == {*Base.metadata.tables, "foreign_table"}


@pytest.mark.slow
def test_tables_are_created_by_services_at_once(url: str) -> None:
    with ExitStack() as stack:
        services = [stack.enter_context(closing(Database(url))) for _ in range(6)]
        start = Barrier(len(services))

        def create(database: Database) -> None:
            start.wait()
            database.create_schema()

        with ThreadPoolExecutor(len(services)) as pool:
            list(pool.map(create, services))
        services[0].check_schema()


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ("UPDATE board SET schema = 4", "schema 4"),
        ("DROP TABLE board", "no schema of this service"),
    ],
)
def test_database_of_another_version_is_refused(
    database: Database, engine: Engine, change: str, found: str
) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql(change)
    for use in (database.create_schema, database.check_schema):
        with pytest.raises(InputError, match=f"the database has {found}, expected schema {SCHEMA}, or a new"):
            use()


def queue(database: Database, token: str, count: int) -> list[str]:
    return [accept(database, token) for _ in range(count)]


def status_and_reason(database: Database, submission_id: str) -> tuple[str, str | None]:
    record = submissions.find(database, submission_id)
    assert record is not None
    return record.status, record.reason


@pytest.mark.slow
def test_each_job_is_claimed_by_one_scorer(database: Database, alice: str) -> None:
    ids = queue(database, alice, 40)

    def take(name: str) -> list[str]:
        taken = []
        while submission_id := claimed(database, name, LEASE_S):
            taken.append(submission_id)
            assert jobs.renew(database, submission_id, name, LEASE_S)
            assert jobs.finish(database, submission_id, name, Outcome(DIGEST, reason=name))
        return taken

    with ThreadPoolExecutor(8) as pool:
        taken_by_scorer = list(pool.map(take, [f"s{k}" for k in range(8)]))
    assert sorted(submission_id for taken in taken_by_scorer for submission_id in taken) == sorted(ids)
    for k, taken in enumerate(taken_by_scorer):
        assert {status_and_reason(database, submission_id)[1] for submission_id in taken} <= {f"s{k}"}


def test_scorer_with_expired_lease_cannot_finish(database: Database, alice: str) -> None:
    [submission_id] = queue(database, alice, 1)
    assert claimed(database, "slow", 0.05) == submission_id
    time.sleep(0.1)
    assert claimed(database, "quick", LEASE_S) == submission_id
    assert not jobs.renew(database, submission_id, "slow", LEASE_S)
    assert not jobs.finish(database, submission_id, "slow", Outcome(DIGEST, reason="slow"))
    jobs.release(database, submission_id, "slow")
    assert status_and_reason(database, submission_id)[0] == "scoring"
    assert jobs.finish(database, submission_id, "quick", Outcome(DIGEST, reason="quick"))
    assert not jobs.finish(database, submission_id, "quick", Outcome(DIGEST, reason="twice"))
    assert status_and_reason(database, submission_id) == ("failed", "quick")


def test_expired_unclaimed_lease_can_be_renewed(database: Database, alice: str) -> None:
    [submission_id] = queue(database, alice, 1)
    assert claimed(database, "s", 0.01) == submission_id
    time.sleep(0.05)
    assert jobs.renew(database, submission_id, "s", LEASE_S)
    assert claimed(database, "other", LEASE_S) is None


def test_job_fails_after_max_attempts_and_next_is_claimed(database: Database, alice: str) -> None:
    [bad] = queue(database, alice, 1)
    for _ in range(MAX_ATTEMPTS):
        assert claimed(database, "s", 0.0) == bad
        time.sleep(0.01)
    [good] = queue(database, alice, 1)
    assert [claimed(database, "s", LEASE_S) for _ in range(2)] == [good, None]
    status, reason = status_and_reason(database, bad)
    assert status == "failed"
    assert reason is not None
    assert f"started {MAX_ATTEMPTS} times" in reason


def test_jobs_are_claimed_by_age_and_that_of_a_dead_scorer_last(database: Database, alice: str) -> None:
    bad, second, third = queue(database, alice, 3)
    assert claimed(database, "s", 0.0) == bad
    time.sleep(0.01)
    assert [claimed(database, "s", LEASE_S) for _ in range(4)] == [second, third, bad, None]


def test_released_job_costs_no_attempt(database: Database, alice: str) -> None:
    [submission_id] = queue(database, alice, 1)
    for _ in range(3 * MAX_ATTEMPTS):
        assert claimed(database, "s", LEASE_S) == submission_id
        jobs.release(database, submission_id, "s")
    record = submissions.find(database, submission_id)
    assert record is not None
    assert (record.status, record.attempts) == ("queued", 0)


@pytest.mark.slow
def test_released_job_with_wait_is_claimed_later(database: Database, alice: str) -> None:
    first, second = queue(database, alice, 2)
    assert claimed(database, "s", LEASE_S) == first
    jobs.release(database, first, "s", wait_s=0.2)
    assert [claimed(database, "s", LEASE_S) for _ in range(2)] == [second, None]
    time.sleep(0.3)
    assert claimed(database, "s", LEASE_S) == first


def test_job_scored_twice_has_one_result(database: Database, alice: str) -> None:
    [submission_id] = queue(database, alice, 1)
    first, second = (result(scored_view("lattice/0000", error)).to_json() for error in (0.5, 0.25))
    claimed(database, "a", 0.0)
    time.sleep(0.01)
    claimed(database, "b", LEASE_S)
    assert jobs.finish(database, submission_id, "b", Outcome(DIGEST, second, ["a note"]))
    assert not jobs.finish(database, submission_id, "a", Outcome(DIGEST, first))
    record = submissions.find(database, submission_id)
    assert record is not None
    shown = shown_results(database, [record], DIGEST)[submission_id]
    assert result_content(database, submission_id, shown) == (second, ["a note"])
    [row] = read_ranking(database, "lattice", DIGEST).entries
    assert json.loads(row.table_json) == json.loads(second)["tables"]["lattice"]


def test_submission_deleted_while_scoring_stays_deleted(database: Database, alice: str) -> None:
    [submission_id] = queue(database, alice, 1)
    claimed(database, "s", LEASE_S)
    submissions.remove(database, submission_id)
    assert not jobs.renew(database, submission_id, "s", LEASE_S)
    assert not jobs.finish(database, submission_id, "s", Outcome(DIGEST, result_bytes(DIGEST)))
    assert submissions.find(database, submission_id) is None
    assert read_ranking(database, "lattice", DIGEST).entries == ()


@pytest.mark.parametrize("status", ["queued", "scoring"])
def test_clock_that_was_set_back_blocks_no_job(
    database: Database, alice: str, monkeypatch: pytest.MonkeyPatch, status: str
) -> None:
    [submission_id] = queue(database, alice, 1)
    assert claimed(database, "s", MAX_LEASE_S) == submission_id
    if status == "queued":
        jobs.release(database, submission_id, "s", wait_s=MAX_LEASE_S)
    assert claimed(database, "other", 1.0) is None, "a lease of another worker may be longer"
    yesterday = time.time() - 86400
    monkeypatch.setattr(time, "time", lambda: yesterday)
    assert status_and_reason(database, submission_id)[0] == status
    assert claimed(database, "other", LEASE_S) == submission_id


def test_token_is_found_only_by_exact_value(database: Database, alice: str) -> None:
    assert find_token(database, alice) is not None
    others = (alice[:-1], alice + "x", alice.lower(), "", "alice")
    assert [find_token(database, other) for other in others] == [None] * 5


def test_revoked_or_replaced_token_is_void(database: Database, alice: str) -> None:
    revoke_token(database, "alice")
    assert find_token(database, alice) is None
    [(name, _, revoked_at, *amounts)] = list_tokens(database)
    assert (name, revoked_at is None, amounts) == ("alice", False, [0, 0])
    second = replace_token(database, "alice")
    third = replace_token(database, "alice")
    record = find_token(database, third)
    assert record is not None
    assert (record.name, find_token(database, second)) == ("alice", None)
    for change in (revoke_token, replace_token):
        with pytest.raises(InputError, match="no token for 'eve'"):
            change(database, "eve")


@pytest.mark.parametrize("name", ["", " ", "x" * 101, "a\udcff", "a\0"])
def test_impossible_token_names_are_refused_in_words(database: Database, name: str) -> None:
    for make in (create_token, replace_token, revoke_token):
        with pytest.raises(InputError, match="the token name is"):
            make(database, name)
    assert list_tokens(database) == []
