"""Small dataset folders to publish, the command that publishes them, and Xet storage of the local Hub."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from dataset_builder.cli.main import main
from rebar_depth_bench.data.files import file_sha256
from tests.commands import run_in_process
from tests.hub_server import READ_TOKEN, TOKEN, HubServer, StoredRepository, folder_files
from tests.synthetic_dataset import write_dataset

HUB_ID = "org/data"
KEY = f"datasets/{HUB_ID}"


def write_publishable(root: Path, configs: Sequence[str] = ("lattice", "pile"), views: int = 2) -> Path:
    """Write a complete dataset folder, with a card that the Hub accepts, and return it."""
    write_dataset(root, configs, views)
    card = root / "README.md"
    card.write_text(card.read_text().replace("---\n", "---\nlicense: cc-by-4.0\n", 1))
    for name in ("meshes/none.ply", "pictures/none.webp"):
        (root / name).parent.mkdir()
        (root / name).write_bytes(name.encode())
    return list_files(root)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_publishable(tmp_path / "dataset")


def list_files(root: Path) -> Path:
    """Let the manifest of a folder list all files as they are, and return the folder."""
    manifest = json.loads((root / "manifest.json").read_text())
    names = sorted(set(folder_files(root)) - {"manifest.json"})
    manifest["files"] = {name: file_sha256(root / name) for name in names}
    (root / "manifest.json").write_text(json.dumps(manifest))
    return root


def push(root: Path, *options: str, hub_id: str = HUB_ID) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-build push``; the output never contains a token."""
    finished = run_in_process(main, "push", root, "--hub-id", hub_id, *options)
    output = finished.stdout + finished.stderr
    assert TOKEN not in output
    assert READ_TOKEN not in output
    assert "Traceback" not in output
    return finished


def refused(root: Path, *options: str, words: str, status: int = 2, hub_id: str = HUB_ID) -> str:
    """Push a folder; check that it is refused with words on standard error, which are returned whole."""
    finished = push(root, *options, hub_id=hub_id)
    assert finished.returncode == status, finished.stdout
    assert words in finished.stderr
    return finished.stderr


def visible(repository: StoredRepository, branch: str = "main") -> dict[str, bytes]:
    return {name: content for name, content in repository.files(branch).items() if not name.startswith(".")}


def environment(hub: HubServer, tmp_path: Path, **settings: str) -> dict[str, str]:
    home = {"HF_ENDPOINT": hub.url, "HF_HOME": str(tmp_path / "home"), "HF_HUB_OFFLINE": "0", "HF_TOKEN": TOKEN}
    return {**os.environ, **home, "HF_HUB_DISABLE_XET": "1", "NO_PROXY": "127.0.0.1", **settings}


def accept_xet(hub: HubServer, store: Path) -> dict[str, str]:
    """Let the Hub hand out tokens for ``store``; return the SHA-256 of large files by path, filled by commits.

    The content of a commit is not kept.
    """
    committed = dict[str, str]()
    store.mkdir()

    def token(_: Request) -> Response:
        values = {"casUrl": f"local://{store}", "accessToken": "xet", "exp": int(time.time()) + 3600}
        names = {"casUrl": "X-Xet-Cas-Url", "accessToken": "X-Xet-Access-Token", "exp": "X-Xet-Token-Expiration"}
        return JSONResponse(values, headers={name: str(values[key]) for key, name in names.items()})

    def commit(request: Request) -> Response:
        lines = [json.loads(line) for line in request._body.splitlines()]
        large = [line["value"] for line in lines if line["key"] == "lfsFile"]
        committed.update({value["path"]: value["oid"] for value in large})
        answer = {
            "commitUrl": f"{hub.url}/datasets/org/data/commit/{'c' * 40}",
            "commitOid": "c" * 40,
            "pullRequestUrl": None,
        }
        return JSONResponse(answer)

    hub.faults["GET */xet-write-token/*"] = token
    hub.faults["POST */commit/*"] = commit
    return committed
