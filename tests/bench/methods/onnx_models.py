"""Tiny ONNX models, built node by node, and the TOML files that describe them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from rebar_depth_bench.methods import Predictor
from tests.bench.methods.predictors import load_predictor

Shape = Sequence[int | str | None]
OPEN_SHAPE: Shape = ("n", 3, "h", "w")
PLAIN_INPUT = "width = 6\nheight = 4\nresize = 'stretch'\nrange = 255"
DEPTH_OUTPUT = "meaning = 'depth'"


def write_model(
    folder: Path,
    nodes: Sequence[onnx.NodeProto],
    *,
    constants: Mapping[str, np.ndarray] | None = None,
    input_shape: Shape = OPEN_SHAPE,
    input_type: int = TensorProto.FLOAT,
    more_inputs: Sequence[str] = (),
    more_shape: Shape | None = None,
    outputs: Sequence[str] = ("y",),
    output_type: int = TensorProto.FLOAT,
) -> Path:
    """Write a graph with input ``x``; the shapes of its outputs are undeclared and known only at run time.

    ``more_shape`` is the shape of ``more_inputs``, by default that of ``x``.
    """
    shapes = {"x": input_shape, **dict.fromkeys(more_inputs, more_shape or input_shape)}
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, input_type, shape) for name, shape in shapes.items()],
        [helper.make_tensor_value_info(name, output_type, None) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path = folder / "model.onnx"
    onnx.save(model, path)
    return path


def write_mixer_model(
    folder: Path, weights: Sequence[float] = (1.0, 0.0, 0.0), offset: float = 0.0, **options: Any
) -> Path:
    """Write a 1 x 1 convolution: the weighted sum of red, green and blue plus an offset."""
    constants = {"w": np.array(weights, np.float32).reshape(1, 3, 1, 1), "b": np.array([offset], np.float32)}
    return write_model(folder, [helper.make_node("Conv", ["x", "w", "b"], ["y"])], constants=constants, **options)


def write_constant_model(folder: Path, answer: np.ndarray) -> Path:
    """Write a model that returns the array ``answer`` for every image."""
    nodes = [
        helper.make_node("ReduceMean", ["x"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "answer"], ["y"]),
    ]
    constants = {"zero": np.float32(0), "answer": np.asarray(answer, np.float32)}
    return write_model(folder, nodes, constants={name: np.asarray(value) for name, value in constants.items()})


def write_toml(
    folder: Path, input_table: str = PLAIN_INPUT, output_table: str = DEPTH_OUTPUT, top_level: str = ""
) -> Path:
    """Write the TOML file that describes ``model.onnx``, and return its path."""
    path = folder / "tiny.toml"
    path.write_text(
        f"model = 'model.onnx'\nlicence = 'MIT'\n{top_level}\n[input]\n{input_table}\n[output]\n{output_table}\n"
    )
    return path


def predict_depth(path: Path, rgb: np.ndarray, fx: float | None = None) -> np.ndarray:
    """Return the depth in metres, float32 H x W, that the method of a TOML file predicts for one image."""
    predictor: Predictor = load_predictor(str(path))
    row: dict[str, Any] = {"left_rgb": rgb}
    if fx is not None:
        row["left_K"] = np.array([[fx, 0.0, 9.0], [0.0, 7.0 * fx, 5.0], [0.0, 0.0, 1.0]])
    depth_m = predictor(row)
    assert depth_m.dtype == np.float32
    assert depth_m.shape == rgb.shape[:2]
    return depth_m


def make_image(width: int, height: int, colour: Callable[[np.ndarray, np.ndarray], Sequence[Any]]) -> np.ndarray:
    """Return an 8-bit RGB image whose channels ``colour`` computes from column and row indices."""
    rows, columns = np.indices((height, width))
    channels = [np.broadcast_to(channel, (height, width)) for channel in colour(columns, rows)]
    return np.asarray(np.stack(channels, -1), dtype=np.uint8)
