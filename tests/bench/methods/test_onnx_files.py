"""Files of ONNX models: external data outside the folder or in memory, damage, and changes between two runs."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import numpy as np
import onnx
import onnxruntime
from onnx import GraphProto, TensorProto, helper, numpy_helper

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import find_method
from tests.bench.methods.onnx_models import predict_depth, write_mixer_model, write_toml
from tests.bench.methods.predictors import load_predictor

GREY = np.full((4, 6, 3), 100, np.uint8)
WEIGHTS = np.array([1, 0, 0], np.float32)
CONV = helper.make_node("Conv", ["x", "w"], ["y"])
MEMORY = "*/_ORT_MEM_ADDR_/*"
"""Location at which onnxruntime keeps tensors in memory, with the address as their offset."""


def external(location: str, offset: int = 0) -> TensorProto:
    """Return a tensor whose values are elsewhere."""
    tensor = TensorProto(name="w", dims=[1, 3, 1, 1], data_type=TensorProto.FLOAT)
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, "offset": offset, "length": WEIGHTS.nbytes}.items():
        tensor.external_data.add(key=key, value=str(value))
    return tensor


def sparse(values: TensorProto) -> onnx.SparseTensorProto:
    values.dims[:] = [3]
    indices = numpy_helper.from_array(np.arange(3), "indices")
    return onnx.SparseTensorProto(dims=[1, 3, 1, 1], values=values, indices=indices)


def initializer(graph: GraphProto, tensor: TensorProto) -> None:
    graph.node.append(CONV)
    graph.initializer.append(tensor)


def sparse_initializer(graph: GraphProto, tensor: TensorProto) -> None:
    graph.node.append(CONV)
    graph.sparse_initializer.append(sparse(tensor))


def constant(graph: GraphProto, tensor: TensorProto) -> None:
    graph.node.extend([helper.make_node("Constant", [], ["w"], value=tensor), CONV])


def sparse_constant(graph: GraphProto, tensor: TensorProto) -> None:
    graph.node.extend([helper.make_node("Constant", [], ["w"], sparse_value=sparse(tensor)), CONV])


def subgraph(graph: GraphProto, tensor: TensorProto) -> None:
    value = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    branch = helper.make_graph([CONV], "branch", [], [value], [tensor])
    graph.initializer.append(numpy_helper.from_array(np.array(True), "yes"))
    graph.node.append(helper.make_node("If", ["yes"], ["y"], then_branch=branch, else_branch=branch))


def attribute(graph: GraphProto, tensor: TensorProto) -> None:
    tensor.dims[:] = [3]
    keys, default = (numpy_helper.from_array(np.array(values, np.float32)) for values in ([100, 2, 3], [7]))
    values = {"keys_tensor": keys, "values_tensor": tensor, "default_tensor": default}
    graph.node.append(helper.make_node("LabelEncoder", ["x"], ["labels"], domain="ai.onnx.ml", **values))
    graph.node.append(helper.make_node("ReduceMax", ["labels"], ["y"], axes=[1]))


def write_external_model(
    folder: Path,
    location: str,
    place: Callable[[GraphProto, TensorProto], None] = initializer,
    *,
    offset: int = 0,
    in_function: bool = False,
) -> Path:
    """Write a model with a tensor whose values are at ``location``, and return the path of its TOML file."""
    inputs, outputs = (
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)]
        for name, shape in (("x", ("n", 3, "h", "w")), ("y", None))
    )
    graph, functions = helper.make_graph([], "g", inputs, outputs), []
    place(graph, external(location, offset))
    versions = [helper.make_opsetid(*version) for version in (("", 17), ("ai.onnx.ml", 4), ("own", 1))]
    if in_function:
        functions = [helper.make_function("own", "Own", ["x"], ["y"], graph.node, versions)]
        graph = helper.make_graph([helper.make_node("Own", ["x"], ["y"], domain="own")], "g", inputs, outputs)
    model = helper.make_model(graph, opset_imports=versions, ir_version=8, functions=functions)
    (folder / "model.onnx").write_bytes(model.SerializeToString())
    return write_toml(folder)


PLACES = [initializer, sparse_initializer, constant, sparse_constant, subgraph, attribute, "function"]


@pytest.mark.parametrize("place", PLACES, ids=lambda place: getattr(place, "__name__", place))
def test_external_data_outside_folder_or_in_memory_is_never_read(
    place: Callable[[GraphProto, TensorProto], None] | str, tmp_path: Path
) -> None:
    """The first version of onnxruntime that refuses all of them is the lower bound in pyproject.toml."""
    folder = tmp_path / "model"
    (folder / MEMORY).parent.mkdir(parents=True)
    in_memory = ctypes.create_string_buffer(WEIGHTS.tobytes())
    for file in (tmp_path / "outside", folder / "deep" / "weights", folder / MEMORY):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(WEIGHTS.tobytes())
    (folder / "link").symlink_to(tmp_path / "outside")
    (folder / "elsewhere").symlink_to(tmp_path)
    builder = constant if isinstance(place, str) else place

    def write(location: str, offset: int = 0) -> Path:
        return write_external_model(folder, location, builder, offset=offset, in_function=place == "function")

    depth_m = predict_depth(write("deep/weights"), GREY)
    assert np.isfinite(depth_m).all(), "the model reads this tensor"
    for location in ("../outside", str(tmp_path / "outside"), "deep/../../outside", "link", "elsewhere/outside"):
        with pytest.raises(MethodError, match=r"model\.onnx: onnxruntime cannot open this model: "):
            load_predictor(str(write(location)))
    with pytest.raises(MethodError, match=r"model\.onnx: onnxruntime cannot open this model: "):
        load_predictor(str(write(MEMORY, ctypes.addressof(in_memory))))


@pytest.mark.parametrize(
    "location", ["missing", "deep", "pipe", "zero", "broken", "loop", "long" * 1000, "", "\x1b[2J"]
)
def test_external_data_that_is_no_file_is_refused(
    location: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "broken").symlink_to("nowhere")
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(MethodError, match=r"model\.onnx: onnxruntime cannot open this model: ") as caught:
        load_predictor(find_method(str(write_external_model(tmp_path, location)), view_timeout_s=20))
    assert str(caught.value).isprintable()
    assert "takes longer" not in str(caught.value)
    assert capfd.readouterr().err == "", "a message of onnxruntime has the control characters of the model"


def test_old_onnxruntime_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mixer_model(tmp_path)
    monkeypatch.setattr(onnxruntime, "__version__", "1.27.0")
    with pytest.raises(MethodError, match=r"onnxruntime is 1\.27\.0, .* expected at least 1\.28: pip install"):
        load_predictor(str(write_toml(tmp_path)))


def test_snapshot_of_links_runs(tmp_path: Path) -> None:
    """A snapshot of the Hub is a folder of links to files elsewhere."""
    blobs, snapshot = tmp_path / "blobs", tmp_path / "snapshots" / "commit"
    blobs.mkdir()
    snapshot.mkdir(parents=True)
    write_external_model(blobs, "weights.bin")
    (blobs / "weights.bin").write_bytes(WEIGHTS.tobytes())
    for name in ("model.onnx", "weights.bin", "tiny.toml"):
        (snapshot / name).symlink_to(Path("../../blobs") / name)
    assert np.unique(predict_depth(snapshot / "tiny.toml", GREY)) == [100]


def test_model_that_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "model.onnx")
    with pytest.raises(MethodError, match="no such file"):
        find_method(str(write_toml(tmp_path)))


def test_pointer_of_git_lfs_is_named(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(
        b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d" * 32 + b"\nsize 12345\n"
    )
    with pytest.raises(MethodError, match=r"model\.onnx: cannot be read: it is a pointer of git LFS"):
        find_method(str(write_toml(tmp_path)))


def nested(content: bytes, depth: int) -> bytes:
    """Return a model whose graph has ``depth`` graphs, one within the other, in attributes of nodes."""
    for tag in (*[b"\x32", b"\x2a", b"\x0a"] * depth, b"\x3a"):
        length, size = b"", len(content)
        while size > 127:
            length, size = length + bytes([size & 127 | 128]), size >> 7
        content = tag + length + bytes([size]) + content
    return content


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"not a model at all",
        bytes(100),
        b"\x08\x01",
        b"\x08" + b"\xff" * 11,
        b"\x3a" + b"\xff" * 9 + b"\x01",
        nested(b"", 3000),
        nested(b"", 20),
    ],
    ids=["empty", "text", "zeros", "no graph", "long varint", "huge length", "deep subgraphs", "subgraphs"],
)
def test_damaged_model_is_refused(content: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "model.onnx").write_bytes(content)
    with pytest.raises(MethodError, match=r"model\.onnx: onnxruntime cannot open this model: "):
        load_predictor(str(write_toml(tmp_path)))
    assert capfd.readouterr().err == ""


def test_model_in_format_of_onnxruntime_runs(tmp_path: Path) -> None:
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "model.ort")
    options.add_session_config_entry("session.save_model_format", "ORT")
    onnxruntime.InferenceSession(str(write_mixer_model(tmp_path)), options, providers=["CPUExecutionProvider"])
    path = write_toml(tmp_path)
    path.write_text(path.read_text().replace("model.onnx", "model.ort"))
    assert np.unique(predict_depth(path, GREY)) == [100]
