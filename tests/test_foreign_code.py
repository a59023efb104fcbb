"""Authors' code leaves what a checkpoint lacks at random numbers; here that is told or refused."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.foreign_code import error_words, filled, importable

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


def test_the_path_is_as_before_afterwards(tmp_path: Path) -> None:
    before, within = list(sys.path), list[str]()
    with importable(tmp_path):
        within.extend(sys.path)
    assert within == [str(tmp_path), *before]
    with pytest.raises(ZeroDivisionError), importable(tmp_path):
        raise ZeroDivisionError
    assert sys.path == before
