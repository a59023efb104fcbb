"""Loading of ONNX models that do not match their TOML file: errors before the first view."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import numpy as np
from onnx import TensorProto, helper

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import find_method
from tests.bench.methods.onnx_models import (
    DEPTH_OUTPUT,
    OPEN_SHAPE,
    PLAIN_INPUT,
    predict_depth,
    write_constant_model,
    write_mixer_model,
    write_model,
    write_toml,
)
from tests.bench.methods.predictors import load_predictor

CHANNEL_MEAN = helper.make_node("ReduceMean", ["x"], ["y"], axes=[1])
SUM_OF_TWO_INPUTS = helper.make_node("Sum", ["x", "k"], ["y"])
FAILING_RESHAPE = helper.make_node("Reshape", ["x", "to"], ["y"])
Mismatch = tuple[dict[str, Any], str, str, str]
MISMATCHES: dict[str, Mismatch] = {
    "two inputs": (
        {"nodes": [SUM_OF_TWO_INPUTS], "more_inputs": ["k"]},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid input: the model takes 2 ('x', 'k'), expected one",
    ),
    "channels last": (
        {"nodes": [CHANNEL_MEAN], "input_shape": (1, "h", "w", 3)},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid input: the model takes 1 x ? x ? x 3, expected 1 x 3 x H x W",
    ),
    "channels last, fixed": (
        {"nodes": [CHANNEL_MEAN], "input_shape": (1, 4, 6, 3)},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid input: the model takes 1 x 4 x 6 x 3, expected 1 x 3 x H x W: channels come before",
    ),
    "no batch": (
        {"nodes": [CHANNEL_MEAN], "input_shape": (3, 4, 6)},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid input: the model takes 3 x 4 x 6, expected 1 x 3 x H",
    ),
    "a batch of two": (
        {"nodes": [CHANNEL_MEAN], "input_shape": (2, 3, 4, 6)},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid input: the model takes 2 x 3 x 4 x 6, expected",
    ),
    "another width": (
        {"nodes": [CHANNEL_MEAN], "input_shape": (1, 3, "h", 8)},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "size input.width: got 6, the model takes 1 x 3 x ? x 8, expected 8",
    ),
    "a fixed size for an open one": (
        {"nodes": [CHANNEL_MEAN], "input_shape": (1, 3, 4, 6)},
        "longest_side = 6\nresize = 'stretch'\nrange = 1",
        DEPTH_OUTPUT,
        "size input.height: got a variable size (longest_side), the model takes 1 x 3 x 4 x 6, expected 4",
    ),
    "whole numbers in": (
        {"nodes": [helper.make_node("Neg", ["x"], ["y"])]}
        | {"input_type": TensorProto.INT32, "output_type": TensorProto.INT32},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid input: 'x' is tensor(int32), expected one of tensor(float)",
    ),
    "whole numbers out": (
        {"nodes": [helper.make_node("Shape", ["x"], ["y"])], "output_type": TensorProto.INT64},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "invalid output: 'y' is tensor(int64), expected one of tensor(float)",
    ),
    "two outputs": (
        {"nodes": [CHANNEL_MEAN, helper.make_node("Neg", ["x"], ["z"])], "outputs": ["y", "z"]},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "missing output.name: the model has 2 outputs, expected one of 'y', 'z'",
    ),
    "an unknown output": (
        {"nodes": [CHANNEL_MEAN]},
        PLAIN_INPUT,
        f"{DEPTH_OUTPUT}\nname = 'q'",
        "unknown output.name: the model has no output 'q', expected one of 'y'",
    ),
    "an output too far": (
        {"nodes": [CHANNEL_MEAN]},
        PLAIN_INPUT,
        f"{DEPTH_OUTPUT}\nindex = 1",
        "unknown output.index: the model has no output 1, expected one of 'y'",
    ),
    "three channels out": (
        {"nodes": [helper.make_node("Neg", ["x"], ["y"])]},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "output 'y' has the shape (1, 3, 4, 6), expected H x W, with optional leading dimensions of 1",
    ),
    "one number out": (
        {"nodes": [helper.make_node("ReduceMean", ["x"], ["y"], keepdims=0)]},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "output 'y' has the shape (), expected H x W",
    ),
    "fails when it runs": (
        {"nodes": [FAILING_RESHAPE], "constants": {"to": np.array([5, 5])}},
        PLAIN_INPUT,
        DEPTH_OUTPUT,
        "model.onnx: fails on an input of 1 x 3 x 4 x 6: ",
    ),
}


@pytest.mark.parametrize("case", MISMATCHES.values(), ids=MISMATCHES)
def test_mismatched_model_raises_on_load(case: Mismatch, tmp_path: Path) -> None:
    model, input_table, output_table, message = case
    write_model(tmp_path, **{"input_shape": OPEN_SHAPE, **model})
    method = find_method(str(write_toml(tmp_path, input_table, output_table)))
    with pytest.raises(MethodError) as caught:
        load_predictor(method)
    problems = "".join(f"{problem.code} {problem}\n" for problem in caught.value.problems)
    assert message in (problems or str(caught.value))
    assert "model.onnx: " in str(caught.value)


def test_all_mismatches_are_reported_at_once(tmp_path: Path) -> None:
    write_model(tmp_path, [CHANNEL_MEAN], input_shape=(1, 3, 8, 8))
    with pytest.raises(MethodError) as caught:
        load_predictor(str(write_toml(tmp_path, output_table=f"{DEPTH_OUTPUT}\nindex = 1")))
    assert [(problem.code, problem.where) for problem in caught.value.problems] == [
        ("size", "input.height"),
        ("size", "input.width"),
        ("unknown", "output.index"),
    ]


def test_undeclared_smaller_output_raises(tmp_path: Path) -> None:
    write_constant_model(tmp_path, np.ones((1, 2, 3)))
    with pytest.raises(
        MethodError, match=re.escape("(1, 2, 3), expected 4 x 6 or [output] at_input_size = false")
    ):
        load_predictor(str(write_toml(tmp_path)))


def test_output_is_selected_by_name_or_index(tmp_path: Path) -> None:
    nodes = [helper.make_node("Neg", ["x"], ["no"]), helper.make_node("ReduceMax", ["x"], ["y"], axes=[1])]
    write_model(tmp_path, nodes, outputs=["no", "y"])
    for selection in ("name = 'y'", "index = 1"):
        assert (
            np.unique(
                predict_depth(
                    write_toml(tmp_path, output_table=f"{DEPTH_OUTPUT}\n{selection}"),
                    np.full((4, 6, 3), 9, np.uint8),
                )
            )
            == 9
        )


def test_invalid_model_file_raises(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.onnx").write_bytes(b"\x08\x01")  # A message without a graph.
    with pytest.raises(MethodError, match=r"model\.onnx: onnxruntime cannot open this model: "):
        load_predictor(str(write_toml(tmp_path)))
    assert capsys.readouterr().err == ""


def test_missing_onnxruntime_names_extra_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mixer_model(tmp_path)
    method = find_method(str(write_toml(tmp_path)))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MethodError, match=re.escape("pip install 'rebar-depth-bench[onnx]'")):
        load_predictor(method)
