"""Datasets of a leaderboard: results of each stay, none are mixed, and of splits only ``test`` is scored."""

from __future__ import annotations

import json
import sqlite3
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from leaderboard.db import jobs
from leaderboard.scoring.sandbox import Outcome, check, score
from leaderboard.uploads import UNAVAILABLE_MESSAGE
from rebar_depth_bench.base.errors import SubmissionError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.submission import SubmissionMeta
from tests.leaderboard.boards import (
    DIGEST,
    OTHER_DIGEST,
    add_submission,
    board_settings,
    claimed,
    facts,
    make_board,
    opened,
    result_bytes,
    score_all,
)
from tests.leaderboard.serving import API, RunScorer, RunServer, Server, run
from tests.processes import wait_until
from tests.synthetic_dataset import write_archive, write_dataset, write_split_dataset


@dataclass(frozen=True)
class Datasets:
    """Two datasets with different configs, and an archive that is valid for both."""

    first: Path
    second: Path
    archive: Path


@pytest.fixture
def datasets(tmp_path: Path) -> Datasets:
    write_dataset(tmp_path / "first", ["lattice"], 3)
    write_dataset(tmp_path / "second", ["lattice", "pile"], 3)
    write_archive(tmp_path / "archive.zip", ["lattice"], 3, "m", 1)
    return Datasets(tmp_path / "first", tmp_path / "second", tmp_path / "archive.zip")


def ids_and_ranks(server: Server) -> list[tuple[str, int]]:
    return [(row["id"], row["rank"]) for row in server.rows()]


def submit_and_score(server: Server, archive: Path, count: int) -> dict[str, dict[str, Any]]:
    """Submit an archive several times; return the results by id."""
    token = server.token("alice")
    ids = [server.submit_accepted(archive, token) for _ in range(count)]
    return {submission_id: server.wait_until_ended(submission_id)["result"] for submission_id in ids}


def test_other_dataset_is_rejected_without_rescore_option(datasets: Datasets, running_server: RunServer) -> None:
    with running_server(root=datasets.first) as server:
        before = submit_and_score(server, datasets.archive, 2)
        ranks, state = ids_and_ranks(server), server.state
    process = run("serve", "--data", datasets.second, "--state-dir", state, "--port", "0")
    assert process.returncode == 2
    assert "2 submissions are of the dataset" in process.stderr
    assert "--rescore true" in process.stderr
    assert "Traceback" not in process.stderr
    with running_server(state, root=datasets.second, rescore=True, workers=0) as server:
        assert ids_and_ranks(server) == []
        submission = server.get(f"{API}/{min(before)}").json()
        assert (submission["status"], submission["result"]) == ("queued", before[min(before)])
        assert "is being scored again" in submission["outdated"]
        assert server.get(f"/submissions/{min(before)}").status_code == 200
    with running_server(state, root=datasets.second) as server:
        after = [server.wait_until_ended(submission_id) for submission_id in before]
        digest = open_folder(datasets.second).digest
        assert [one["result"]["dataset"]["digest"] for one in after] == [digest, digest]
        assert [one["result"]["tables"] for one in after] == [result["tables"] for result in before.values()]
        assert [one["outdated"] for one in after] == [None, None]
        assert ids_and_ranks(server) == ranks
    with running_server(state, root=datasets.first, workers=0) as server:
        assert ids_and_ranks(server) == ranks, "results of both datasets are kept"
        assert server.get(f"{API}/{min(before)}").json()["result"] == before[min(before)]


