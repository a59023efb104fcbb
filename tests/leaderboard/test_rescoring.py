"""Change of the dataset of a leaderboard: results of two datasets are never mixed."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import httpx2
import pytest

from leaderboard.db import jobs
from leaderboard.scoring.sandbox import Outcome
from leaderboard.storage.retention import prune_archives
from leaderboard.uploads.accept import UNAVAILABLE_MESSAGE
from tests.leaderboard.boards import (
    DIGEST,
    OTHER_DIGEST,
    add_submission,
    board_settings,
    facts,
    make_board,
    opened,
)
from tests.leaderboard.serving import RunScorer, RunServer, Server, submission_row
from tests.processes import wait_until
from tests.synthetic_dataset import write_archive, write_dataset


def ids_and_ranks(server: Server) -> list[tuple[str, int]]:
    ranking = httpx2.get(f"{server.url}/api/v1/leaderboard?config=lattice", timeout=60).json()
    return [(row["id"], row["rank"]) for row in ranking["rows"]]


def test_other_dataset_is_rejected_without_rescore_option(tmp_path: Path, running_server: RunServer) -> None:
    db, state, archive = "", tmp_path / "state", tmp_path / "archive.zip"
    first, second = tmp_path / "first", tmp_path / "second"
    write_dataset(first, ["lattice"], 3)
    write_dataset(second, ["lattice", "pile"], 3)
    write_archive(archive, ["lattice"], 3, "m", 1)
    with running_server(state, root=first, db=db) as server:
        token = server.token("alice")
        ids = [server.submit_accepted(archive, token) for _ in range(2)]
        before = [server.wait_until_ended(submission_id)["result"] for submission_id in ids]
        ranks = ids_and_ranks(server)
    command = [
        sys.executable,
        "-m",
        "leaderboard",
        "serve",
        "--data",
        second,
        "--state-dir",
        state,
        "--port",
        "0",
        "--db",
        db,
    ]
    process = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 2
    assert "2 submissions of this leaderboard belong to another dataset" in process.stderr
    assert "--rescore true" in process.stderr
    assert "Traceback" not in process.stderr
    with running_server(state, root=second, db=db, rescore=True, workers=0) as server:
        assert ids_and_ranks(server) == []
        submission = httpx2.get(f"{server.url}/api/v1/submissions/{ids[0]}", timeout=60).json()
        assert (submission["status"], submission["result"]) == ("queued", None)
        assert httpx2.get(f"{server.url}/submissions/{ids[0]}", timeout=60).status_code == 200
    with running_server(state, root=second, db=db) as server:
        after = [server.wait_until_ended(submission_id)["result"] for submission_id in ids]
        digest = json.loads((second / "manifest.json").read_text())["ground_truth"]["digest"]
        assert [result["dataset"]["digest"] for result in after] == [digest, digest]
        assert [result["tables"] for result in after] == [result["tables"] for result in before]
        assert ids_and_ranks(server) == ranks


def test_pruned_submission_keeps_its_result_and_leaves_the_ranking(
    tmp_path: Path, running_server: RunServer
) -> None:
    state, archive = tmp_path / "state", tmp_path / "archive.zip"
    first, second = tmp_path / "first", tmp_path / "second"
    write_dataset(first, ["lattice"], 3)
    write_dataset(second, ["lattice", "pile"], 3)
    write_archive(archive, ["lattice"], 3, "m", 1)
    with running_server(state, root=first) as server:
        token = server.token("alice")
        pruned, lost, kept = [server.submit_accepted(archive, token) for _ in range(3)]
        before = {name: server.wait_until_ended(name)["result"] for name in (pruned, lost, kept)}
    settings = board_settings(state)
    with opened(settings) as (database, archives):
        prune_archives(database, archives, [pruned])
        (settings.archive_dir / f"{lost}.zip").unlink()
    digest = before[pruned]["dataset"]["digest"]
    with running_server(state, root=second, rescore=True) as server:
        assert server.wait_until_ended(kept)["result"]["dataset"]["digest"] != digest
    with running_server(state, root=second) as server:  # No submission is stale any more.
        assert ids_and_ranks(server) == [(kept, 1)]
        for name in (pruned, lost):
            shown = server.wait_until_ended(name)
            assert (shown["status"], shown["reason"], shown["result"]) == ("scored", None, before[name])
            assert shown["outdated"].startswith(f"the result belongs to the dataset {digest}; its archive is not")
            page = httpx2.get(f"{server.url}/submissions/{name}", timeout=60)
            assert page.status_code == 200
            assert shown["outdated"] in page.text
        assert server.wait_until_ended(kept)["outdated"] is None
    with running_server(state, root=first, rescore=True) as server:  # The dataset is back.
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
    tmp_path: Path, running_server: RunServer, changed: str
) -> None:
    root, state, archive = tmp_path / "root", tmp_path / "state", tmp_path / "archive.zip"
    write_dataset(root, ["lattice"], 2)
    write_archive(archive, ["lattice"], 2, "m", 1)
    with running_server(state, root=root) as server:
        kept, lost = (server.submit_accepted(archive, server.token(name)) for name in ("alice", "bob"))
        before = [server.wait_until_ended(submission_id)["result"] for submission_id in (kept, lost)]
    earlier = before[0] | {"protocol": "rebar-0"} if changed == "protocol" else before[0].copy()
    earlier.pop("intervals") if changed == "intervals" else None
    with closing(sqlite3.connect(state / "leaderboard.sqlite")) as connection, connection:
        connection.execute("UPDATE results SET json = ?", (json.dumps(earlier).encode(),))
    (state / "archives" / f"{lost}.zip").unlink()
    with running_server(state, root=root) as server:
        assert server.wait_until_ended(kept)["result"] == before[0]
        assert server.wait_until_ended(lost)["result"] == earlier
        assert ids_and_ranks(server) == [(kept, 1), (lost, 1)]
        page = httpx2.get(f"{server.url}/submissions/{lost}", timeout=60)
        assert page.status_code == 200
        assert ("another version" in page.text) == (changed == "protocol")


def test_scorer_with_other_dataset_releases_job(
    tmp_path: Path, running_server: RunServer, running_scorer: RunScorer
) -> None:
    state, archive = tmp_path / "state", tmp_path / "archive.zip"
    first, second = tmp_path / "first", tmp_path / "second"
    write_dataset(first, ["lattice"], 2)
    write_dataset(second, ["lattice", "pile"], 2)
    write_archive(archive, ["lattice"], 2, "m", 1)
    with running_server(state, root=first, workers=0) as server:
        submission_id = server.submit_accepted(archive, server.token("alice"))
        with running_scorer(state, root=second) as log:
            wait_until(lambda: any('"event": "job requeued"' in line for line in log), "the job is requeued")
        assert any("expected sha256:" in line for line in log)
        assert (
            submission_row(state, submission_id)["status"],
            submission_row(state, submission_id)["attempts"],
        ) == ("queued", 0)
        with running_scorer(state, root=first):
            assert server.wait_until_ended(submission_id)["status"] == "scored"


def test_missing_dataset_is_503_and_fails_no_submission(tmp_path: Path, running_server: RunServer) -> None:
    root, state, archive = tmp_path / "root", tmp_path / "state", tmp_path / "archive.zip"
    write_dataset(root, ["lattice"], 2)
    write_archive(archive, ["lattice"], 2, "m", 1)
    with running_server(state, root=root, lease_seconds=2) as server:
        token = server.token("alice")
        root.rename(tmp_path / "elsewhere")
        response = server.submit(archive, token)
        assert (response.status_code, response.json()["detail"]) == (503, UNAVAILABLE_MESSAGE)
        (tmp_path / "elsewhere").rename(root)
        submission_id = server.submit_accepted(archive, token)
        assert server.wait_until_ended(submission_id)["status"] == "scored"
