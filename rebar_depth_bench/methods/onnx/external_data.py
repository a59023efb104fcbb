"""Files that an ONNX model reads: the external data of its tensors.

The model is read as protobuf messages, because the package ``onnx`` is no dependency and loads all weights; of a
file of empty messages it makes 75 times as much memory.
Field numbers are those of ``onnx.proto``. External data must lie in the folder of the model, because its locations
come from the file.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath

from rebar_depth_bench.base.errors import MethodError, Problem, escape_text
from rebar_depth_bench.base.reading import open_regular
from rebar_depth_bench.methods.base import files_digest
from rebar_depth_bench.methods.onnx.spec import is_file

MAX_FIELDS = 1_000_000
"""Largest number of fields that are read; a large model has some 100,000. Each takes some microseconds."""
MESSAGE_FIELDS: Mapping[str, Mapping[int, str]] = {
    "ModelProto": {7: "GraphProto", 20: "TrainingInfoProto", 25: "FunctionProto"},
    "TrainingInfoProto": {1: "GraphProto", 2: "GraphProto"},
    "GraphProto": {1: "NodeProto", 5: "TensorProto", 15: "SparseTensorProto"},
    "FunctionProto": {7: "NodeProto", 11: "AttributeProto"},
    "NodeProto": {5: "AttributeProto"},
    "AttributeProto": {
        5: "TensorProto",
        6: "GraphProto",
        10: "TensorProto",
        11: "GraphProto",
        22: "SparseTensorProto",
        23: "SparseTensorProto",
    },
    "SparseTensorProto": {1: "TensorProto", 2: "TensorProto"},
}
"""Fields through which a model reaches its tensors: message type by field number, by message type."""
_EXTERNAL_DATA, _DATA_LOCATION, _EXTERNAL = 13, 14, 1
_KEY, _VALUE = 1, 2
_VARINT, _BYTES, _FIXED_LENGTHS = 0, 2, {1: 8, 5: 4}
_MAX_TAG = 0xFFFFFFFF
"""Largest tag; the protobuf library drops higher bits, which would make it another field."""
_DIGEST_CHARACTERS = 16
_ORT_FORMAT = ".ort"
"""Suffix of files in onnxruntime's own format, which have no external data."""

_Field = tuple[int, int | slice]
"""Field number, and the value of an integer or the place of bytes."""


class _DamagedError(Exception):
    """Bytes that are no protobuf message."""


def model_digest(path: Path, model: Path) -> str:
    """Return the digest of the TOML file, the model and its external data."""
    return files_digest((path, model, *external_files(model)))[:_DIGEST_CHARACTERS]


def external_files(model: Path) -> list[Path]:
    """Return the files with external data of an ONNX model, sorted.

    Raises ``MethodError`` if the model cannot be read as protobuf, or if external data is missing, no regular file
    or outside the folder of the model.
    """
    if model.suffix == _ORT_FORMAT:
        return []
    try:
        with open_regular(model) as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            required = _locations(data)
    except OSError as error:
        raise MethodError(f"{model}: cannot be read: {error.strerror or error}") from None
    except (_DamagedError, ValueError) as error:  # An empty file cannot be mapped, and locations may not be UTF-8.
        problem = Problem("damaged", "", f"it cannot be read as an ONNX model ({error})", "a protobuf ModelProto")
        raise MethodError.from_problems(model, [problem]) from None
    files, problems = [], []
    for name, is_required in sorted(required.items()):
        shown = escape_text(name)
        if not _is_inside(model.parent, name):
            expected = "a file in the folder of the model"
            problems.append(Problem("name", "external data", f"the location is {shown}", expected))
        elif is_file(path := model.parent / name):
            files.append(path)
        elif is_required:
            problems.append(
                Problem("missing", "external data", f"{shown} is no regular file", "one beside the model")
            )
    if problems:
        raise MethodError.from_problems(model, problems)
    return files


def _is_inside(folder: Path, name: str) -> bool:
    """Return whether a location is the name of a file in the folder or in a folder of it.

    The file may be a link, as in a snapshot of the Hub; a folder may not lead elsewhere. "*" is refused because
    onnxruntime reads memory at the location ``*/_ORT_MEM_ADDR_/*``.
    """
    location = PurePosixPath(name)
    if location.is_absolute() or ".." in location.parts or set("*\\") & set(name) or not name.isprintable():
        return False
    try:
        return (folder / location).parent.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # The name is too long, or links form a loop.
        return False


def _locations(data: mmap.mmap) -> dict[str, bool]:
    """Return the locations of external data, and whether a tensor is marked as having its values there."""
    required: dict[str, bool] = {}
    budget = iter(range(MAX_FIELDS))
    messages = [("ModelProto", slice(0, len(data)))]
    while messages:
        kind, place = messages.pop()
        fields = _fields(data, place, budget)
        if kind == "TensorProto":
            for name, is_external in _tensor_locations(data, fields, budget):
                required[name] = required.get(name, False) or is_external
        else:
            children = MESSAGE_FIELDS[kind]
            messages += [(children[number], _slice(value)) for number, value in fields if number in children]
    return required


def _tensor_locations(
    data: mmap.mmap, fields: Iterator[_Field], budget: Iterator[int]
) -> Iterator[tuple[str, bool]]:
    names: list[str] = []
    is_external = False
    for number, value in fields:
        if number == _DATA_LOCATION:
            is_external = value == _EXTERNAL
        elif number == _EXTERNAL_DATA:
            entry = {
                key: data[_slice(text)] for key, text in _fields(data, _slice(value), budget) if key <= _VALUE
            }
            if entry.get(_KEY) == b"location":
                names.append(entry.get(_VALUE, b"").decode())
    return ((name, is_external) for name in names)


def _fields(data: mmap.mmap, place: slice, budget: Iterator[int]) -> Iterator[_Field]:
    """Yield the fields of the message at ``place``; the values of those of 4 or 8 bytes are left out, as 0."""
    position, end = place.start, place.stop
    while position < end:
        if next(budget, None) is None:
            raise _DamagedError(f"it has more than {MAX_FIELDS} fields")
        tag, position = _varint(data, position, end)
        kind, value, length = tag & 7, 0, 0
        if kind == _VARINT:
            value, position = _varint(data, position, end)
        elif kind == _BYTES:
            length, position = _varint(data, position, end)
        else:
            length = _FIXED_LENGTHS.get(kind, end)
        if not 8 <= tag <= _MAX_TAG or position + length > end:
            raise _DamagedError(f"no whole field ends at byte {position}")
        yield tag >> 3, slice(position, position + length) if kind == _BYTES else value
        position += length


def _varint(data: mmap.mmap, position: int, end: int) -> tuple[int, int]:
    """Return the variable-length integer at ``position`` and the position after it."""
    if position < end and (byte := data[position]) < 128:
        return byte, position + 1
    value = 0
    for index in range(min(10, end - position)):
        byte = data[position + index]
        value |= (byte & 127) << 7 * index
        if byte < 128:
            return value, position + index + 1
    raise _DamagedError(f"no whole number at byte {position}")


def _slice(value: int | slice) -> slice:
    if isinstance(value, int):
        raise _DamagedError("a number in place of a message")
    return value