def test_failed_rescoring_keeps_the_result(datasets: Datasets, running_server: RunServer, tmp_path: Path) -> None:
    """A dataset with more views makes every archive incomplete."""
    write_dataset(tmp_path / "larger", ["lattice"], 5)
    with running_server(root=datasets.first) as server:
        before, state = submit_and_score(server, datasets.archive, 1), server.state
    with running_server(state, root=datasets.first, workers=0) as server:
        waiting = server.submit_accepted(datasets.archive, server.token("bob"))
    (scored,) = before
    with running_server(state, root=tmp_path / "larger", rescore=True) as server:
        assert server.wait_until_ended(waiting)["status"] == "failed"
        assert "lattice/0004: missing" in server.get(f"{API}/{waiting}").json()["reason"]
        shown = server.wait_until_ended(scored)
        assert (shown["status"], shown["reason"], shown["result"]) == ("scored", None, before[scored])
        assert f"against the served dataset {open_folder(tmp_path / 'larger').digest} failed" in shown["outdated"]
        assert "lattice/0004: missing" in shown["outdated"]
        assert ids_and_ranks(server) == []
    with running_server(state, root=tmp_path / "larger", workers=0) as server:
        assert server.get(f"{API}/{scored}").json()["status"] == "scored", "it is not tried again"
    with running_server(state, root=datasets.first, workers=0) as server:
        assert ids_and_ranks(server) == [(scored, 1)]
        assert server.get(f"{API}/{scored}").json()["outdated"] is None


def test_submission_without_archive_keeps_its_result_and_may_be_sent_again(
    datasets: Datasets, running_server: RunServer
) -> None:
    with running_server(root=datasets.first) as server:
        before, state = submit_and_score(server, datasets.archive, 3), server.state
        token = server.token("bob")
        freed = server.submit_accepted(datasets.archive, token)
        before[freed] = server.wait_until_ended(freed)["result"]
        assert run("remove", "--archive-only", freed, "--state-dir", state).returncode == 0
        assert server.submit(datasets.archive, token).status_code == 200, "its result is current"
    lost, *kept = list(before)[:3]
    archives = state / "archives"
    assert not (archives / f"{freed}.zip").exists()
    (archives / f"{lost}.zip").unlink()
    with running_server(state, root=datasets.second, rescore=True) as server:
        for submission_id in (lost, *kept):
            server.wait_until_ended(submission_id)
        assert {name for name, _ in ids_and_ranks(server)} == set(kept)
        for name, words in ((freed, "its archive is not kept"), (lost, "the stored archive is missing")):
            shown = server.wait_until_ended(name)
            assert (shown["status"], shown["reason"], shown["result"]) == ("scored", None, before[name])
            assert words in shown["outdated"]
            assert words in server.get(f"/submissions/{name}").text
        again = server.submit(datasets.archive, token)
        assert again.status_code == 202
        assert again.json()["id"] != freed
        assert server.wait_until_ended(again.json()["id"])["outdated"] is None
    with running_server(state, root=datasets.first, rescore=True, workers=0) as server:  # The dataset is back.
        assert {name for name, _ in ids_and_ranks(server)} == set(before)


@pytest.mark.parametrize("changed", ["protocol", "intervals"])
def test_results_of_other_definitions_are_scored_again_or_stay(
    datasets: Datasets, running_server: RunServer, changed: str
) -> None:
    with running_server(root=datasets.first) as server:
        before, state = submit_and_score(server, datasets.archive, 2), server.state
    kept, lost = before
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection, connection:
        for table in ("results", "board_rows") if changed == "protocol" else ("results",):
            connection.execute(f"UPDATE {table} SET {changed} = 'rebar-0'")
    (state / "archives" / f"{lost}.zip").unlink()
    with running_server(state, root=datasets.first) as server:
        assert server.wait_until_ended(kept)["result"] == before[kept]
        assert server.wait_until_ended(lost)["result"] == before[lost]
        assert ids_and_ranks(server) == [(kept, 1)] + [(lost, 1)] * (changed == "intervals")
        outdated = server.get(f"{API}/{lost}").json()["outdated"]
        assert (outdated is not None) == (changed == "protocol")
        assert outdated is None or "the protocol rebar-0" in outdated


def test_requeued_submission_is_scored_again_for_no_quota(datasets: Datasets, running_server: RunServer) -> None:
    with running_server(root=datasets.first, workers=0, quota=1) as server:
        submission = server.submit_accepted(datasets.archive, server.token("alice"))
        state = ("--state-dir", server.state)
        waiting = run("requeue", submission, *state)
        assert waiting.returncode == 2
        assert f"{submission}: is queued already" in waiting.stderr
        with opened(board_settings(server.state)) as (database, _):
            for _ in range(jobs.MAX_ATTEMPTS):  # Workers that are killed.
                assert claimed(database, "killed", 1e-6) == submission
                time.sleep(0.01)
            assert claimed(database, "next") is None
        assert server.get(f"{API}/{submission}").json()["status"] == "failed"
        unknown = run("requeue", submission, "0" * 32, *state)
        assert unknown.returncode == 2
        assert "there is no such submission" in unknown.stderr
        assert server.get(f"{API}/{submission}").json()["status"] == "failed", "all or none"
        assert run("requeue", submission, *state).returncode == 0
    with running_server(server.state, root=datasets.first) as server:
        assert server.wait_until_ended(submission)["status"] == "scored"
        before = server.get(f"{API}/{submission}/result.json").content
        assert run("requeue", submission, "--state-dir", server.state).returncode == 0
        assert server.wait_until_ended(submission)["status"] == "scored"
        assert server.get(f"{API}/{submission}/result.json").content == before


