"""Scoring queue on SQLite and PostgreSQL: each job is claimed by one scorer and finished once."""

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
from leaderboard.db.jobs import MAX_ATTEMPTS
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.rankings import picture_facts, picture_webp, read_ranking
from leaderboard.db.submissions import Quota, QuotaExceededError, Upload
from leaderboard.db.tokens import create_token, find_token, list_tokens, replace_token, revoke_token
from leaderboard.scoring.sandbox import Outcome, ViewPicture
from leaderboard.settings import MAX_LEASE_S, read_settings
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.submission import SubmissionMeta
from tests.bench.reporting.results import result, scored_view

LEASE_S = 60.0


@pytest.fixture
def database(new_database: Callable[[], str], tmp_path: Path) -> Iterator[Database]:
    settings = read_settings(None, {"data": "", "state_dir": tmp_path, "db": new_database()})
    with closing(Database(settings.database_url)) as opened:
        opened.migrate()
        yield opened


@pytest.fixture
def alice(database: Database) -> TokenModel:
    token = find_token(database, create_token(database, "alice"))
    assert token is not None
    return token


def queue(
    database: Database, token: TokenModel, count: int, quota: int = 1000, quota_bytes: int = 1 << 40
) -> list[str]:
    ids = [submissions.new_id() for _ in range(count)]
    for submission_id in ids:
        upload = Upload(SubmissionMeta(method="m"), submission_id * 2, 5, "sha256:0")
        submissions.accept(database, submission_id, token, upload, Quota(quota, quota_bytes), True)
    return ids


def get_submission(database: Database, submission_id: str) -> SubmissionModel:
    submission = submissions.find(database, submission_id)
    assert submission is not None
    return submission


def test_oldest_job_is_claimed_first(database: Database, alice: TokenModel) -> None:
    ids = queue(database, alice, 3)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(4)] == [*ids, None]


def test_each_job_is_claimed_by_one_scorer(database: Database, alice: TokenModel) -> None:
    ids = queue(database, alice, 40)

    def take(name: str) -> list[str]:
        claimed = []
        while submission_id := jobs.claim(database, name, LEASE_S):
            claimed.append(submission_id)
            assert jobs.renew(database, submission_id, name, LEASE_S)
            assert jobs.finish(database, submission_id, name, Outcome(reason=name))
        return claimed

    with ThreadPoolExecutor(8) as pool:
        claimed_by_scorer = list(pool.map(take, [f"s{k}" for k in range(8)]))
    assert sorted(submission_id for claimed in claimed_by_scorer for submission_id in claimed) == sorted(ids)
    for k, claimed in enumerate(claimed_by_scorer):
        assert {get_submission(database, submission_id).reason for submission_id in claimed} <= {f"s{k}"}


def test_scorer_with_expired_lease_cannot_finish(database: Database, alice: TokenModel) -> None:
    [submission_id] = queue(database, alice, 1)
    assert jobs.claim(database, "slow", 0.05) == submission_id
    time.sleep(0.1)
    assert jobs.claim(database, "quick", LEASE_S) == submission_id
    assert not jobs.renew(database, submission_id, "slow", LEASE_S)
    assert not jobs.finish(database, submission_id, "slow", Outcome(reason="slow"))
    jobs.release(database, submission_id, "slow")
    assert get_submission(database, submission_id).status == "scoring"
    assert jobs.finish(database, submission_id, "quick", Outcome(reason="quick"))
    assert not jobs.finish(database, submission_id, "quick", Outcome(reason="twice"))
    assert (get_submission(database, submission_id).status, get_submission(database, submission_id).reason) == (
        "failed",
        "quick",
    )


def test_expired_unclaimed_lease_can_be_renewed(database: Database, alice: TokenModel) -> None:
    [submission_id] = queue(database, alice, 1)
    assert jobs.claim(database, "s", 0.01) == submission_id
    time.sleep(0.05)
    assert jobs.renew(database, submission_id, "s", LEASE_S)
    assert jobs.claim(database, "other", LEASE_S) is None


def test_job_fails_after_max_attempts_and_next_is_claimed(database: Database, alice: TokenModel) -> None:
    [bad] = queue(database, alice, 1)
    for _ in range(MAX_ATTEMPTS):
        assert jobs.claim(database, "s", 0.0) == bad
        time.sleep(0.01)
    [good] = queue(database, alice, 1)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(2)] == [good, None]
    assert get_submission(database, bad).status == "failed"
    assert get_submission(database, bad).reason == f"scoring was started {MAX_ATTEMPTS} times but never finished"


def test_job_of_dead_scorer_is_queued_last(database: Database, alice: TokenModel) -> None:
    bad, second, third = queue(database, alice, 3)
    assert jobs.claim(database, "s", 0.0) == bad
    time.sleep(0.01)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(4)] == [second, third, bad, None]


def test_released_job_costs_no_attempt(database: Database, alice: TokenModel) -> None:
    [submission_id] = queue(database, alice, 1)
    for _ in range(3 * MAX_ATTEMPTS):
        assert jobs.claim(database, "s", LEASE_S) == submission_id
        jobs.release(database, submission_id, "s")
    assert (get_submission(database, submission_id).status, get_submission(database, submission_id).attempts) == (
        "queued",
        0,
    )


