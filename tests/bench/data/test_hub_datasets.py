"""Datasets on the Hub at a revision, from a server on this machine."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

from starlette.responses import Response

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.methods.transformers import hf_method
from tests.hub_server import HubServer, folder_files, running_hub

REVISIONS = ("main", "v1.0", "refs/pr/1")
SCRIPT = """
import sys
import rebar_depth_bench as rdb
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.cli.main import main
root, work = sys.argv[1:]
folder = open_folder(root)
print(folder.commit, len(list(iterate_rows(folder.config("lattice-orbit"), ["left_mask"]))))
print(len(list(rdb.load(root, "lattice-orbit", streaming=True, columns=["view_id"]))))
print(len(rdb.load(root, "lattice-orbit", columns=["view_id"])))
if main(["verify", root, "--files-only"]):
    sys.exit(1)
evaluator = rdb.Evaluator(root, "lattice-orbit", views=1)
for row in evaluator.dataset:
    evaluator.update(row["view_id"], row["left_depth"])
assert evaluator.compute().metrics["lattice-orbit/rank_error"] == 0
with rdb.SubmissionWriter(f"{work}/a.zip", "mine") as writer:
    for row in iterate_rows(folder.config("lattice-orbit"), ["view_id", "left_depth"]):
        writer.add(row["view_id"], row["left_depth"])
sys.exit(main(["score", f"{work}/a.zip", "--data", root]))
"""


OPEN = """
import sys
from rebar_depth_bench.data.manifest import open_folder
open_folder(sys.argv[1])
"""


@pytest.fixture(scope="module")
def reading_hub(tiny_root: Path) -> Iterator[HubServer]:
    """Serve the tiny dataset as ``org/data``, at a commit of its own for each revision."""
    with running_hub() as server:
        repository = server.add("datasets/org/data")
        for revision in REVISIONS:
            repository.commit(revision, folder_files(tiny_root), revision)
        yield server


def run_script(root: str, home: Path, endpoint: str, script: str = SCRIPT) -> subprocess.CompletedProcess[str]:
    settings = {"HF_HOME": str(home), "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1"}
    quiet = {"HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "NO_PROXY": "127.0.0.1"}
    command = [sys.executable, "-c", script, root, str(home.parent)]
    environment = os.environ | settings | quiet
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def filled_home(reading_hub: HubServer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a cache of the Hub from which everything was read at the revision ``main``."""
    home = tmp_path_factory.mktemp("hub") / "home"
    check_reading(reading_hub, "org/data", home, "main")
    return home


def check_reading(hub: HubServer, root: str, home: Path, revision: str) -> None:
    """Check that all files that the script reads are those of the commit of a revision."""
    hub.requests.clear()
    finished = run_script(root, home, hub.url)
    assert finished.returncode == 0, finished.stderr
    commit = hub.repositories["datasets/org/data"].branches[revision]
    lines = finished.stdout.splitlines()
    assert lines[:3] == [f"{commit} 2", "2", "2"]
    assert "no problem found in 10 files" in lines[3]
    requests = [request.path for request in hub.requests]
    shards = [request for request in requests if request.endswith(".parquet")]
    assert shards
    assert all(f"/{commit}/" in request for request in shards)
    assert not any("README" in request for request in requests if commit not in request)


@pytest.mark.slow
def test_revision_selects_the_commit_of_all_files(
    reading_hub: HubServer, filled_home: Path, tmp_path: Path
) -> None:
    check_reading(reading_hub, "org/data@refs/pr/1", tmp_path / "home", "refs/pr/1")
    finished = run_script("org/data@v2", filled_home, reading_hub.url, OPEN)
    assert "DatasetError: org/data@v2: not a local folder, and its manifest.json cannot" in finished.stderr


@pytest.mark.slow
def test_hub_without_answer_is_asked_once(hub: HubServer) -> None:
    hub.faults["HEAD *"] = lambda _: Response(status_code=503)
    with pytest.raises(rdb.DatasetError, match=r"^org/data: not a local folder, .* from the Hub: .*503"):
        open_folder("org/data")
    with pytest.raises(MethodError, match=r"cannot be downloaded from .*503"):
        hf_method("org/model")
    asked = [request.path for request in hub.requests if "/resolve/" in request.path]
    assert asked == ["/datasets/org/data/resolve/main/manifest.json", "/org/model/resolve/main/config.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("status", "script", "is_read"), [(503, SCRIPT, True), (401, OPEN, False), (404, OPEN, False)]
)
def test_cached_manifest_is_read_only_without_an_answer(
    reading_hub: HubServer, filled_home: Path, status: int, script: str, is_read: bool
) -> None:
    reading_hub.faults["HEAD *"] = lambda _: Response(status_code=status)
    try:
        finished = run_script("org/data", filled_home, reading_hub.url, script)
    finally:
        reading_hub.faults.clear()
    assert (finished.returncode == 0) == is_read, finished.stderr


def test_missing_folder_in_a_folder_is_not_asked_at_the_hub(
    hub: HubServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "org").mkdir()
    for root in ("org/data", "org/data@refs/pr/1"):
        with pytest.raises(rdb.DatasetError, match=f"^{root}: no such folder, .* Hub .* folder org exists here"):
            open_folder(root)
    with pytest.raises(MethodError, match=r"^org/model: .*, or ORG/NAME where there is no folder ORG"):
        hf_method("org/model")
    assert not [request for request in hub.requests if "/resolve/" in request.path]


@pytest.mark.parametrize(
    "root", ["org/data@", "org/data@../x", "org/data@a@b", "../data", "org/data@x y", "a/b/c@d"]
)
def test_text_that_is_no_folder_or_hub_id_is_refused(
    root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # The checkout may contain a folder "data".
    with pytest.raises(rdb.DatasetError, match="no such folder, expected a dataset folder or a Hub repository id"):
        open_folder(root)
