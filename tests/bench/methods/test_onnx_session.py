"""Loading and limits of ONNX models: mismatches with the TOML file, time for each view, and memory."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import numpy as np
from onnx import TensorProto, helper

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import find_method
from tests.bench.methods.onnx_models import (
    DEPTH_OUTPUT,
    PLAIN_INPUT,
    predict_depth,
    write_constant_model,
    write_mixer_model,
    write_model,
    write_toml,
)
from tests.bench.methods.predictors import load_predictor

BLACK = np.zeros((4, 6, 3), np.uint8)
VARIABLE_INPUT = "longest_side = 6\nresize = 'stretch'\nrange = 1"
CHANNEL_MEAN = helper.make_node("ReduceMean", ["x"], ["y"], axes=[1])
NEGATED = helper.make_node("Neg", ["x"], ["y"])
SHAPE = helper.make_node("Shape", ["x"], ["y"])
SUM_OF_TWO_INPUTS = helper.make_node("Sum", ["x", "k"], ["y"])
FAILING_RESHAPE = helper.make_node("Reshape", ["x", "to"], ["y"])
TWO_OUTPUTS = [CHANNEL_MEAN, helper.make_node("Neg", ["x"], ["z"])]
AS_FLOAT = helper.make_node("Cast", ["x"], ["y"], to=TensorProto.FLOAT)
UINT8 = TensorProto.UINT8
FLOATS = "one of tensor(float), tensor(float16), tensor(double)"
PYTHON_METHOD = "; for this model write a Python method file, see examples/methods/"
INT32 = {"input_type": TensorProto.INT32, "output_type": TensorProto.INT32}


def mismatch(
    words: str, node: Any = CHANNEL_MEAN, *, input_table: str = PLAIN_INPUT, output: str = "", **model: Any
) -> Any:
    """Return the parameters of a case: message, tables of the TOML file, and the model of one node."""
    return pytest.param(words, input_table, output, {"nodes": [node], **model}, id=words[:60])


@pytest.mark.parametrize(
    ("words", "input_table", "output", "model"),
    [
        mismatch(
            f"invalid input: the model takes 2 ('x', 'k'), expected one: the image{PYTHON_METHOD}stereo.py",
            SUM_OF_TWO_INPUTS,
            more_inputs=["k"],
        ),
        mismatch(
            f"the model takes 2 ('x', 'k'), expected one: the image{PYTHON_METHOD}several_inputs.py",
            SUM_OF_TWO_INPUTS,
            more_inputs=["k"],
            more_shape=(1, 3, 3),
        ),
        mismatch(
            f"invalid input: the model takes 1 x ? x ? x 3, expected 1 x 3 x H x W{PYTHON_METHOD}channels_last.py",
            input_shape=(1, "h", "w", 3),
        ),
        mismatch(
            f"invalid input: the model takes 1 x 2 x ? x ?, expected 1 x 3 x H x W{PYTHON_METHOD}hitnet.py",
            input_shape=(1, 2, "h", "w"),
        ),
        mismatch(f"'x' is tensor(uint8), expected {FLOATS}{PYTHON_METHOD}uint8.py", AS_FLOAT, input_type=UINT8),
        mismatch("invalid input: the model takes 3 x 4 x 6, expected 1 x 3 x H", input_shape=(3, 4, 6)),
        mismatch("invalid input: the model takes 2 x 3 x 4 x 6, expected", input_shape=(2, 3, 4, 6)),
        mismatch("size input.width: got 6, the model takes 1 x 3 x ? x 8, expected 8", input_shape=(1, 3, "h", 8)),
        mismatch(
            "size input.height: got a variable size (longest_side), the model takes 1 x 3 x 4 x 6, expected 4",
            input_table=VARIABLE_INPUT,
            input_shape=(1, 3, 4, 6),
        ),
        mismatch("invalid input: 'x' is tensor(int32), expected one of tensor(float)", NEGATED, **INT32),
        mismatch(
            "invalid output: 'y' is tensor(int64), expected one of tensor(float)",
            SHAPE,
            output_type=TensorProto.INT64,
        ),
        mismatch(
            "missing output.name: the model has 2 outputs, expected one of 'y', 'z'",
            nodes=TWO_OUTPUTS,
            outputs=["y", "z"],
        ),
        mismatch("unknown output.name: the model has no output 'q', expected one of 'y'", output="name = 'q'"),
        mismatch(
            "model.onnx: a black image: fails on an input of 1 x 3 x 4 x 6: ",
            FAILING_RESHAPE,
            constants={"to": np.array([5, 5])},
        ),
    ],
)
def test_mismatched_model_is_refused_on_load(
    words: str, input_table: str, output: str, model: dict[str, Any], tmp_path: Path
) -> None:
    write_model(tmp_path, **model)
    method = find_method(str(write_toml(tmp_path, input_table, f"{DEPTH_OUTPUT}\n{output}")))
    with pytest.raises(MethodError) as caught:
        load_predictor(method)
    problems = "".join(f"{problem.code} {problem}\n" for problem in caught.value.problems)
    assert words in (problems or str(caught.value))
    assert "model.onnx: " in str(caught.value)


def test_all_mismatches_are_reported_at_once(tmp_path: Path) -> None:
    write_model(tmp_path, [CHANNEL_MEAN], input_shape=(1, 3, 8, 8))
    with pytest.raises(MethodError) as caught:
        load_predictor(str(write_toml(tmp_path, output_table=f"{DEPTH_OUTPUT}\nname = 'q'")))
    assert [(problem.code, problem.where) for problem in caught.value.problems] == [
        ("size", "input.height"),
        ("size", "input.width"),
        ("unknown", "output.name"),
    ]


@pytest.mark.parametrize(
    "shape",
    [(), (24,), (0, 6), (1, 24), (1, 24, 1), (1, 1), (1, 1, 6, 4), (5, 5), (20, 12), (2, 4, 6), (1, 3, 4, 6)],
    ids=str,
)
def test_output_without_the_ratio_of_the_input_is_refused(shape: tuple[int, ...], tmp_path: Path) -> None:
    """The input is 4 x 6."""
    write_constant_model(tmp_path, np.ones(shape))
    with pytest.raises(MethodError, match=re.escape(f"the shape {shape}, expected H x W in the ratio")):
        load_predictor(str(write_toml(tmp_path)))


def test_long_message_of_onnxruntime_ends_with_the_cause(tmp_path: Path) -> None:
    write_model(tmp_path, [helper.make_node("NoOperator", ["x"], ["y"], name="n" * 1000)])
    with pytest.raises(MethodError, match=r"cannot open this model: \.\.\. n.*No Op registered for NoOperator"):
        load_predictor(str(write_toml(tmp_path)))


def test_output_is_selected_by_name(tmp_path: Path) -> None:
    nodes = [helper.make_node("Neg", ["x"], ["no"]), helper.make_node("ReduceMax", ["x"], ["y"], axes=[1])]
    write_model(tmp_path, nodes, outputs=["no", "y"])
    path = write_toml(tmp_path, output_table=f"{DEPTH_OUTPUT}\nname = 'y'")
    assert np.unique(predict_depth(path, BLACK + 9)) == 9


def test_load_without_onnxruntime_names_extra_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mixer_model(tmp_path)
    for package in ("onnx", "onnxruntime"):
        monkeypatch.setitem(sys.modules, package, None)
    method = find_method(str(write_toml(tmp_path)))
    with pytest.raises(MethodError, match=re.escape("pip install '.[onnx]'")):
        load_predictor(method)


def write_loop_model(folder: Path) -> Path:
    """Write a model that returns the mean of the colours; for an image that is not black it loops for ever."""
    value, floats, bools = helper.make_tensor_value_info, TensorProto.FLOAT, TensorProto.BOOL
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Identity", ["v"], ["next"])],
        "body",
        [value("i", TensorProto.INT64, ()), value("go", bools, ()), value("v", floats, None)],
        [value("go_on", bools, ()), value("next", floats, None)],
    )
    nodes = [
        helper.make_node("ReduceMax", ["x"], ["brightest"], keepdims=0),
        helper.make_node("Greater", ["brightest", "zero"], ["bright"]),
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[1]),
        helper.make_node("Loop", ["", "bright", "mean"], ["y"], body=body),
    ]
    write_model(folder, nodes, constants={"zero": np.array(0, np.float32)})
    return write_toml(folder, PLAIN_INPUT)


@pytest.mark.slow
def test_endless_model_ends_at_view_timeout(
    tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_loop_model(tmp_path)
    start = time.monotonic()
    command = ["predict", str(path), "--data", str(tiny_root), "--out", str(tmp_path / "x.zip")]
    assert main([*command, "--view-timeout", "0.5", "--config", "lattice-orbit"]) == 2
    assert time.monotonic() - start < 30
    last = capsys.readouterr().err.splitlines()[-1]
    assert "lattice-orbit/" in last
    assert "0.5 s" in last
    assert "--view-timeout" in last
    assert (tmp_path / ".x.zip.views" / "run.json").is_file(), "the run can be resumed"
    assert not (tmp_path / "x.zip").exists()


@pytest.mark.slow
def test_time_limit_does_not_change_results(tmp_path: Path) -> None:
    path = write_loop_model(tmp_path)
    assert np.isnan(predict_depth(path, BLACK)).all()
    predictor = load_predictor(find_method(str(path), view_timeout_s=0.3))
    for _ in range(2):  # The session can be used again after an inference that was stopped.
        with pytest.raises(MethodError, match=r"one: .* takes longer than the limit of 0\.3 s"):
            predictor({"view_id": "one", "left_rgb": BLACK + 1})
        assert np.isnan(predictor({"view_id": "two", "left_rgb": BLACK})).all()


@pytest.mark.slow
def test_endless_model_can_be_interrupted(tiny_root: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rebar_depth_bench", "predict", str(write_loop_model(tmp_path))]
    command += ["--data", str(tiny_root), "--out", str(tmp_path / "x.zip")]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / ".x.zip.views" / "run.json").is_file():
        assert running.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    running.send_signal(signal.SIGINT)
    _, stderr = running.communicate(timeout=60)
    assert running.returncode == 1
    assert stderr.splitlines()[-1] == "interrupted; run the same command again to resume"


LONG_OPERATOR = """
import sys, time
from pathlib import Path
from rebar_depth_bench.base.limits import DeadlineError, call_within
import onnxruntime
options = onnxruntime.SessionOptions()
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
import numpy as np
start = time.monotonic()
try:
    call_within(0.5, lambda: session.run(None, {"x": np.ones((1, 3, 4, 6), np.float32)}))
