"""Third-party model code: incomplete checkpoints, errors in words, downloads and ``sys.path``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette")
pytest.importorskip("torch")
pytest.importorskip("uvicorn")

import numpy as np
from huggingface_hub import constants

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.base import MethodInfo
from rebar_depth_bench.methods.paper.third_party import Network, on_sys_path
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_models import GAIN, stand_in_packages, stereo_row, unidepth_weights
from tests.hub_server import HubServer, StoredRepository, folder_files

pytestmark = pytest.mark.slow  # torch takes seconds to import
torch: Any = importlib.import_module("torch")
NETWORK = Network(MethodInfo("m", "what", (), False, "", ""), install="pip install m's requirements")


def make_network() -> Any:
    """Return a network with 1000 weights shared by two names and a token of 4 weights."""
    model = torch.nn.Module()
    model.body, model.tied = torch.nn.Linear(100, 10, bias=False), torch.nn.Linear(100, 10, bias=False)
    model.tied.weight = model.body.weight
    model.token = torch.nn.Parameter(torch.zeros(4))
    return model


def test_missing_token_is_reported_and_shared_weights_count_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert not NETWORK.with_loaded_weights(make_network(), ["tied.weight", "token", "head.unknown"]).training
    assert capsys.readouterr().err == ""
    NETWORK.with_loaded_weights(make_network(), ["tied.weight"])
    assert capsys.readouterr().err == "m: the weights cover 99.60% of the network, 1 tensors are missing: token\n"
    with pytest.raises(
        MethodError, match=r"m: the weights cover 0.40% .* 1 tensors are missing, first body.weight"
    ):
        NETWORK.with_loaded_weights(make_network(), ["token"])


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("two\n  lines"), r"m: fails: ValueError: two lines$"),
        (ValueError("x" * 1000 + " the cause"), r"m: fails: ValueError: \.\.\. x{290} the cause$"),
        (ImportError("No module named 'mmcv'"), r"'mmcv'; to install what its code imports: pip install m's req"),
        (RuntimeError("operator torchvision::nms does not exist"), r"exist; install torch and torchvision of one"),
        (RuntimeError("Found no NVIDIA driver"), r"m: fails: its code requires a CUDA GPU, and torch finds none"),
        (MethodError("mine"), r"^mine$"),
    ],
)
def test_third_party_errors_and_output_are_translated(
    error: Exception, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)

    def print_and_raise() -> None:
        print("loud")
        raise error

    with pytest.raises(MethodError, match=words), NETWORK.errors("fails"):
        print_and_raise()
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "loud\n")
    with pytest.raises(KeyboardInterrupt), NETWORK.errors("fails"):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (None, "m needs strange .*: pip install strange$"),
        (
            "import addict_not_there",
            "m: strange is installed but cannot be imported: .* No module named 'addict_not_there'; "
            "to install what its code imports: pip install strange$",
        ),
        ("raise RuntimeError('x')", "m: strange is installed but cannot be imported: RuntimeError: x$"),
    ],
)
def test_missing_and_broken_packages_are_told_apart(
    code: str | None, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if code is not None:
        (tmp_path / "strange.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MethodError, match=words):
        NETWORK.import_package("strange", "pip install strange")


def test_on_sys_path_restores_sys_path(tmp_path: Path) -> None:
    before, within = list(sys.path), list[str]()

    def fail() -> None:
        within.extend(sys.path)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), on_sys_path(tmp_path):
        fail()
    assert within == [str(tmp_path), *before]
    assert sys.path == before


UNIDEPTH = "lpiccinelli/unidepth-v2-vitl14"


@pytest.fixture
def repository(hub: HubServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StoredRepository]:
    """Yield UniDepth on the Hub of this test, whose cache is empty, with weights in two formats."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    files = folder_files(unidepth_weights(tmp_path / "model"))
    with stand_in_packages(tmp_path / "site"):
        yield hub.add(f"models/{UNIDEPTH}", {**files, "pytorch_model.bin": b"the same once more"})


def test_weights_are_fetched_once_then_read_from_cache(
    hub: HubServer,
    repository: StoredRepository,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    commit, row = repository.branches["main"], stereo_row(np.full((9, 16), 200))
    method = find_method("unidepth")
    assert method.info.name == "unidepth"
    assert method.info.summary.endswith(f"; weights commit {commit}")
    assert capsys.readouterr().err == f"{UNIDEPTH}: downloading config.json from {hub.url}\n", "and no more"
    repository.commit("main", {})
    assert (load_predictor(method)(row) == 200 * GAIN).all()
    stderr = capsys.readouterr().err
    assert stderr.splitlines()[0] == f"{UNIDEPTH}: downloading model.safetensors from {hub.url}"
    assert stderr.count("downloading") == 1
    requested = {f"{request.method} {request.path}" for request in hub.requests}
    assert f"GET /{UNIDEPTH}/resolve/{commit}/model.safetensors" in requested
    assert not [path for path in requested if "pytorch_model.bin" in path or "main/model.safetensors" in path]
    del hub.requests[:]
    for is_offline in (False, True):
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", is_offline)
        assert find_method("unidepth").info == method.info
        assert (load_predictor("unidepth")(row) == 200 * GAIN).all()
    assert (hub.requests, "downloading" in capsys.readouterr().err) == ([], False)
    [weights] = tmp_path.glob("cache/models--*/snapshots/*/model.safetensors")
    weights.unlink()
    with pytest.raises(MethodError, match=f"^{UNIDEPTH}: model.safetensors must be downloaded, but .*OFFLINE is"):
        load_predictor(method)


def test_missing_package_prevents_download(
    hub: HubServer, repository: StoredRepository, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "unidepth", None)
    with pytest.raises(MethodError, match="unidepth needs unidepth, which is not installed: pip install"):
        find_method("unidepth")
    assert hub.requests == []


@pytest.mark.parametrize("missing", ["config.json", "model.safetensors"])
def test_failed_download_names_file_source_and_local_copy(
    missing: str, hub: HubServer, repository: StoredRepository
) -> None:
    files = dict(repository.files())
    del files[missing]
    repository.commit("main", files)
    words = f"{UNIDEPTH}: {missing} cannot be downloaded from {hub.url}: RemoteEntryNotFoundError"
    with pytest.raises(MethodError, match=words) as caught:
        load_predictor("unidepth")
    assert "(and HF_TOKEN if the model is not public), or a local copy: unidepth:FOLDER (hf d" in str(caught.value)