def test_job_scored_twice_has_one_result(database: Database, alice: TokenModel) -> None:
    [submission_id] = queue(database, alice, 1)
    first, second = (result(scored_view("lattice/0000", error)).to_json() for error in (0.5, 0.25))
    jobs.claim(database, "a", 0.0)
    time.sleep(0.01)
    jobs.claim(database, "b", LEASE_S)
    pictures = [ViewPicture("lattice/0000", '{"near": "1 m"}', {"error": b"webp", "truth": b"true"})]
    assert jobs.finish(database, submission_id, "b", Outcome(second, ["a note"], pictures))
    assert not jobs.finish(database, submission_id, "a", Outcome(result=first))
    assert submissions.result_json(database, submission_id) == second
    assert submissions.result_notes(database, submission_id) == ["a note"]
    assert picture_facts(database, submission_id) == {"lattice/0000": ({"near": "1 m"}, ["error", "truth"])}
    assert picture_webp(database, submission_id, "lattice/0000", "truth") == b"true"
    [row] = read_ranking(database, "lattice", "sha256:0").entries
    assert json.loads(row.table_json) == json.loads(second)["tables"]["lattice"]


def test_submission_deleted_while_scoring_stays_deleted(database: Database, alice: TokenModel) -> None:
    [submission_id] = queue(database, alice, 1)
    jobs.claim(database, "s", LEASE_S)
    submissions.remove(database, submission_id)
    assert not jobs.renew(database, submission_id, "s", LEASE_S)
    assert not jobs.finish(
        database, submission_id, "s", Outcome(result=result(scored_view("lattice/0000", 0.5)).to_json())
    )
    assert submissions.find(database, submission_id) is None
    assert submissions.result_json(database, submission_id) is None
    assert read_ranking(database, "lattice", "sha256:0").entries == ()


def test_concurrent_uploads_do_not_exceed_quota(database: Database, alice: TokenModel) -> None:
    def try_one(_: int) -> bool:
        try:
            queue(database, alice, 1, quota=3)
        except QuotaExceededError:
            return False
        return True

    with ThreadPoolExecutor(12) as pool:
        assert sum(pool.map(try_one, range(12))) == 3


def test_quota_counts_bytes_of_accepted_archives(database: Database, alice: TokenModel) -> None:
    queue(database, alice, 2, quota_bytes=10)
    with pytest.raises(QuotaExceededError, match="14 bytes"):
        queue(database, alice, 1, quota_bytes=14)
    queue(database, alice, 1, quota_bytes=15)


def test_concurrent_uploads_of_one_archive_are_one_submission(database: Database, alice: TokenModel) -> None:
    upload = Upload(SubmissionMeta(method="m"), "ab" * 32, 5, "sha256:0")

    def send(_: int) -> str:
        return submissions.accept(database, submissions.new_id(), alice, upload, Quota(100, 1000), True).id

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(send, range(8)))) == 1
    assert len(submissions.of_token(database, alice)) == 1


def test_failed_and_deleted_archives_may_be_sent_again(database: Database, alice: TokenModel) -> None:
    upload = Upload(SubmissionMeta(method="m"), "ab" * 32, 5, "sha256:0")

    def send() -> str:
        return submissions.accept(database, submissions.new_id(), alice, upload, Quota(100, 1000), True).id

    first = send()
    assert jobs.claim(database, "s", LEASE_S) == first
    jobs.finish(database, first, "s", Outcome(reason="no time"))
    second = send()
    submissions.remove(database, second)
    assert len({first, second, send()}) == 3


def test_revoked_token_is_void_until_replaced(database: Database) -> None:
    token = create_token(database, "bob")
    revoke_token(database, "bob")
    assert find_token(database, token) is None
    [use] = list_tokens(database)
    name, _, revoked_at, *amounts = use
    assert (name, revoked_at is None, amounts) == ("bob", False, [0, 0])
    assert find_token(database, replace_token(database, "bob")) is not None
    with pytest.raises(InputError, match="no token for 'eve'"):
        revoke_token(database, "eve")


def test_token_is_found_only_by_exact_value(database: Database) -> None:
    token = create_token(database, "bob")
    assert find_token(database, token) is not None
    assert [find_token(database, other) for other in (token[:-1], token + "x", token.lower(), "", "bob")] == [
        None
    ] * 5


@pytest.mark.parametrize("status", ["queued", "scoring"])
def test_clock_that_was_set_back_blocks_no_job(
    database: Database, alice: TokenModel, monkeypatch: pytest.MonkeyPatch, status: str
) -> None:
    [submission_id] = queue(database, alice, 1)
    assert jobs.claim(database, "s", MAX_LEASE_S) == submission_id
    if status == "queued":
        jobs.release(database, submission_id, "s", wait_s=MAX_LEASE_S)
    assert jobs.claim(database, "other", 1.0) is None, "a lease of another worker may be longer"
    yesterday = time.time() - 86400
    monkeypatch.setattr(time, "time", lambda: yesterday)
    assert get_submission(database, submission_id).status == status
    assert jobs.claim(database, "other", LEASE_S) == submission_id


@pytest.mark.parametrize("name", ["", " ", "x" * 101, "a\udcff", "a\0"])
def test_impossible_token_names_are_refused_in_words(database: Database, name: str) -> None:
    for make in (create_token, replace_token, revoke_token):
        with pytest.raises(InputError, match="the token name is"):
            make(database, name)
    assert list_tokens(database) == []


def test_released_job_with_wait_is_claimed_later(database: Database, alice: TokenModel) -> None:
    first, second = queue(database, alice, 2)
    assert jobs.claim(database, "s", LEASE_S) == first
    jobs.release(database, first, "s", wait_s=0.2)
    assert [jobs.claim(database, "s", LEASE_S) for _ in range(2)] == [second, None]
    time.sleep(0.3)
    assert jobs.claim(database, "s", LEASE_S) == first


def test_replaced_token_is_void(database: Database) -> None:
    old = create_token(database, "bob")
    new = replace_token(database, "bob")
    assert find_token(database, old) is None
    record = find_token(database, new)
    assert record is not None
    assert record.name == "bob"
    with pytest.raises(InputError, match="there is no token for 'eve'"):
        replace_token(database, "eve")
