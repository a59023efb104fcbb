"""Scoring on a real dask cluster: the same bytes, whoever dies meanwhile."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from leaderboard.scoring.dask_backend import settings_for_workers
from leaderboard.settings import Settings
from tests.leaderboard.conftest import Write
from tests.leaderboard.dask_cluster import Cluster, new_cluster
from tests.leaderboard.serving import Server, running_server
from tests.leaderboard.watching import SCORING, processes_below, submission_row, wait_until


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    (tmp_path / "dask").mkdir()
    with new_cluster(tmp_path / "dask") as cluster:
        yield cluster


@pytest.fixture(scope="module")
def small(write_archive: Write) -> Path:
    return write_archive("small", configs=("lattice-orbit",))


def is_logged(server: Server, event: str) -> bool:
    return any(f'"event": "{event}"' in line for line in server.log)


def own_bytes(archive: Path, data: Path, folder: Path) -> bytes:
    """What the command line makes of an archive."""
    command = [sys.executable, "-m", "rebar_depth_bench", "score", str(archive), "--data", str(data), "--json"]
    subprocess.run([*command, str(folder / "own.json")], check=True, capture_output=True)
    return (folder / "own.json").read_bytes()


def test_a_scheduler_that_comes_late_costs_nothing_and_its_workers_make_the_same_bytes(
    tiny_root: Path, tmp_path: Path, small: Path, cluster: Cluster
) -> None:
    state = tmp_path / "state"
    data, state_given = os.path.relpath(tiny_root), Path(os.path.relpath(state))  # workers run elsewhere
    settings = {"cluster": cluster.address, "lease": 6, "error_maps": 1}
    with running_server(Path(data), state_given, **settings) as server:  # type: ignore[arg-type]
        token = server.token("alice")
        submission = server.accepted(small, token)
        wait_until(lambda: is_logged(server, "nobody to score"), "the scheduler is missed")
        wait_until(lambda: is_logged(server, "given back"), "the job is given back")
        cluster.start_scheduler()
        worker = cluster.start_worker()
        wait_until(lambda: processes_below(worker.pid, SCORING), "the worker scores")
        assert server.ended(submission)["status"] == "scored"
        result = httpx2.get(f"{server.url}/api/v1/submissions/{submission}/result.json").content
        assert result == own_bytes(small, tiny_root, tmp_path)
        assert httpx2.get(f"{server.url}/submissions/{submission}").text.count("<img") >= 1
        assert submission_row(state, submission)["attempts"] == 1, "waiting for the scheduler was charged"


def test_a_killed_worker_or_scheduler_loses_no_submission(
    tiny_root: Path, tmp_path: Path, small: Path, cluster: Cluster
) -> None:
    state = tmp_path / "state"
    scheduler = cluster.start_scheduler()
    worker = cluster.start_worker()
    with running_server(tiny_root, state, cluster=cluster.address, lease=4) as server:
        token = server.token("alice")
        submission = server.accepted(small, token)
        wait_until(lambda: processes_below(worker.pid, SCORING), "the first worker scores")
        worker.kill()
        worker.wait()
        worker = cluster.start_worker()
        assert server.ended(submission)["status"] == "scored"
        following = server.accepted(small, token)
        wait_until(lambda: processes_below(worker.pid, SCORING), "the second worker scores")
        scheduler.kill()
        scheduler.wait()
        wait_until(lambda: is_logged(server, "nobody to score"), "the scheduler is missed")
        worker.kill()
        worker.wait()
        cluster.start_scheduler()
        cluster.start_worker()
        assert server.ended(following)["status"] == "scored"
        server.process.terminate()
        assert server.process.wait(40) == 0
    lines = [json.loads(line) for line in server.log[1:] if line]
    assert any(line.get("logger", "").startswith("distributed") for line in lines), "dask's lines are JSON too"
    assert submission_row(state, following)["attempts"] == 1, "the scheduler's death was charged"


def test_workers_are_told_no_database_password_and_whole_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dataset").mkdir()
    given = Settings(data="dataset", state=Path("st"), db="postgresql://u:Hunter2@h/x")  # type: ignore[call-arg]
    told = settings_for_workers(given)
    assert "Hunter2" not in told.model_dump_json()
    assert told.data == str(tmp_path / "dataset")
    assert told.state == tmp_path / "st"
    assert told.archives_url == f"file://{tmp_path}/st/archives"
    hub = Settings(data="someone/rebar", archives="s3://bucket/x", state=tmp_path)  # type: ignore[call-arg]
    told = settings_for_workers(hub)
    assert (told.data, told.archives_url) == ("someone/rebar", "s3://bucket/x")
    near = settings_for_workers(given.model_copy(update={"archives": "kept"}))
    assert near.archives_url == f"{tmp_path}/kept"
