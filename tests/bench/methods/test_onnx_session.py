"""An ONNX model that does not fit its TOML file is refused in words when it is loaded, before any view."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods import find_method
from tests.bench.methods.onnx_models import DEPTH, OPEN, PLAIN, described, fixed, mixer, run, write_model
from tests.bench.methods.predictors import loaded

IDENTITY = helper.make_node("ReduceMean", ["x"], ["y"], axes=[1])
SUM = helper.make_node("Sum", ["x", "k"], ["y"])
BROKEN = helper.make_node("Reshape", ["x", "to"], ["y"])
CASE = tuple[dict[str, Any], str, str, str]
UNFIT: dict[str, CASE] = {
    "two inputs": (
        {"nodes": [SUM], "more_inputs": ["k"]},
        PLAIN,
        DEPTH,
        "takes 2 inputs ('x', 'k'), expected one",
    ),
    "channels last": (
        {"nodes": [IDENTITY], "input_shape": (1, "h", "w", 3)},
        PLAIN,
        DEPTH,
        "input 'x' has the shape 1 x ? x ? x 3, expected 1 x 3 x H x W",
    ),
    "channels last, fixed": (
        {"nodes": [IDENTITY], "input_shape": (1, 4, 6, 3)},
        PLAIN,
        DEPTH,
        "1 x 4 x 6 x 3, expected 1 x 3 x H x W: channels come before height and width",
    ),
    "no batch": ({"nodes": [IDENTITY], "input_shape": (3, 4, 6)}, PLAIN, DEPTH, "3 x 4 x 6, expected 1 x 3 x H"),
    "a batch of two": (
        {"nodes": [IDENTITY], "input_shape": (2, 3, 4, 6)},
        PLAIN,
        DEPTH,
        "2 x 3 x 4 x 6, expected",
    ),
    "another width": (
        {"nodes": [IDENTITY], "input_shape": (1, 3, "h", 8)},
        PLAIN,
        DEPTH,
        "got 6, expected [input] width = 8",
    ),
    "a fixed size for an open one": (
        {"nodes": [IDENTITY], "input_shape": (1, 3, 4, 6)},
        "longest_side = 6\nresize = 'stretch'\nrange = 1",
        DEPTH,
        "got an open one (longest_side), expected [input] height = 4",
    ),
    "whole numbers in": (
        {"nodes": [helper.make_node("Neg", ["x"], ["y"])]}
        | {"input_type": TensorProto.INT32, "output_type": TensorProto.INT32},
        PLAIN,
        DEPTH,
        "input 'x' is tensor(int32), expected one of tensor(float)",
    ),
    "whole numbers out": (
        {"nodes": [helper.make_node("Shape", ["x"], ["y"])], "output_type": TensorProto.INT64},
        PLAIN,
        DEPTH,
        "output 'y' is tensor(int64), expected one of tensor(float)",
    ),
    "two outputs": (
        {"nodes": [IDENTITY, helper.make_node("Neg", ["x"], ["z"])], "outputs": ["y", "z"]},
        PLAIN,
        DEPTH,
        "the model has 2 outputs, expected [output] name to be one of 'y', 'z'",
    ),
    "an unknown output": (
        {"nodes": [IDENTITY]},
        PLAIN,
        f"{DEPTH}\nname = 'q'",
        "no output 'q', expected one of 'y'",
    ),
    "an output too far": ({"nodes": [IDENTITY]}, PLAIN, f"{DEPTH}\nindex = 1", "no output 1, expected one of 'y'"),
    "three channels out": (
        {"nodes": [helper.make_node("Neg", ["x"], ["y"])]},
        PLAIN,
        DEPTH,
        "output 'y' has the shape (1, 3, 4, 6), expected H x W, with any ones before",
    ),
    "one number out": (
        {"nodes": [helper.make_node("ReduceMean", ["x"], ["y"], keepdims=0)]},
        PLAIN,
        DEPTH,
        "output 'y' has the shape (), expected H x W",
    ),
    "fails when it runs": (
        {"nodes": [BROKEN], "constants": {"to": np.array([5, 5])}},
        PLAIN,
        DEPTH,
        "model.onnx: fails on an input of 1 x 3 x 4 x 6: ",
    ),
}


@pytest.mark.parametrize("case", UNFIT.values(), ids=UNFIT)
def test_a_model_that_does_not_fit_is_refused_when_it_is_loaded(case: CASE, tmp_path: Path) -> None:
    model, given, returned, words = case
    write_model(tmp_path, **{"input_shape": OPEN, **model})
    method = find_method(str(described(tmp_path, given, returned)))
    with pytest.raises(MethodError, match=re.escape(words)) as caught:
        loaded(method)
    assert "model.onnx: " in str(caught.value)


def test_a_smaller_answer_needs_to_be_said(tmp_path: Path) -> None:
    fixed(tmp_path, np.ones((1, 2, 3)))
    with pytest.raises(
        MethodError, match=re.escape("(1, 2, 3), expected 4 x 6 or [output] at_input_size = false")
    ):
        loaded(str(described(tmp_path)))


def test_one_of_several_outputs_is_taken_by_name_or_place(tmp_path: Path) -> None:
    nodes = [helper.make_node("Neg", ["x"], ["no"]), helper.make_node("ReduceMax", ["x"], ["y"], axes=[1])]
    write_model(tmp_path, nodes, outputs=["no", "y"])
    for which in ("name = 'y'", "index = 1"):
        assert (
            np.unique(run(described(tmp_path, returned=f"{DEPTH}\n{which}"), np.full((4, 6, 3), 9, np.uint8))) == 9
        )


def test_a_file_that_is_no_model_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.onnx").write_bytes(b"not a model at all")
    with pytest.raises(MethodError, match=r"model\.onnx: onnxruntime cannot open this model: "):
        loaded(str(described(tmp_path)))
    assert capsys.readouterr().err == ""


def test_without_onnxruntime_one_sentence_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mixer(tmp_path)
    method = find_method(str(described(tmp_path)))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MethodError, match=re.escape("pip install 'rebar-depth-bench[onnx]'")):
        loaded(method)
