"""Scoring on a real dask cluster: byte-identical results and recovery from killed workers and schedulers."""

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
from tests.dask_cluster import Cluster, NewCluster
from tests.leaderboard.serving import SCORING, RunServer, Server, submission_row
from tests.processes import processes_below, wait_until

UNAVAILABLE = "scoring backend unavailable; job requeued"
"""Log event of a worker that cannot reach the dask scheduler."""


@pytest.fixture
def cluster(tmp_path: Path, new_cluster: NewCluster) -> Iterator[Cluster]:
    (tmp_path / "dask").mkdir()
    with new_cluster(tmp_path / "dask") as cluster:
        yield cluster


def is_logged(server: Server, event: str) -> bool:
    return any(f'"event": "{event}"' in line for line in server.log)


def command_line_result(archive: Path, data: Path, folder: Path) -> bytes:
    """Return the result JSON of ``rebar-bench score``."""
    command = [sys.executable, "-m", "rebar_depth_bench", "score", str(archive), "--data", str(data), "--json"]
    subprocess.run([*command, str(folder / "own.json")], check=True, capture_output=True)
    return (folder / "own.json").read_bytes()


def test_late_scheduler_costs_no_attempt(
    tiny_root: Path, tmp_path: Path, small_archive: Path, cluster: Cluster, running_server: RunServer
) -> None:
    state = tmp_path / "state"
    data, relative_state = (
        os.path.relpath(tiny_root),
        Path(os.path.relpath(state)),
    )  # The workers have another working directory.
    settings = {"dask_scheduler": cluster.address, "lease_seconds": 6, "error_maps": 1}
    with running_server(Path(data), relative_state, **settings) as server:
        token = server.token("alice")
        submission = server.submit_accepted(small_archive, token)
        wait_until(lambda: is_logged(server, UNAVAILABLE), "the scheduler is unavailable")
        wait_until(lambda: is_logged(server, "job requeued"), "the job is requeued")
        cluster.start_scheduler()
        worker = cluster.start_worker()
        wait_until(lambda: processes_below(worker.pid, SCORING), "the worker scores")
        assert server.wait_until_ended(submission)["status"] == "scored"
        result = httpx2.get(f"{server.url}/api/v1/submissions/{submission}/result.json").content
        assert result == command_line_result(small_archive, tiny_root, tmp_path)
        assert httpx2.get(f"{server.url}/submissions/{submission}").text.count("<img") >= 1
        assert submission_row(state, submission)["attempts"] == 1, "waiting for the scheduler was charged"


def test_killed_worker_or_scheduler_loses_no_submission(
    tiny_root: Path, tmp_path: Path, small_archive: Path, cluster: Cluster, running_server: RunServer
) -> None:
    state = tmp_path / "state"
    scheduler = cluster.start_scheduler()
    worker = cluster.start_worker()
    with running_server(tiny_root, state, dask_scheduler=cluster.address, lease_seconds=4) as server:
        token = server.token("alice")
        submission = server.submit_accepted(small_archive, token)
        wait_until(lambda: processes_below(worker.pid, SCORING), "the first worker scores")
        worker.kill()
        worker.wait()
        worker = cluster.start_worker()
        assert server.wait_until_ended(submission)["status"] == "scored"
        second_submission = server.submit_accepted(small_archive, token)
        wait_until(lambda: processes_below(worker.pid, SCORING), "the second worker scores")
        scheduler.kill()
        scheduler.wait()
        wait_until(lambda: is_logged(server, UNAVAILABLE), "the scheduler is unavailable")
        worker.kill()
        worker.wait()
        cluster.start_scheduler()
        cluster.start_worker()
        assert server.wait_until_ended(second_submission)["status"] == "scored"
        server.process.terminate()
        assert server.process.wait(40) == 0
    lines = [json.loads(line) for line in server.log[1:] if line]
    assert any(line.get("logger", "").startswith("distributed") for line in lines), "dask's lines are JSON too"
    assert submission_row(state, second_submission)["attempts"] == 1, "the scheduler's death was charged"


def test_worker_settings_have_absolute_paths_and_no_password(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "dataset").mkdir()
    settings = Settings(data="dataset", state_dir=Path("st"), db="postgresql://u:Hunter2@h/x")  # type: ignore[call-arg]
    worker_settings = settings_for_workers(settings)
    assert "Hunter2" not in worker_settings.model_dump_json()
    assert worker_settings.data == str(tmp_path / "dataset")
    assert worker_settings.state_dir == tmp_path / "st"
    assert worker_settings.archives_url == f"file://{tmp_path}/st/archives"
    hub = Settings(data="someone/rebar", archives="s3://bucket/x", state_dir=tmp_path)  # type: ignore[call-arg]
    worker_settings = settings_for_workers(hub)
    assert (worker_settings.data, worker_settings.archives_url) == ("someone/rebar", "s3://bucket/x")
    local_settings = settings_for_workers(settings.model_copy(update={"archives": "kept"}))
    assert local_settings.archives_url == f"{tmp_path}/kept"
