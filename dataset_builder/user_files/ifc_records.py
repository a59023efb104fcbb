"""Records of the answer of the process that reads an IFC file: lines of JSON, each followed by its arrays.

An answer begins with a ``ProjectRecord`` and ends with an ``EndRecord`` or a ``FailureRecord``. ``ifc_reader``
writes it, and ``user_files.ifc_file`` reads it, as untrusted data, since the writer has read a
file from outside.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import IO, Annotated, ClassVar, Literal

import numpy as np
from numpy import ndarray
from pydantic import Field, TypeAdapter, ValidationError

from rebar_depth_bench.base.reading import parse_json
from rebar_depth_bench.base.validation import StrictModel

MAX_MESSAGE = 1000
"""Largest number of characters of the reason for a failure."""

MAX_ARRAY_BYTES = 1 << 30
"""Largest size of all arrays of an answer: more than ``MAX_TRIANGLES`` of a cage."""

_MAX_LINE_BYTES = 20_000
_Label = Annotated[str, Field(min_length=1, max_length=200)]
_Code = Annotated[str, Field(pattern="^[a-z]{1,20}$")]
_Size = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class AnswerError(Exception):
    """Answer that is incomplete (``ended``) or not valid; the message is the reason."""

    def __init__(self, reason: str, ended: bool = False) -> None:
        super().__init__(reason)
        self.ended = ended


class Source(StrictModel):
    """Object of a file: GlobalId, name in messages, host, storey, and the sizes declared for its bars, metres.

    There are two declared diameters for a mesh, and none where they are unknown.
    """

    global_id: _Label
    label: _Label
    host: _Label | None
    storey: _Label | None
    diameters_m: Annotated[list[_Size], Field(max_length=3)]
    length_m: _Size | None


class _Record(StrictModel):
    """Record; ``ARRAYS`` are its arrays: field with the number of rows, of three values, and data type of each."""

    ARRAYS: ClassVar[tuple[tuple[str, str], ...]] = ()


class ProjectRecord(_Record):
    """Project of the file, with its length unit."""

    kind: Literal["project"] = "project"
    unit_m: _Size


class LeftOutRecord(_Record):
    """Object that is not read: GlobalId, and the reason, which begins with its class."""

    kind: Literal["left_out"] = "left_out"
    global_id: _Label
    reason: _Label


class BarRecord(_Record):
    """Bar with an axis, and remarks on it by their codes; its points follow (the file's frame, metres)."""

    ARRAYS = (("points", "<f8"),)
    kind: Literal["bar"] = "bar"
    source: Source
    notes: Annotated[dict[_Code, Annotated[str, Field(max_length=200)]], Field(max_length=10)]
    role: Annotated[str, Field(min_length=1, max_length=60)]
    diameter_m: _Size
    points: Annotated[int, Field(ge=2)]


class SurfaceRecord(_Record):
    """Tessellated solid, of one or several bars; vertices (the file's frame, metres) and triangles follow."""

    ARRAYS = (("vertices", "<f8"), ("faces", "<i4"))
    kind: Literal["surface"] = "surface"
    source: Source
    vertices: Annotated[int, Field(ge=3)]
    faces: Annotated[int, Field(ge=1)]


class StepRecord(_Record):
    """Object that is tessellated next, which may hang or crash, and why it has no axis."""

    kind: Literal["step"] = "step"
    label: _Label
    reason: _Label

    def failure(self, problem: str) -> str:
        """Return the message for an object whose tessellation has ended with ``problem``."""
        return (
            f"{self.label} has no readable shape: {self.reason}; tessellation: {problem}; "
            "expected a swept circle or another solid"
        )


class FailureRecord(_Record):
    """Reason for which reading ended; None if there was not enough memory."""

    kind: Literal["failure"] = "failure"
    message: Annotated[str, Field(min_length=1, max_length=MAX_MESSAGE)] | None


class EndRecord(_Record):
    """End of a complete answer, with the number of the records before it."""

    kind: Literal["end"] = "end"
    records: int


Record = ProjectRecord | LeftOutRecord | BarRecord | SurfaceRecord | StepRecord | FailureRecord | EndRecord
_RECORD: TypeAdapter[Record] = TypeAdapter(Annotated[Record, Field(discriminator="kind")])


def write_record(stream: IO[bytes], record: Record, arrays: Sequence[ndarray] = ()) -> None:
    """Write a record with its arrays, at once: a later crash of the process does not hide it."""
    stream.write(record.model_dump_json().encode() + b"\n")
    for array, (_, dtype) in zip(arrays, record.ARRAYS, strict=True):
        stream.write(np.ascontiguousarray(array, dtype).tobytes())
    stream.flush()


def read_records(stream: IO[bytes]) -> Iterator[tuple[Record, tuple[ndarray, ...]]]:
    """Yield the records of an answer before its ``EndRecord``, with their arrays (n x 3, finite).

    Raises ``AnswerError`` if the answer is not complete and valid.
    """
    count, bytes_left = 0, MAX_ARRAY_BYTES
    while not isinstance(record := _read_record(stream), EndRecord):
        arrays = []
        for rows, dtype in record.ARRAYS:
            size = getattr(record, rows) * 3 * np.dtype(dtype).itemsize
            bytes_left -= size
            if bytes_left < 0:
                raise AnswerError(f"arrays of more than {MAX_ARRAY_BYTES} bytes")
            arrays.append(_read_array(stream, size, dtype))
        yield record, tuple(arrays)
        count += 1
    if record.records != count:
        raise AnswerError(f"{count} records, expected {record.records}")


def _read_record(stream: IO[bytes]) -> Record:
    line = stream.readline(_MAX_LINE_BYTES)
    if not line.endswith(b"\n"):
        raise AnswerError("the line of a record is not complete", ended=len(line) < _MAX_LINE_BYTES)
    value, problems = parse_json(line)
    if problems:
        raise AnswerError(str(problems[0]))
    try:
        return _RECORD.validate_python(value)
    except ValidationError as error:
        raise AnswerError(f"{error.error_count()} invalid values in a record, expected none") from None


def _read_array(stream: IO[bytes], size: int, dtype: str) -> ndarray:
    content = stream.read(size)
    if len(content) < size:
        raise AnswerError("an array is not complete", ended=True)
    values = np.frombuffer(content, dtype).reshape(-1, 3)
    if not np.isfinite(values).all():
        raise AnswerError("an array has values that are not finite")
    return values
