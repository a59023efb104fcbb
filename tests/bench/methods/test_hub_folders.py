"""Weight folders from the Hub: announced download, silent use of the cache, and failure messages."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.bench.methods.hub_server import COMMIT, HubRequestHandler
from tests.bench.methods.stand_in_models import unidepth_weights

SCRIPT = """
import sys
from dataclasses import replace
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.methods.paper import monocular, third_party

def show(network, folder):
    print(*sorted(one.name for one in folder.iterdir()))

third_party.HubNetwork._load = show

def run():
    package = sys.argv[2]
    method = replace(monocular.UNIDEPTH_NETWORK, repository=sys.argv[1], module=package).with_weights(None)
    print(method.info.name, method.info.summary.rpartition("; ")[2])
    print("loading", file=sys.stderr, flush=True)
    method.load()

sys.exit(run_command(run))
"""
EXPECTED_OUTPUT = f"unidepth weights commit {COMMIT}\nconfig.json model.safetensors\n"


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve a model with a file that must not be requested; yield the address and the list of requests."""
    folder, requests = unidepth_weights(tmp_path / "model"), list[str]()
    (folder / "pytorch_model.bin").write_bytes(b"the same once more")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(HubRequestHandler, folder, requests))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", requests
    server.shutdown()
    server.server_close()


def run_method(
    repository: str, home: Path, endpoint: str, offline: str, package: str = "numpy"
) -> subprocess.CompletedProcess[str]:
    settings = {
        "HF_HOME": str(home),
        "HF_ENDPOINT": endpoint,
        "HF_HUB_OFFLINE": offline,
        "HF_HUB_DISABLE_XET": "1",
    }
    quiet = {"HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1", "NO_PROXY": "127.0.0.1"}
    command = [sys.executable, "-c", SCRIPT, repository, package]
    environment = os.environ | settings | quiet
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
def test_missing_package_prevents_download(hub: tuple[str, list[str]], tmp_path: Path) -> None:
    endpoint, requests = hub
    finished = run_method("org/model", tmp_path / "home", endpoint, offline="0", package="no_such_package")
    assert finished.returncode == 2
    assert "unidepth needs no_such_package, which is not installed: pip install" in finished.stderr
    assert requests == []


@pytest.mark.slow
def test_weights_are_fetched_once_then_read_from_cache(hub: tuple[str, list[str]], tmp_path: Path) -> None:
    endpoint, requests = hub
    first = run_method("org/model", tmp_path / "home", endpoint, offline="0")
    assert (first.returncode, first.stdout) == (0, EXPECTED_OUTPUT), first.stderr
    before, _, after = first.stderr.partition("loading\n")
    assert before == f"org/model: downloading config.json from {endpoint}\n", (
        "what the commit is known by, and no more"
    )
    assert after == f"org/model: downloading model.safetensors from {endpoint}\n"
    assert all(request.endswith("/config.json") for request in requests if "main" in request)
    weights = {request for request in requests if "model.safetensors" in request}
    assert f"GET /org/model/resolve/{COMMIT}/model.safetensors" in weights
    assert all(COMMIT in request for request in weights), "not what the main branch is by now"
    assert not any("pytorch_model.bin" in request for request in requests)
    del requests[:]
    second = run_method("org/model", tmp_path / "home", endpoint, offline="1")
    assert (second.returncode, second.stdout) == (0, EXPECTED_OUTPUT), second.stderr
    assert "downloading" not in second.stderr
    assert requests == []
    [weights_file] = tmp_path.glob("home/hub/models--*/snapshots/*/model.safetensors")
    weights_file.unlink()
    third = run_method("org/model", tmp_path / "home", endpoint, offline="1")
    assert third.returncode == 2
    assert "error: org/model: model.safetensors must be downloaded, but HF_HUB_OFFLINE is set" in third.stderr
    assert "their folder: unidepth:FOLDER (hf download org/model --local-dir FOLDER)\n" in third.stderr


@pytest.mark.slow
def test_model_missing_on_hub_exits_with_status_2(hub: tuple[str, list[str]], tmp_path: Path) -> None:
    endpoint, _ = hub
    finished = run_method("org/other", tmp_path / "home", endpoint, offline="0")
    assert finished.returncode == 2
    assert (
        f"org/other: config.json cannot be downloaded from {endpoint}: RepositoryNotFoundError" in finished.stderr
    )
    assert "or a local copy: unidepth:FOLDER" in finished.stderr
    assert "Traceback" not in finished.stderr
    [weights] = tmp_path.glob("model/model.safetensors")
    weights.unlink()
    finished = run_method("org/model", tmp_path / "home", endpoint, offline="0")
    assert finished.returncode == 2
    assert (
        f"org/model: model.safetensors cannot be downloaded from {endpoint}: RemoteEntryNotFoundError"
        in finished.stderr
    )
