"""Checkpoints of the Hub: from its cache in silence, over the network with a word first, or a reason why not."""

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

import pytest

from tests.bench.methods.tiny_depth_models import save

COMMIT = "0123456789abcdef0123456789abcdef01234567"
LOAD = """
import sys
import numpy as np
from rebar_depth_bench.console import run_command
from rebar_depth_bench.methods import find_method

def run():
    method = find_method(sys.argv[1])
    print(method.info.summary)
    predict = method.load()
    row = {"left_rgb": np.zeros((90, 160, 3), np.uint8), "left_K": np.diag([80.0, 80, 1])}
    print(np.unique(predict(row)))

sys.exit(run_command(run))
"""


class Hub(BaseHTTPRequestHandler):
    """What the Hub's client asks of a server: a model's list of files, and the files."""

    def __init__(self, folder: Path, asked: list[str], *rest: object) -> None:
        self.folder, self.asked = folder, asked
        super().__init__(*rest)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        self.answer(with_body=True)

    def do_HEAD(self) -> None:
        self.answer(with_body=False)

    def log_message(self, *_: object) -> None:
        """Keep quiet."""

    def answer(self, with_body: bool) -> None:
        path, _, _ = self.path.partition("?")
        self.asked.append(f"{self.command} {path}")
        if path.startswith("/api/models/org/model/tree"):
            entries = [
                {"type": "file", "path": one.name, "size": one.stat().st_size, "oid": digest(one)}
                for one in sorted(self.folder.iterdir())
            ]
            self.reply(200, json.dumps(entries).encode(), {}, with_body)
        elif path.startswith("/api/models/org/model"):
            files = [{"rfilename": one.name, "size": one.stat().st_size} for one in sorted(self.folder.iterdir())]
            found = {"id": "org/model", "modelId": "org/model", "sha": COMMIT, "siblings": files}
            self.reply(200, json.dumps(found).encode(), {}, with_body)
        elif path.startswith("/org/model/resolve/") and (file := self.folder / Path(path).name).is_file():
            self.reply(200, file.read_bytes(), {"ETag": f'"{digest(file)}"', "X-Repo-Commit": COMMIT}, with_body)
        else:
            self.reply(404, b"{}", {"X-Error-Code": "RepoNotFound"}, with_body)

    def reply(self, status: int, body: bytes, headers: dict[str, str], with_body: bool) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if with_body:
            self.wfile.write(body)


def digest(path: Path) -> str:
    return hashlib.sha1(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Depth Pro that puts out 0.25 everywhere: 80 / (0.25 * 160) = 2 m. Its weights are there in both kinds."""
    folder = save(tmp_path_factory.mktemp("hub") / "model", "depth-pro", 0.25)
    (folder / "pytorch_model.bin").write_bytes(b"the same once more")
    return folder


@pytest.fixture
def hub(model: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve it; yield the address and what was asked."""
    asked: list[str] = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Hub, model, asked))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", asked
    server.shutdown()
    server.server_close()


def run(name: str, home: Path, endpoint: str, offline: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {
        "HF_HOME": str(home),
        "HF_ENDPOINT": endpoint,
        "HF_HUB_OFFLINE": offline,
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        "HF_HUB_DISABLE_XET": "1",
        "NO_PROXY": "127.0.0.1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
    }
    return subprocess.run(
        [sys.executable, "-c", LOAD, name],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_fetched_once_with_a_word_first_and_then_from_the_cache(
    hub: tuple[str, list[str]], model: Path, tmp_path: Path
) -> None:
    endpoint, asked = hub
    first = run("hf:org/model", tmp_path, endpoint, offline="0")
    assert first.returncode == 0, first.stderr
    assert first.stdout.endswith("[2.]\n")
    assert f"weights commit {COMMIT}" in first.stdout
    megabytes = sum(
        (model / name).stat().st_size for name in ("config.json", "preprocessor_config.json", "model.safetensors")
    )
    assert f"org/model: fetching config.json from {endpoint}\n" in first.stderr
    assert (
        f"org/model: fetching the weights from {endpoint}\norg/model: {megabytes / 1e6:.1f} MB\n" in first.stderr
    )
    assert any("model.safetensors" in request for request in asked)
    assert not any("pytorch_model.bin" in request for request in asked), "one kind of weights is enough"
    del asked[:]
    second = run("hf:org/model", tmp_path, endpoint, offline="1")
    assert (second.returncode, second.stdout) == (0, first.stdout)
    assert "fetching" not in second.stderr
    third = run("hf:org/model", tmp_path, endpoint, offline="0")
    assert (third.returncode, third.stdout) == (0, first.stdout)
    assert "fetching" not in third.stderr
    assert asked == [], "what is in the cache is not asked for"
    [weights] = tmp_path.glob("hub/models--*/snapshots/*/model.safetensors")
    weights.unlink()
    finished = run("hf:org/model", tmp_path, endpoint, offline="1")
    assert finished.returncode == 2
    assert "org/model: the weights not on this machine, and HF_HUB_OFFLINE is set" in finished.stderr


def test_offline_and_not_in_the_cache(tmp_path: Path) -> None:
    finished = run("depth-pro", tmp_path, "http://127.0.0.1:9", offline="1")
    assert finished.returncode == 2
    assert finished.stderr.startswith("error: apple/DepthPro-hf: config.json not on this machine, and HF_HUB_OFF")
    assert "name their folder: hf:FOLDER (hf download apple/DepthPro-hf --local-dir FOLDER)\n" in finished.stderr
    assert "Traceback" not in finished.stderr


@pytest.mark.parametrize("name", ["hf:org/other", "depth-pro"])
def test_what_the_hub_does_not_have(name: str, hub: tuple[str, list[str]], tmp_path: Path) -> None:
    endpoint, _ = hub
    finished = run(name, tmp_path, endpoint, offline="0")
    assert finished.returncode == 2
    assert f"cannot be fetched from {endpoint}: RepositoryNotFoundError" in finished.stderr
    assert "expected a connection, HF_TOKEN for a model that is not public, or a local copy: hf" in finished.stderr
    assert "Traceback" not in finished.stderr
