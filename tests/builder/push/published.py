"""Small dataset folders to publish, and the command that publishes them."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dataset_builder.cli.main import main
from rebar_depth_bench.data.files import file_sha256
from tests.commands import run_in_process
from tests.hub_server import READ_TOKEN, TOKEN, folder_files
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
