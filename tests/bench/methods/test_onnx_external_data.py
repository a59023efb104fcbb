"""External data of ONNX models: the digest covers every file that is read, and no file is outside the folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

import numpy as np
import onnx
import onnxruntime
from onnx import ModelProto, TensorProto, helper, numpy_helper

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.onnx.external_data import MAX_FIELDS, MESSAGE_FIELDS, external_files
from rebar_depth_bench.methods.run import predict
from tests.bench.methods.onnx_models import predict_depth, write_mixer_model, write_toml
from tests.bench.methods.predictors import stop_after

GREY = np.full((4, 6, 3), 100, np.uint8)
WEIGHTS = np.array([1, 0, 0], np.float32)


def external(location: str) -> TensorProto:
    """Return the weights of the mixer model, which are in another file."""
    tensor = numpy_helper.from_array(WEIGHTS.reshape(1, 3, 1, 1), "w")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="offset", value="0")
    tensor.external_data.add(key="location", value=location)
    return tensor


def write_external_model(folder: Path, location: str) -> Path:
    """Write the mixer model with its weights at ``location``, and return the path of its TOML file."""
    path = write_mixer_model(folder)
    model = onnx.load(path)
    model.graph.initializer[0].CopyFrom(external(location))
    path.write_bytes(model.SerializeToString())
    return write_toml(folder)


def test_weights_that_are_a_pointer_of_git_lfs_are_named(tmp_path: Path) -> None:
    toml = write_external_model(tmp_path, "weights.bin")
    (tmp_path / "weights.bin").write_bytes(
        b"version https://git-lfs.github.com/spec/v1\noid sha256:4d4d\nsize 12\n"
    )
    with pytest.raises(MethodError, match=r"weights.bin: cannot be read: it is a pointer of git LFS"):
        find_method(str(toml))


def model_with_tensor(place: Callable[[ModelProto, TensorProto], None], location: str) -> bytes:
    model = helper.make_model(helper.make_graph([], "g", [], []))
    place(model, external(location))
    return bytes(model.SerializeToString())


def subgraph(tensor: TensorProto) -> onnx.GraphProto:
    return helper.make_graph([], "inner", [], [], [tensor])


def node_with(value: object) -> onnx.NodeProto:
    node = helper.make_node("Any", [], ["y"])
    node.attribute.append(helper.make_attribute("value", value))
    return node


def sparse(tensor: TensorProto, part: str) -> onnx.SparseTensorProto:
    made = onnx.SparseTensorProto(dims=[3])
    getattr(made, part).CopyFrom(tensor)
    return made


PLACES: dict[str, Callable[[ModelProto, TensorProto], None]] = {
    "initializer": lambda model, tensor: model.graph.initializer.append(tensor),
    "sparse values": lambda model, tensor: model.graph.sparse_initializer.append(sparse(tensor, "values")),
    "sparse indices": lambda model, tensor: model.graph.sparse_initializer.append(sparse(tensor, "indices")),
    "attribute": lambda model, tensor: model.graph.node.append(node_with(tensor)),
    "attribute list": lambda model, tensor: model.graph.node.append(node_with([tensor])),
    "sparse attribute": lambda model, tensor: model.graph.node.append(node_with(sparse(tensor, "values"))),
    "subgraph": lambda model, tensor: model.graph.node.append(node_with(subgraph(tensor))),
    "subgraph list": lambda model, tensor: model.graph.node.append(node_with([subgraph(tensor)])),
    "function": lambda model, tensor: model.functions.add().node.append(node_with(subgraph(tensor))),
    "function default": lambda model, tensor: model.functions.add().attribute_proto.append(
        helper.make_attribute("value", tensor)
    ),
    "training": lambda model, tensor: model.training_info.add().initialization.CopyFrom(subgraph(tensor)),
}


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_digest_covers_external_data_of_any_name(
    place: Callable[[ModelProto, TensorProto], None], tmp_path: Path
) -> None:
    (tmp_path / "model.onnx").write_bytes(model_with_tensor(place, "deep/weights"))
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "weights").write_bytes(WEIGHTS.tobytes())
    path = write_toml(tmp_path)
    before = find_method(str(path)).info.source
    assert find_method(str(path)).info.source == before
    (tmp_path / "deep" / "weights").write_bytes((WEIGHTS + 1).tobytes())
    assert find_method(str(path)).info.source != before


def test_walked_fields_are_those_of_the_schema_that_lead_to_tensors() -> None:
    children: dict[str, dict[int, str]] = {}
    pending = [ModelProto.DESCRIPTOR]
    while pending:
        message = pending.pop()
        fields = [field for field in message.fields if field.message_type]
        children[message.name] = {field.number: field.message_type.name for field in fields}
        pending += [field.message_type for field in fields if field.message_type.name not in children]
    leading = {"TensorProto"}
    while more := {name for name, fields in children.items() if leading & set(fields.values())} - leading:
        leading |= more
    assert {
        name: {number: kind for number, kind in children[name].items() if kind in leading}
        for name in leading - {"TensorProto"}
    } == MESSAGE_FIELDS


def test_interrupted_run_is_not_resumed_with_other_external_data(tiny_root: Path, tmp_path: Path) -> None:
    path, done = write_external_model(tmp_path, "weights.bin"), list[int]()

    def run(weights: np.ndarray, progress: Progress) -> None:
        (tmp_path / "weights.bin").write_bytes(weights.tobytes())
        predict(
            find_method(str(path)), tiny_root, tmp_path / "x.zip", configs=["lattice-orbit"], progress=progress
        )

    with pytest.raises(KeyboardInterrupt):
        run(WEIGHTS, stop_after(1))
    run(2 * WEIGHTS, lambda _, count, __: done.append(count))
    assert done == [1, 2]


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


OUTSIDE = (
    *("/etc/passwd", "../outside", "inside/../../outside", "elsewhere/outside", "*/_ORT_MEM_ADDR_/*", ""),
    *("new\nline", "null\0", "back\\slash", "loop/weights"),
)
NO_FILE = ("missing", "inside", "pipe", "zero", "broken link", "long" * 1000)


@pytest.mark.parametrize(
    ("location", "code"), [*((name, "name") for name in OUTSIDE), *((name, "missing") for name in NO_FILE)]
)
def test_external_data_outside_folder_or_no_file_is_refused(location: str, code: str, tmp_path: Path) -> None:
    folder = tmp_path / "model"
    (folder / "inside").mkdir(parents=True)
    memory = folder / "*" / "_ORT_MEM_ADDR_"
    memory.mkdir(parents=True)
    (memory / "*").write_bytes(WEIGHTS.tobytes())
    (tmp_path / "outside").write_bytes(WEIGHTS.tobytes())
    (folder / "elsewhere").symlink_to(tmp_path)
    (folder / "broken link").symlink_to("nowhere")
    (folder / "zero").symlink_to("/dev/zero")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    with pytest.raises(MethodError, match=r"model\.onnx: 1 problem") as caught:
        find_method(str(write_external_model(folder, location)))
    assert [(problem.code, problem.where) for problem in caught.value.problems] == [(code, "external data")]
    assert all(line.isprintable() for line in str(caught.value).splitlines())


def test_location_of_tensor_with_values_inside_may_be_missing(tmp_path: Path) -> None:
    path = write_mixer_model(tmp_path)
    model = onnx.load(path)
    entry = model.graph.initializer[0].external_data.add()
    entry.key, entry.value = "location", "forgotten"
    path.write_bytes(model.SerializeToString())
    assert np.unique(predict_depth(write_toml(tmp_path), GREY)) == [100]


def message(number: int, content: bytes) -> bytes:
    """Return a protobuf field that holds a message of less than 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content


