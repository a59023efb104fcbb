"""Datasets of a leaderboard: results of two datasets are never mixed, and of splits only ``test`` is scored."""

from __future__ import annotations

import json
import sqlite3
import zipfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from leaderboard.db import jobs
from leaderboard.scoring.sandbox import Outcome, check, score
from leaderboard.storage.retention import prune_archives
from leaderboard.uploads.accept import UNAVAILABLE_MESSAGE
from rebar_depth_bench.base.errors import SubmissionError
from rebar_depth_bench.data.manifest import open_folder
from tests.leaderboard.boards import (
    DIGEST,
    OTHER_DIGEST,
    add_submission,
    board_settings,
    facts,
    make_board,
    opened,
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
    assert "2 submissions of this leaderboard belong to another dataset" in process.stderr
    assert "--rescore true" in process.stderr
    assert "Traceback" not in process.stderr
    with running_server(state, root=datasets.second, rescore=True, workers=0) as server:
        assert ids_and_ranks(server) == []
        submission = server.get(f"{API}/{min(before)}").json()
        assert (submission["status"], submission["result"]) == ("queued", None)
        assert server.get(f"/submissions/{min(before)}").status_code == 200
    with running_server(state, root=datasets.second) as server:
        after = [server.wait_until_ended(submission_id)["result"] for submission_id in before]
        digest = json.loads((datasets.second / "manifest.json").read_text())["ground_truth"]["digest"]
        assert [result["dataset"]["digest"] for result in after] == [digest, digest]
        assert [result["tables"] for result in after] == [result["tables"] for result in before.values()]
        assert ids_and_ranks(server) == ranks


def test_pruned_submission_keeps_its_result_and_leaves_the_ranking(
    datasets: Datasets, running_server: RunServer
) -> None:
    with running_server(root=datasets.first) as server:
        before, state = submit_and_score(server, datasets.archive, 3), server.state
    pruned, lost, kept = before
    settings = board_settings(state)
    with opened(settings) as (database, archives):
        prune_archives(database, archives, [pruned])
        (settings.archive_dir / f"{lost}.zip").unlink()
    digest = before[pruned]["dataset"]["digest"]
    with running_server(state, root=datasets.second, rescore=True) as server:
        assert server.wait_until_ended(kept)["result"]["dataset"]["digest"] != digest
    with running_server(state, root=datasets.second) as server:  # No submission is stale any more.
        assert ids_and_ranks(server) == [(kept, 1)]
        for name in (pruned, lost):
            shown = server.wait_until_ended(name)
            assert (shown["status"], shown["reason"], shown["result"]) == ("scored", None, before[name])
            assert shown["outdated"].startswith(f"the result belongs to the dataset {digest}; its archive is not")
            page = server.get(f"/submissions/{name}")
            assert page.status_code == 200
            assert shown["outdated"] in page.text
        assert server.wait_until_ended(kept)["outdated"] is None
    with running_server(state, root=datasets.first, rescore=True) as server:  # The dataset is back.
        server.wait_until_ended(kept)
        assert {name for name, _ in ids_and_ranks(server)} == {pruned, lost, kept}


def test_archive_that_is_lost_while_it_waits_costs_no_result(tmp_path: Path) -> None:
    settings = board_settings(tmp_path / "state")
    token = make_board(settings)
    first, waiting = add_submission(settings, token, b"1"), add_submission(settings, token, b"2", scored=False)
    with opened(settings) as (database, archives):
        assert jobs.requeue_stale(database, OTHER_DIGEST, archives.ids(), rescore=True) == 2
        for submission_id in (first, waiting):
            archives.delete(submission_id)
            assert jobs.claim(database, "scorer", 60) == submission_id
            missing = Outcome(reason="the archive is missing", archive_missing=True)
            assert jobs.finish(database, submission_id, "scorer", missing)
    assert facts(settings) == {
        first: ("scored", DIGEST, DIGEST, False),
        waiting: ("failed", OTHER_DIGEST, None, False),
    }


@pytest.mark.parametrize("changed", ["protocol", "intervals"])
def test_results_of_other_definitions_are_scored_again_or_stay(
    datasets: Datasets, running_server: RunServer, changed: str
) -> None:
    with running_server(root=datasets.first) as server:
        before, state = submit_and_score(server, datasets.archive, 2), server.state
    kept, lost = before
    earlier = {**before[kept], "protocol": "rebar-0"}
    if changed == "intervals":
        earlier = {name: value for name, value in before[kept].items() if name != "intervals"}
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection, connection:
        connection.execute("UPDATE results SET json = ?", (json.dumps(earlier).encode(),))
    (state / "archives" / f"{lost}.zip").unlink()
    with running_server(state, root=datasets.first) as server:
        assert server.wait_until_ended(kept)["result"] == before[kept]
        assert server.wait_until_ended(lost)["result"] == earlier
        assert ids_and_ranks(server) == [(kept, 1), (lost, 1)]
        page = server.get(f"/submissions/{lost}")
        assert page.status_code == 200
        assert ("another version" in page.text) == (changed == "protocol")


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
            wait_until(lambda: any('"event": "job requeued"' in line for line in log), "the job is requeued")
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


@pytest.mark.slow
def test_only_the_split_test_is_accepted(split_root: Path, tmp_path: Path) -> None:
    with pytest.raises(SubmissionError) as refused:
        check(write_split_archive(split_root, tmp_path / "train.zip", "train"), str(split_root))
    [problem] = refused.value.problems
    assert (problem.code, problem.where) == ("conflict", "cages")
    assert "split train" in str(problem)
    accepted = check(write_split_archive(split_root, tmp_path / "test.zip", "test"), str(split_root))
    assert accepted.method == "exact"


@pytest.mark.slow
def test_archive_of_macos_is_accepted(split_root: Path, tmp_path: Path) -> None:
    archive = write_split_archive(split_root, tmp_path / "test.zip", "test")
    with zipfile.ZipFile(archive, "a") as zipped:
        zipped.writestr("__MACOSX/._submission.json", bytes.fromhex("0005160700020000"))
    assert check(archive, str(split_root)).method == "exact"


@pytest.mark.slow
def test_scored_archive_has_the_groups_of_the_command_line(split_root: Path, tmp_path: Path) -> None:
    archive = write_split_archive(split_root, tmp_path / "test.zip", "test")
    outcome = score(archive, str(split_root), open_folder(split_root).digest, 0, False)
    expected = rdb.score(archive, split_root).to_json()
    assert outcome.result == expected
    assert list(json.loads(expected)["tables"]["cages"]["groups"]["family"]) == ["wall"]
