"""The queue, on SQLite and on PostgreSQL: every job is had by one scorer, and ends once."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.jobs import MOST_ATTEMPTS, Outcome
from leaderboard.db.models import SubmissionRecord, TokenRecord
from leaderboard.db.rankings import board
from leaderboard.db.submissions import QuotaSpentError, Upload
from leaderboard.db.tokens import create_token, find_token, replace_token
from leaderboard.settings import read_settings
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.submission import SubmissionMeta
from tests.bench.reporting.results import result, scored

LEASE_S = 60.0


@pytest.fixture
def database(new_database: Callable[[], str], tmp_path: Path) -> Iterator[Database]:
    settings = read_settings(None, {"data": "", "state": tmp_path, "db": new_database()})
    with closing(Database(settings.database_url)) as opened:
        opened.migrate()
        yield opened


@pytest.fixture
def alice(database: Database) -> TokenRecord:
    found = find_token(database, create_token(database, "alice"))
    assert found is not None
    return found


def queue(database: Database, token: TokenRecord, count: int, quota: int = 1000) -> list[str]:
    ids = [submissions.new_id() for _ in range(count)]
    for submission_id in ids:
        upload = Upload(SubmissionMeta("m"), "0" * 64, 5, "sha256:0")
        submissions.accept(database, submission_id, token, upload, quota, True)
    return ids


def record(database: Database, submission_id: str) -> SubmissionRecord:
    found = submissions.find(database, submission_id)
    assert found is not None
    return found


def test_the_oldest_is_had_first(database: Database, alice: TokenRecord) -> None:
    ids = queue(database, alice, 3)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(4)] == [*ids, None]


def test_of_many_scorers_one_has_each_job(database: Database, alice: TokenRecord) -> None:
    ids = queue(database, alice, 40)

    def take(name: str) -> list[str]:
        had = []
        while submission_id := jobs.claim(database, name, LEASE_S):
            had.append(submission_id)
            assert jobs.renew(database, submission_id, name, LEASE_S)
            assert jobs.finish(database, submission_id, name, Outcome(reason=name))
        return had

    with ThreadPoolExecutor(8) as pool:
        had = list(pool.map(take, [f"s{k}" for k in range(8)]))
    assert sorted(one for part in had for one in part) == sorted(ids)
    for k, part in enumerate(had):
        assert {record(database, one).reason for one in part} <= {f"s{k}"}


def test_a_scorer_taken_for_dead_ends_nothing(database: Database, alice: TokenRecord) -> None:
    [one] = queue(database, alice, 1)
    assert jobs.claim(database, "slow", 0.05) == one
    time.sleep(0.1)
    assert jobs.claim(database, "quick", LEASE_S) == one
    assert not jobs.renew(database, one, "slow", LEASE_S)
    assert not jobs.finish(database, one, "slow", Outcome(reason="slow"))
    jobs.give_back(database, one, "slow")
    assert record(database, one).status == "scoring"
    assert jobs.finish(database, one, "quick", Outcome(reason="quick"))
    assert not jobs.finish(database, one, "quick", Outcome(reason="twice"))
    assert (record(database, one).status, record(database, one).reason) == ("failed", "quick")


def test_a_lease_that_ended_and_was_not_taken_is_renewed(database: Database, alice: TokenRecord) -> None:
    [one] = queue(database, alice, 1)
    assert jobs.claim(database, "s", 0.01) == one
    time.sleep(0.05)
    assert jobs.renew(database, one, "s", LEASE_S)
    assert jobs.claim(database, "other", LEASE_S) is None


def test_what_kills_every_scorer_fails_and_the_next_is_had(database: Database, alice: TokenRecord) -> None:
    [bad] = queue(database, alice, 1)
    for _ in range(MOST_ATTEMPTS):
        assert jobs.claim(database, "s", 0.0) == bad
        time.sleep(0.01)
    [good] = queue(database, alice, 1)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(2)] == [good, None]
    assert record(database, bad).status == "failed"
    assert record(database, bad).reason == f"scoring was begun {MOST_ATTEMPTS} times and never came to an end"


def test_what_a_scorer_died_of_waits_behind_the_others(database: Database, alice: TokenRecord) -> None:
    bad, second, third = queue(database, alice, 3)
    assert jobs.claim(database, "s", 0.0) == bad
    time.sleep(0.01)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(4)] == [second, third, bad, None]


def test_what_is_given_back_costs_no_attempt(database: Database, alice: TokenRecord) -> None:
    [one] = queue(database, alice, 1)
    for _ in range(3 * MOST_ATTEMPTS):
        assert jobs.claim(database, "s", LEASE_S) == one
        jobs.give_back(database, one, "s")
    assert (record(database, one).status, record(database, one).attempts) == ("queued", 0)


def test_scored_again_leaves_one_result(database: Database, alice: TokenRecord) -> None:
    [one] = queue(database, alice, 1)
    first, second = (result(scored("lattice/0000", error)).to_json() for error in (0.5, 0.25))
    jobs.claim(database, "a", 0.0)
    time.sleep(0.01)
    jobs.claim(database, "b", LEASE_S)
    pictures = {"lattice/0000": b"webp"}
    assert jobs.finish(database, one, "b", Outcome(result=second, pictures=pictures))
    assert not jobs.finish(database, one, "a", Outcome(result=first))
    assert submissions.result_json(database, one) == second
    [row] = board(database, "lattice")
    assert row.table == json.loads(second)["tables"]["lattice"]


def test_a_submission_deleted_in_mid_scoring_stays_deleted(database: Database, alice: TokenRecord) -> None:
    [one] = queue(database, alice, 1)
    jobs.claim(database, "s", LEASE_S)
    submissions.remove(database, one)
    assert not jobs.renew(database, one, "s", LEASE_S)
    assert not jobs.finish(database, one, "s", Outcome(result=result(scored("lattice/0000", 0.5)).to_json()))
    assert submissions.find(database, one) is None
    assert submissions.result_json(database, one) is None
    assert board(database, "lattice") == []


def test_the_last_place_of_the_quota_is_given_once(database: Database, alice: TokenRecord) -> None:
    def try_one(_: int) -> bool:
        try:
            queue(database, alice, 1, quota=3)
        except QuotaSpentError:
            return False
        return True

    with ThreadPoolExecutor(12) as pool:
        assert sum(pool.map(try_one, range(12))) == 3


def test_a_token_is_found_by_itself_alone(database: Database) -> None:
    token = create_token(database, "bob")
    assert find_token(database, token) is not None
    assert [find_token(database, other) for other in (token[:-1], token + "x", token.lower(), "", "bob")] == [
        None
    ] * 5


def test_what_had_to_wait_lets_others_go_first(database: Database, alice: TokenRecord) -> None:
    first, second = queue(database, alice, 2)
    assert jobs.claim(database, "s", LEASE_S) == first
    jobs.give_back(database, first, "s", wait_s=0.2)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(2)] == [second, None]
    time.sleep(0.3)
    assert jobs.claim(database, "s", LEASE_S) == first


def test_a_token_that_is_replaced_is_void(database: Database) -> None:
    old = create_token(database, "bob")
    new = replace_token(database, "bob")
    assert find_token(database, old) is None
    found = find_token(database, new)
    assert found is not None
    assert found.name == "bob"
    with pytest.raises(InputError, match="there is no token for 'eve'"):
        replace_token(database, "eve")