except DeadlineError:
    print(time.monotonic() - start < 20)
    sys.exit(2)
"""


@pytest.mark.slow
def test_operator_that_cannot_be_stopped_does_not_keep_process(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["mean"], keepdims=0),
        helper.make_node("Expand", ["mean", "size"], ["matrix"]),
        helper.make_node("MatMul", ["matrix", "matrix"], ["y"]),
    ]
    model = write_model(tmp_path, nodes, constants={"size": np.array([20_000, 20_000])})
    finished = subprocess.run(
        [sys.executable, "-c", LONG_OPERATOR, str(model)], capture_output=True, text=True, check=False, timeout=60
    )
    assert (finished.returncode, finished.stdout) == (2, "True\n")


def test_memory_of_model_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["mean"], keepdims=0),
        helper.make_node("Expand", ["mean", "size"], ["huge"]),
        helper.make_node("ReduceMax", ["huge"], ["most"], keepdims=0),
        helper.make_node("Mul", ["x", "most"], ["y"]),
    ]
    write_model(tmp_path, nodes, constants={"size": np.array([1000, 1_000_000])})
    monkeypatch.setenv("REBAR_MAX_ONNX_MEMORY_BYTES", str(1 << 30))
    with pytest.raises(MethodError, match="REBAR_MAX_ONNX_MEMORY_BYTES raises the limit"):
        load_predictor(str(write_toml(tmp_path)))