def test_job_of_a_dataset_that_was_replaced_meanwhile_is_queued_again(tmp_path: Path) -> None:
    settings = board_settings(tmp_path / "state")
    first = add_submission(settings, make_board(settings), b"1", scored=False)
    with opened(settings) as (database, _):
        assert claimed(database, "slow") == first
        assert jobs.serve_dataset(database, OTHER_DIGEST, rescore=True) == 1
        assert not jobs.renew(database, first, "slow", 60)
        assert not jobs.finish(database, first, "slow", Outcome(DIGEST, result_bytes(DIGEST)))
        assert facts(settings)[first][:2] == ("queued", frozenset())
        score_all(database)
        assert facts(settings)[first][:2] == ("scored", frozenset({OTHER_DIGEST}))


def test_missing_and_other_datasets_cost_no_submission(
    datasets: Datasets, tmp_path: Path, running_server: RunServer, running_scorer: RunScorer
) -> None:
    with running_server(root=datasets.first, workers=0) as server:
        token = server.token("alice")
        datasets.first.rename(tmp_path / "elsewhere")
        response = server.submit(datasets.archive, token)
        assert (response.status_code, response.json()["detail"]) == (503, UNAVAILABLE_MESSAGE)
        (tmp_path / "elsewhere").rename(datasets.first)
        submission_id = server.submit_accepted(datasets.archive, token)
        with running_scorer(server.state, root=datasets.second) as log:
            wait_until(lambda: any("job requeued" in line for line in log), "the job is requeued")
        assert any("expected sha256:" in line for line in log)
        row = server.row(submission_id)
        assert (row["status"], row["attempts"]) == ("queued", 0)
        with running_scorer(server.state, root=datasets.first):
            assert server.wait_until_ended(submission_id)["status"] == "scored"


@pytest.fixture
def split_root(tmp_path: Path) -> Path:
    write_split_dataset(tmp_path / "dataset", {"a": "train", "b": "test", "c": "test"}, 2, families={"b": "wall"})
    return tmp_path / "dataset"


def write_split_archive(root: Path, archive: Path, split: str) -> Path:
    with rdb.SubmissionWriter(archive, "exact") as writer:
        for row in rdb.load(root, "cages", split=split, columns=["view_id", "left_depth"]):
            writer.add(row["view_id"], row["left_depth"] * np.float32(1.25))
    return archive


def checked(archive: Path, root: Path) -> SubmissionMeta:
    return check(archive, str(root), open_folder(root).digest)


@pytest.mark.slow
def test_only_the_split_test_is_accepted(split_root: Path, tmp_path: Path) -> None:
    with pytest.raises(SubmissionError) as refused:
        checked(write_split_archive(split_root, tmp_path / "train.zip", "train"), split_root)
    [problem] = refused.value.problems
    assert (problem.code, problem.where) == ("conflict", "cages")
    assert "split train" in str(problem)
    accepted = checked(write_split_archive(split_root, tmp_path / "test.zip", "test"), split_root)
    assert accepted.method == "exact"


@pytest.mark.slow
def test_scored_archive_has_the_groups_of_the_command_line(split_root: Path, tmp_path: Path) -> None:
    archive = write_split_archive(split_root, tmp_path / "test.zip", "test")
    outcome = score(archive, str(split_root), open_folder(split_root).digest)
    expected = rdb.score(archive, split_root).to_json()
    assert outcome.result == expected
    assert list(json.loads(expected)["tables"]["cages"]["groups"]["family"]) == ["wall"]
