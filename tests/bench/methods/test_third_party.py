"""Third-party model code: incomplete checkpoints, errors in words, weight digests, downloads and ``sys.path``."""

from __future__ import annotations

import hashlib
import importlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette")
pytest.importorskip("torch")
pytest.importorskip("uvicorn")

from huggingface_hub import constants

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo
from rebar_depth_bench.methods.paper.monocular import UNIDEPTH_NETWORK
from rebar_depth_bench.methods.paper.third_party import HubNetwork, Network, on_sys_path
from tests.bench.methods.stand_in_models import unidepth_weights
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


def test_weights_digest_depends_on_names_and_content(tmp_path: Path) -> None:
    """The digest is taken over lines like those of ``sha256sum``, with the name first."""
    digests = []
    for folder, first, second in (("1", b"x", b"y"), ("2", b"x", b"y"), ("3", b"y", b"x")):
        (tmp_path / folder).mkdir()
        files = [tmp_path / folder / "a.pth", tmp_path / folder / "b.yaml"]
        for file, content in zip(files, (first, second), strict=True):
            file.write_bytes(content)
        digests.append(NETWORK.with_digest("mine", files))
    x, y = (hashlib.sha256(content).hexdigest() for content in (b"x", b"y"))
    expected = hashlib.sha256(f"a.pth {x}\nb.yaml {y}\n".encode()).hexdigest()
    info = replace(NETWORK.info, name="m:mine", summary=f"what; weights sha256:{expected}")
    assert digests[0] == digests[1] == info
    assert digests[2] != digests[0]


def test_on_sys_path_restores_sys_path(tmp_path: Path) -> None:
    before, within = list(sys.path), list[str]()

    def fail() -> None:
        within.extend(sys.path)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), on_sys_path(tmp_path):
        fail()
    assert within == [str(tmp_path), *before]
    assert sys.path == before


@pytest.fixture
def repository(hub: HubServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StoredRepository:
    """Return ``org/model`` of the Hub of this test, whose cache is empty, with weights in two formats."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    files = folder_files(unidepth_weights(tmp_path / "model"))
    return hub.add("models/org/model", {**files, "pytorch_model.bin": b"the same once more"})


def hub_method(repository: str = "org/model", package: str = "numpy") -> Method:
    """Return UniDepth with the weights of a repository of the Hub."""
    return replace(UNIDEPTH_NETWORK, repository=repository, module=package).with_weights(None)


def test_weights_are_fetched_once_then_read_from_cache(
    hub: HubServer,
    repository: StoredRepository,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    commit, loaded = repository.branches["main"], list[set[str]]()
    monkeypatch.setattr(
        HubNetwork, "_load", lambda _, folder: loaded.append({file.name for file in folder.iterdir()})
    )
    method = hub_method()
    assert method.info.name == "unidepth"
    assert method.info.summary.endswith(f"; weights commit {commit}")
    assert capsys.readouterr().err == f"org/model: downloading config.json from {hub.url}\n", "and no more"
    repository.commit("main", {})
    method.load()
    assert capsys.readouterr().err == f"org/model: downloading model.safetensors from {hub.url}\n"
    requested = {f"{request.method} {request.path}" for request in hub.requests}
    assert f"GET /org/model/resolve/{commit}/model.safetensors" in requested
    assert not [path for path in requested if "pytorch_model.bin" in path or "main/model.safetensors" in path]
    del hub.requests[:]
    for is_offline in (False, True):
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", is_offline)
        assert hub_method().info == method.info
        hub_method().load()
    assert loaded == [{"config.json", "model.safetensors"}] * 3
    assert (hub.requests, capsys.readouterr().err) == ([], "")
    [weights] = tmp_path.glob("cache/models--*/snapshots/*/model.safetensors")
    weights.unlink()
    with pytest.raises(
        MethodError, match=r"^org/model: model.safetensors must be downloaded, but .*OFFLINE is set"
    ):
        method.load()


def test_missing_package_prevents_download(hub: HubServer, repository: StoredRepository) -> None:
    with pytest.raises(MethodError, match="unidepth needs no_such_package, which is not installed: pip install"):
        hub_method(package="no_such_package")
    assert hub.requests == []


@pytest.mark.parametrize("missing", ["config.json", "model.safetensors"])
def test_failed_download_names_file_source_and_local_copy(
    missing: str, hub: HubServer, repository: StoredRepository
) -> None:
    is_config = missing == "config.json"
    if not is_config:
        repository.commit("main", {"config.json": repository.files()["config.json"]})
    name, error = ("org/other", "Repository") if is_config else ("org/model", "RemoteEntry")
    words = f"{name}: {missing} cannot be downloaded from {hub.url}: {error}NotFoundError"
    with pytest.raises(MethodError, match=words) as caught:
        hub_method(name).load()
    assert "(and HF_TOKEN if the model is not public), or a local copy: unidepth:FOLDER (hf d" in str(caught.value)
