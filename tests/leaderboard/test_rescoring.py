"""A board whose dataset has changed: never numbers of two datasets side by side."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import httpx2

from benchmarks.synthetic_dataset import write_archive, write_dataset
from leaderboard.uploads.accept import AWAY
from tests.leaderboard.serving import Server, running_scorer, running_server
from tests.leaderboard.watching import submission_row, wait_until


def shown(server: Server) -> list[tuple[str, int]]:
    answer = httpx2.get(f"{server.url}/api/v1/leaderboard?config=lattice", timeout=60).json()
    return [(row["id"], row["rank"]) for row in answer["rows"]]


def test_another_dataset_is_refused_until_it_is_scored_again(
    tmp_path: Path, new_database: Callable[[], str]
) -> None:
    db, state, archive = new_database(), tmp_path / "state", tmp_path / "archive.zip"
    first, second = tmp_path / "first", tmp_path / "second"
    write_dataset(first, ["lattice"], 3)
    write_dataset(second, ["lattice", "pile"], 3)
    write_archive(archive, ["lattice"], 3, "m", 1)
    with running_server(first, state, db=db) as server:
        token = server.token("alice")
        ids = [server.accepted(archive, token) for _ in range(2)]
        before = [server.ended(one)["result"] for one in ids]
        ranks = shown(server)
    command = [
        sys.executable,
        "-m",
        "leaderboard",
        "serve",
        "--data",
        second,
        "--state",
        state,
        "--port",
        "0",
        "--db",
        db,
    ]
    refused = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=60, check=False)
    assert refused.returncode == 2
    assert "2 submissions of this board are of another dataset" in refused.stderr
    assert "--rescore true" in refused.stderr
    assert "Traceback" not in refused.stderr
    with running_server(second, state, db=db, rescore=True, scorers=0) as server:
        assert shown(server) == []
        found = httpx2.get(f"{server.url}/api/v1/submissions/{ids[0]}", timeout=60).json()
        assert (found["status"], found["result"]) == ("queued", None)
        assert httpx2.get(f"{server.url}/submissions/{ids[0]}", timeout=60).status_code == 200
    with running_server(second, state, db=db) as server:
        after = [server.ended(one)["result"] for one in ids]
        digest = json.loads((second / "manifest.json").read_text())["ground_truth"]["digest"]
        assert [one["dataset"]["digest"] for one in after] == [digest, digest]
        assert [one["tables"] for one in after] == [one["tables"] for one in before]
        assert shown(server) == ranks


def test_a_scorer_with_another_dataset_scores_nothing_and_costs_nothing(tmp_path: Path) -> None:
    state, archive = tmp_path / "state", tmp_path / "archive.zip"
    first, second = tmp_path / "first", tmp_path / "second"
    write_dataset(first, ["lattice"], 2)
    write_dataset(second, ["lattice", "pile"], 2)
    write_archive(archive, ["lattice"], 2, "m", 1)
    with running_server(first, state, scorers=0) as server:
        one = server.accepted(archive, server.token("alice"))
        with running_scorer(second, state) as log:
            wait_until(lambda: any("given back" in line for line in log), "the job is given back")
        assert any("expected sha256:" in line for line in log)
        assert (submission_row(state, one)["status"], submission_row(state, one)["attempts"]) == ("queued", 0)
        with running_scorer(first, state):
            assert server.ended(one)["status"] == "scored"


def test_a_dataset_that_is_away_fails_nobody(tmp_path: Path) -> None:
    root, state, archive = tmp_path / "root", tmp_path / "state", tmp_path / "archive.zip"
    write_dataset(root, ["lattice"], 2)
    write_archive(archive, ["lattice"], 2, "m", 1)
    with running_server(root, state, lease=2) as server:
        token = server.token("alice")
        root.rename(tmp_path / "elsewhere")
        refused = server.submit(archive, token)
        assert (refused.status_code, refused.json()["detail"]) == (503, AWAY)
        (tmp_path / "elsewhere").rename(root)
        one = server.accepted(archive, token)
        assert server.ended(one)["status"] == "scored"
