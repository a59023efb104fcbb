"""Datasets on the Hub at a revision, from a server on this machine."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote

import pytest
import yaml
from huggingface_hub import parse_eval_result_entries

import rebar_depth_bench as rdb
from rebar_depth_bench.data.manifest import open_folder

COMMITS = {"main": "a" * 40, "v1.0": "b" * 40, "refs/pr/1": "c" * 40}
SCRIPT = """
import sys
import rebar_depth_bench as rdb
from rebar_depth_bench.data.dataset import iterate_rows
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.cli.main import main
root, work = sys.argv[1:]
folder = open_folder(root)
print(folder.commit, len(list(iterate_rows(folder.config("lattice-orbit"), ["left_mask"]))))
print(len(list(rdb.load(root, "lattice-orbit", streaming=True, columns=["view_id"]))))
print(len(rdb.load(root, "lattice-orbit", columns=["view_id"])))
if main(["verify", root, "--files-only"]):
    sys.exit(1)
with rdb.SubmissionWriter(f"{work}/a.zip", "mine") as writer:
    for row in iterate_rows(folder.config("lattice-orbit"), ["view_id", "left_depth"]):
        writer.add(row["view_id"], row["left_depth"])
outputs = ["--eval-results", f"{work}/results.yaml", "--hub-id", "org/data"]
sys.exit(main(["score", f"{work}/a.zip", "--data", root, *outputs]))
"""


class DatasetRequestHandler(BaseHTTPRequestHandler):
    """Request handler with the endpoints of the Hub that read one dataset, ``org/data``, at several commits."""

    def __init__(self, folder: Path, requests: list[str], *rest: object) -> None:
        self.folder, self.requests = folder, requests
        super().__init__(*rest)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        self.answer()

    def do_HEAD(self) -> None:
        self.answer()

    def log_message(self, *_: object) -> None:
        """Suppress the request log."""

    def answer(self) -> None:
        path = unquote(self.path.partition("?")[0])
        self.requests.append(f"{self.command} {path}")
        for revision, commit in [*COMMITS.items(), *((commit, commit) for commit in COMMITS.values())]:
            file = self.folder / path.removeprefix(f"/datasets/org/data/resolve/{revision}/").lstrip("/")
            if path.startswith(f"/datasets/org/data/resolve/{revision}/") and file.is_file():
                self.send_file(file, commit)
                return
            if path.startswith(tree := f"/api/datasets/org/data/tree/{revision}/"):
                self.send_tree(self.folder / path.removeprefix(tree))
                return
            if path == f"/api/datasets/org/data/revision/{revision}":
                self.reply(200, json.dumps({"id": "org/data", "sha": commit, "siblings": []}).encode(), {})
                return
        self.reply(404, b"{}", {"X-Error-Code": "RevisionNotFound"})

    def send_tree(self, folder: Path) -> None:
        entries = [
            {
                "type": "file",
                "path": file.relative_to(self.folder).as_posix(),
                "size": file.stat().st_size,
                "oid": sha1(file),
            }
            for file in folder.iterdir()
        ]
        self.reply(200, json.dumps(entries).encode(), {})

    def send_file(self, file: Path, commit: str) -> None:
        content = file.read_bytes()
        headers = {"ETag": f'"{sha1(file)}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes"}
        first, _, last = self.headers.get("Range", "").removeprefix("bytes=").partition("-")
        if first and self.command == "GET":
            part = content[int(first) : int(last) + 1 if last else None]
            self.reply(206, part, headers | {"Content-Range": f"bytes {first}-{last}/{len(content)}"})
        else:
            self.reply(200, content, headers)

    def reply(self, status: int, body: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)


def sha1(path: Path) -> str:
    """Return the SHA-1 of a file in hexadecimal, used as ETag and object id."""
    return hashlib.sha1(path.read_bytes()).hexdigest()


@pytest.fixture
def hub(tiny_root: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve the tiny dataset; yield the address and the list of requests."""
    requests = list[str]()
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(DatasetRequestHandler, tiny_root, requests))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", requests
    server.shutdown()
    server.server_close()


def run_script(root: str, home: Path, endpoint: str) -> subprocess.CompletedProcess[str]:
    settings = {"HF_HOME": str(home), "HF_ENDPOINT": endpoint, "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1"}
    quiet = {"HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "NO_PROXY": "127.0.0.1"}
    command = [sys.executable, "-c", SCRIPT, root, str(home.parent)]
    environment = os.environ | settings | quiet
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("revision", ["", "@refs/pr/1"])
def test_revision_selects_the_commit_of_all_files(
    hub: tuple[str, list[str]], tmp_path: Path, revision: str
) -> None:
    endpoint, requests = hub
    finished = run_script(f"org/data{revision}", tmp_path / "home", endpoint)
    assert finished.returncode == 0, finished.stderr
    commit = COMMITS.get(revision[1:] or "main", revision[1:])
    lines = finished.stdout.splitlines()
    assert lines[:3] == [f"{commit} 2", "2", "2"]
    assert "no problem found in 10 files" in lines[3]
    [entry] = parse_eval_result_entries(yaml.safe_load((tmp_path / "results.yaml").read_text()))
    assert (entry.dataset_id, entry.task_id, entry.dataset_revision) == ("org/data", "lattice-orbit", commit)
    shards = [request for request in requests if request.endswith(".parquet")]
    assert shards
    assert all(f"/{commit}/" in request for request in shards)
    assert not any("README" in request for request in requests if commit not in request)


@pytest.mark.slow
def test_unknown_revision_is_refused(hub: tuple[str, list[str]], tmp_path: Path) -> None:
    finished = run_script("org/data@v2", tmp_path / "home", hub[0])
    assert "DatasetError: org/data@v2: not a local folder, and its manifest.json cannot" in finished.stderr


@pytest.mark.parametrize(
    "root", ["org/data@", "org/data@../x", "org/data@a@b", "../data", "org/data@x y", "a/b/c@d"]
)
def test_text_that_is_no_folder_or_hub_id_is_refused(root: str) -> None:
    with pytest.raises(rdb.DatasetError, match="no such folder, expected a dataset folder or a Hub repository id"):
        open_folder(root)
