"""Helpers for third-party model code: incomplete checkpoints, error translation, weight digests, ``sys.path``."""

from __future__ import annotations

import hashlib
import importlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo
from rebar_depth_bench.methods.paper.third_party import Network, on_sys_path

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


def test_missing_body_weights_raise() -> None:
    with pytest.raises(
        MethodError, match=r"m: the weights cover 0.40% .* 1 tensors are missing, first body.weight, exp"
    ):
        NETWORK.with_loaded_weights(make_network(), ["token"])


def print_and_raise() -> None:
    print("loud")
    raise ValueError("two\n  lines")


def test_third_party_errors_and_output_are_translated(capsys: pytest.CaptureFixture[str]) -> None:
    with (
        pytest.raises(MethodError, match=r"^m: fails: ValueError: two lines$"),
        NETWORK.errors("fails"),
    ):
        print_and_raise()
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "loud\n")
    with pytest.raises(MethodError, match=r"^mine$"), NETWORK.errors("fails"):
        raise MethodError("mine")
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
        (
            "raise RuntimeError('operator torchvision::nms does not exist')",
            "m: strange is installed but cannot be imported: RuntimeError: operator torchvision::nms does not "
            "exist; install torch and torchvision of one release",
        ),
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
    assert (
        digests[0]
        == digests[1]
        == replace(NETWORK.info, name="m:mine", summary=f"what; weights sha256:{expected}")
    )
    assert digests[2] != digests[0]


def test_on_sys_path_restores_sys_path(tmp_path: Path) -> None:
    before, within = list(sys.path), list[str]()
    with on_sys_path(tmp_path):
        within.extend(sys.path)
    assert within == [str(tmp_path), *before]
    with pytest.raises(ZeroDivisionError), on_sys_path(tmp_path):
        raise ZeroDivisionError
    assert sys.path == before
