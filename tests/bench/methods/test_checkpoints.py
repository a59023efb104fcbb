"""Checkpoints of the Hub: announced download, silent use of the cache, and failure messages."""

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
from tests.bench.methods.tiny_depth_models import save_checkpoint

LOAD = """
import sys
import numpy as np
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.methods import find_method

def run():
    method = find_method(sys.argv[1])
    print(method.info.summary)
    predict = method.load()
    row = {"left_rgb": np.zeros((90, 160, 3), np.uint8), "left_K": np.diag([80.0, 80, 1])}
    print(np.unique(predict(row)))

sys.exit(run_command(run))
"""


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save a Depth Pro that outputs 0.25 everywhere, which is 80 / (0.25 * 160) = 2 m, in both weight formats."""
    folder = save_checkpoint(tmp_path_factory.mktemp("hub") / "model", "depth-pro", 0.25)
    (folder / "pytorch_model.bin").write_bytes(b"the same once more")
    return folder


@pytest.fixture
def hub(model: Path) -> Iterator[tuple[str, list[str]]]:
    """Serve the model; yield the address and the list of requests."""
    requests: list[str] = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(HubRequestHandler, model, requests))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", requests
    server.shutdown()
    server.server_close()


def run_method(name: str, home: Path, endpoint: str, offline: str) -> subprocess.CompletedProcess[str]:
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


@pytest.mark.slow
def test_checkpoint_is_fetched_once_then_read_from_cache(
    hub: tuple[str, list[str]], model: Path, tmp_path: Path
) -> None:
    endpoint, requests = hub
    first = run_method("hf:org/model", tmp_path, endpoint, offline="0")
    assert first.returncode == 0, first.stderr
    assert first.stdout.endswith("[2.]\n")
    assert f"weights commit {COMMIT}" in first.stdout
    megabytes = sum(
        (model / name).stat().st_size for name in ("config.json", "preprocessor_config.json", "model.safetensors")
    )
    assert f"org/model: downloading config.json from {endpoint}\n" in first.stderr
    assert (
        f"org/model: downloading the weights from {endpoint}\norg/model: {megabytes / 1e6:.1f} MB\n"
        in first.stderr
    )
    assert any("model.safetensors" in request for request in requests)
    assert not any("pytorch_model.bin" in request for request in requests), "one kind of weights is enough"
    del requests[:]
    second = run_method("hf:org/model", tmp_path, endpoint, offline="1")
    assert (second.returncode, second.stdout) == (0, first.stdout)
    assert "downloading" not in second.stderr
    third = run_method("hf:org/model", tmp_path, endpoint, offline="0")
    assert (third.returncode, third.stdout) == (0, first.stdout)
    assert "downloading" not in third.stderr
    assert requests == [], "what is in the cache is not asked for"
    [weights] = tmp_path.glob("hub/models--*/snapshots/*/model.safetensors")
    weights.unlink()
    finished = run_method("hf:org/model", tmp_path, endpoint, offline="1")
    assert finished.returncode == 2
    assert "org/model: the weights must be downloaded, but HF_HUB_OFFLINE is set" in finished.stderr


@pytest.mark.slow
def test_offline_without_cache_exits_with_status_2(tmp_path: Path) -> None:
    finished = run_method("depth-pro", tmp_path, "http://127.0.0.1:9", offline="1")
    assert finished.returncode == 2
    assert finished.stderr.startswith("error: apple/DepthPro-hf: config.json must be downloaded, but HF_HUB_OFF")
    assert "pass their folder: hf:FOLDER (hf download apple/DepthPro-hf --local-dir FOLDER)\n" in finished.stderr
    assert "Traceback" not in finished.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hf:org/other", "depth-pro"])
def test_model_missing_on_hub_exits_with_status_2(name: str, hub: tuple[str, list[str]], tmp_path: Path) -> None:
    endpoint, _ = hub
    finished = run_method(name, tmp_path, endpoint, offline="0")
    assert finished.returncode == 2
    assert f"cannot be downloaded from {endpoint}: RepositoryNotFoundError" in finished.stderr
    assert "(and HF_TOKEN if the model is not public), or a local copy: hf" in finished.stderr
    assert "Traceback" not in finished.stderr
