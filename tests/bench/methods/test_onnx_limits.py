"""Limits of ONNX inference: time for each view and for opening the model, and memory."""

from __future__ import annotations

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
from rebar_depth_bench.base.limits import DeadlineError, call_within
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.methods import find_method
from tests.bench.methods.onnx_models import PLAIN_INPUT, predict_depth, write_model, write_toml
from tests.bench.methods.predictors import load_predictor

BLACK = np.zeros((4, 6, 3), np.uint8)


def write_loop_model(folder: Path) -> Path:
    """Write a model that returns the mean of the colours; for an image that is not black it loops for ever."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["go_on"]), helper.make_node("Identity", ["v"], ["next"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, ()),
            helper.make_tensor_value_info("go", TensorProto.BOOL, ()),
            helper.make_tensor_value_info("v", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, ()),
            helper.make_tensor_value_info("next", TensorProto.FLOAT, None),
        ],
    )
    nodes = [
        helper.make_node("ReduceMax", ["x"], ["brightest"], keepdims=0),
        helper.make_node("Greater", ["brightest", "zero"], ["bright"]),
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[1]),
        helper.make_node("Loop", ["", "bright", "mean"], ["y"], body=body),
    ]
    write_model(folder, nodes, constants={"zero": np.array(0, np.float32)})
    return write_toml(folder, PLAIN_INPUT)


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


def test_time_limit_does_not_change_results(tmp_path: Path) -> None:
    path = write_loop_model(tmp_path)
    assert np.isnan(predict_depth(path, BLACK)).all()
    predictor = load_predictor(find_method(str(path), view_timeout_s=0.3))
    for _ in range(2):  # The session can be used again after an inference that was stopped.
        with pytest.raises(MethodError, match=r"one: takes longer than the limit of 0\.3 s"):
            predictor({"view_id": "one", "left_rgb": BLACK + 1})
        assert np.isnan(predictor({"view_id": "two", "left_rgb": BLACK})).all()


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf", "1e7", "soon", ""])
def test_invalid_time_limit_exits_2(seconds: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["predict", "truth", "--data", "x", "--out", str(tmp_path / "x"), f"--view-timeout={seconds}"])
    assert caught.value.code == 2
    assert "--view-timeout" in capsys.readouterr().err


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


def test_deadline_returns_result_and_raises_errors_of_function() -> None:
    assert call_within(10, lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        call_within(10, lambda: 1 // 0)
    stopped: list[Any] = []
    with pytest.raises(DeadlineError):
        call_within(0.05, lambda: time.sleep(0.2), lambda: stopped.append(1))
    assert stopped == [1]
