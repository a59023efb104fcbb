"""Authors' code leaves what a checkpoint lacks at random numbers; here that is told or refused."""

from __future__ import annotations

import hashlib
import importlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo
from rebar_depth_bench.methods.monocular.third_party import error_words, filled, importable, with_weights

torch: Any = importlib.import_module("torch")


def network() -> Any:
    """1000 weights under two names, and a token of 4 that a checkpoint may lack."""
    one = torch.nn.Module()
    one.body, one.tied = torch.nn.Linear(100, 10, bias=False), torch.nn.Linear(100, 10, bias=False)
    one.tied.weight = one.body.weight
    one.token = torch.nn.Parameter(torch.zeros(4))
    return one


def test_a_token_that_lacks_is_told_and_a_shared_weight_counts_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert not filled("m", torch, network(), ["tied.weight", "token", "head.unknown"]).training
    assert capsys.readouterr().err == ""
    filled("m", torch, network(), ["tied.weight"])
    assert capsys.readouterr().err == "m: the weights fill 99.60% of the network, lacking 1 tensors: token\n"


def test_a_body_that_lacks_is_refused() -> None:
    with pytest.raises(
        MethodError, match=r"m: the weights fill 0.40% .* lacking 1 tensors, first body.weight, exp"
    ):
        filled("m", torch, network(), ["token"])


def loud_and_broken() -> None:
    print("loud")
    raise ValueError("two\n  lines")


def test_what_strangers_raise_and_print(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MethodError, match=r"^m: fails: ValueError: two lines$"), error_words("m", torch, "fails"):
        loud_and_broken()
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", "loud\n")
    with pytest.raises(MethodError, match=r"^mine$"), error_words("m", torch, "fails"):
        raise MethodError("mine")
    with pytest.raises(KeyboardInterrupt), error_words("m", torch, "fails"):
        raise KeyboardInterrupt


def test_weights_are_told_by_names_and_content_and_not_by_their_place(tmp_path: Path) -> None:
    """The digest is that of ``sha256sum``'s own words, name first."""
    info = MethodInfo("m", "what", (), False, "", "")
    digests = []
    for place, one, other in (("1", b"x", b"y"), ("2", b"x", b"y"), ("3", b"y", b"x")):
        (tmp_path / place).mkdir()
        files = [tmp_path / place / "a.pth", tmp_path / place / "b.yaml"]
        for file, content in zip(files, (one, other), strict=True):
            file.write_bytes(content)
        digests.append(with_weights(info, "mine", files))
    x, y = (hashlib.sha256(content).hexdigest() for content in (b"x", b"y"))
    expected = hashlib.sha256(f"a.pth {x}\nb.yaml {y}\n".encode()).hexdigest()
    assert digests[0] == digests[1] == replace(info, name="m:mine", summary=f"what; weights sha256:{expected}")
    assert digests[2] != digests[0]


def test_the_path_is_as_before_afterwards(tmp_path: Path) -> None:
    before, within = list(sys.path), list[str]()
    with importable(tmp_path):
        within.extend(sys.path)
    assert within == [str(tmp_path), *before]
    with pytest.raises(ZeroDivisionError), importable(tmp_path):
        raise ZeroDivisionError
    assert sys.path == before
