"""A board whose dataset has changed: never numbers of two datasets side by side."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import httpx2

from benchmarks.synthetic_dataset import write_archive, write_dataset
from tests.leaderboard.serving import Server, running_server


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
    assert "2 submissions of this board were scored against another dataset" in refused.stderr
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