DAMAGED = {
    "empty": b"",
    "text": b"not a model at all",
    "zeros": bytes(100),
    "cut varint": b"\x08\xff",
    "long varint": b"\x08" + b"\xff" * 11,
    "group": message(7, b"\x0b\x0c"),
    "past the end": b"\x3a\x7f",
    "huge length": b"\x3a" + b"\xff" * 9 + b"\x01",
    "child past its parent": message(7, b"\x2a\x05") + bytes(9),
    "number for a message": b"\x38\x05",
    "tag whose high bits are dropped": b"\xba\x80\x80\x80\x10\x02\x08\x01",
    "location that is not UTF-8": message(
        7, message(5, message(13, message(1, b"location") + message(2, b"\xff")) + b"\x70\x01")
    ),
    "fixed past the end": b"\x09\x00",
}


def test_named_pipe_as_model_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "model.onnx")
    with pytest.raises(MethodError, match="no such file"):
        find_method(str(write_toml(tmp_path)))


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_damaged_model_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(content)
    with pytest.raises(MethodError) as caught:
        find_method(str(write_toml(tmp_path)))
    assert str(caught.value).startswith(f"{tmp_path / 'model.onnx'}: ")
    assert [problem.code for problem in caught.value.problems] == ["damaged"]


@pytest.mark.slow
def test_million_fields_are_refused(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").write_bytes(b"\x08\x01" * (MAX_FIELDS + 1))
    with pytest.raises(MethodError, match=f"more than {MAX_FIELDS} fields"):
        find_method(str(write_toml(tmp_path)))


def test_deep_subgraphs_are_walked(tmp_path: Path) -> None:
    """The nesting is deeper than the stack of Python; onnxruntime refuses it when it loads the model."""
    content = external("weights.bin").SerializeToString()
    content = b"\x2a" + _length(content) + content
    for _ in range(3000):  # A graph in an attribute of a node of a graph.
        for tag in (b"\x32", b"\x2a", b"\x0a"):
            content = tag + _length(content) + content
    (tmp_path / "model.onnx").write_bytes(b"\x3a" + _length(content) + content)
    (tmp_path / "weights.bin").write_bytes(b"")
    assert [path.name for path in external_files(tmp_path / "model.onnx")] == ["weights.bin"]


def _length(content: bytes) -> bytes:
    digits, size = [], len(content)
    while size > 127:
        digits.append(size & 127 | 128)
        size >>= 7
    return bytes([*digits, size])


def test_model_in_format_of_onnxruntime_runs(tmp_path: Path) -> None:
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "model.ort")
    options.add_session_config_entry("session.save_model_format", "ORT")
    onnxruntime.InferenceSession(str(write_mixer_model(tmp_path)), options, providers=["CPUExecutionProvider"])
    path = write_toml(tmp_path)
    path.write_text(path.read_text().replace("model.onnx", "model.ort"))
    assert np.unique(predict_depth(path, GREY)) == [100]
