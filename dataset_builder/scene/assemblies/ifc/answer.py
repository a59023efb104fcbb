"""Answer of the process that reads an IFC file, validated, as the bars of a cage.

The process has read content from a stranger, so its answer is data like any other file: one JSON line per record,
followed by the arrays that it announces (see ``scene.ifc_reader.answer``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import IO, Annotated, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import Field, TypeAdapter, ValidationError

from dataset_builder.config.file_specs import Trust
from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut, unit_scale
from dataset_builder.scene.assemblies.ifc.declared import compare_declared
from dataset_builder.scene.assemblies.mesh_import import connected_components, fitted_bar
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS, Mesh, Note, axis_of
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import MeshError, Problem
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.validation import StrictModel

MAX_ARRAY_BYTES = 1 << 30
"""Largest size of all arrays of an answer: more than ``MAX_TRIANGLES`` of a cage."""

_MAX_LINE_BYTES = 20_000
_Label = Annotated[str, Field(min_length=1, max_length=200)]
_Message = Annotated[str, Field(max_length=1000)]


_Size = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class _Source(StrictModel):
    """Object of a file: GlobalId, name in messages, host, storey, and the sizes declared for its bars, metres."""

    global_id: _Label
    label: _Label
    host: _Label | None
    storey: _Label | None
    diameters_m: Annotated[list[_Size], Field(max_length=3)]
    length_m: _Size | None


class _NoteRecord(StrictModel):
    """Remark on a bar."""

    code: Annotated[str, Field(pattern="^[a-z]{1,20}$")]
    text: Annotated[str, Field(max_length=200)]


class _ProjectRecord(StrictModel):
    """Project of the file, with its length unit."""

    kind: Literal["project"]
    unit_m: _Size


class _LeftOutRecord(StrictModel):
    """Object that is not read, and the reason."""

    kind: Literal["left_out"]
    global_id: _Label
    reason: _Label


class _BarRecord(StrictModel):
    """Bar with an axis of ``points`` points (float64, the file's frame, metres), which follow."""

    kind: Literal["bar"]
    source: _Source
    notes: Annotated[list[_NoteRecord], Field(max_length=10)]
    role: Annotated[str, Field(min_length=1, max_length=60)]
    diameter_m: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    points: Annotated[int, Field(ge=2)]


class _SurfaceRecord(StrictModel):
    """Tessellated object; its vertices (float64, metres) and triangles (int32) follow."""

    kind: Literal["surface"]
    source: _Source
    vertices: Annotated[int, Field(ge=3)]
    faces: Annotated[int, Field(ge=1)]


class _StepRecord(StrictModel):
    """Object that is tessellated next, and why it has no axis."""

    kind: Literal["step"]
    label: _Label
    reason: _Message


class _FailureRecord(StrictModel):
    """Reason for which reading ended."""

    kind: Literal["failure"]
    cause: Literal["file", "memory", "package", "shape"]
    message: _Message


class _EndRecord(StrictModel):
    """End of a complete answer, with its number of other records but steps."""

    kind: Literal["end"]
    records: int


_Record = _ProjectRecord | _LeftOutRecord | _BarRecord | _SurfaceRecord | _StepRecord | _FailureRecord | _EndRecord
_RECORD: TypeAdapter[_Record] = TypeAdapter(Annotated[_Record, Field(discriminator="kind")])


class AnswerError(Exception):
    """Answer that is incomplete (``ended``) or not valid; the message is the reason."""

    def __init__(self, reason: str, ended: bool = False) -> None:
        super().__init__(reason)
        self.ended = ended


class OutOfMemoryError(Exception):
    """Answer that says that the process had not enough memory."""


class Answer:
    """Records of an answer; ``step`` is the last object that was to be tessellated, or None."""

    def __init__(self, stream: IO[bytes], where: str, trust: Trust = "declared") -> None:
        self._stream, self._where, self._trust = stream, where, trust
        self._problems: list[Problem] = []
        self._bytes_left = MAX_ARRAY_BYTES
        self.step: _StepRecord | None = None

    def cage(self) -> Cage:
        """Return the bars (the file's frame, metres), with ids from 1 in the order of the answer.

        Diameters that are far from the declared ones are problems of the cage (``ifc.declared``). Raises
        ``MeshError`` if the process refused the file or a surface is not a bar, ``OutOfMemoryError`` if it ran out
        of memory, and ``AnswerError`` if the answer is not complete and valid.
        """
        bars: list[CageBar] = []
        left_out: list[LeftOut] = []
        unit_m = None
        for record in self._records():
            match record:
                case _ProjectRecord():
                    unit_m = record.unit_m
                case _LeftOutRecord():
                    left_out.append(LeftOut(record.global_id, record.reason))
                case _BarRecord():
                    bars.append(self._swept_bar(len(bars) + 1, record))
                case _SurfaceRecord():
                    bars += self._surface_bars(len(bars) + 1, record)
            if len(bars) > MAX_BARS:
                raise MeshError(f"{self._where}: more than {MAX_BARS} bars found, expected at most {MAX_BARS}")
        if unit_m is None:
            raise AnswerError("there is no project")
        return Cage(tuple(bars), tuple(left_out), unit_scale(unit_m), tuple(self._problems))

    def _records(self) -> Iterator[_Record]:
        """Yield the records up to the end, without steps. Raises as ``cage``."""
        count = 0
        while True:
            record = self._record()
            match record:
                case _StepRecord():
                    self.step = record
                case _FailureRecord():
                    raise self._failure(record)
                case _EndRecord():
                    if record.records != count:
                        raise AnswerError(f"{count} records, expected {record.records}")
                    return
                case _:
                    count += 1
                    yield record

    def no_shape_error(self, problem: str) -> MeshError:
        """Return the error of the object that was tessellated when ``problem`` occurred."""
        label, reason = ("a bar", "") if self.step is None else (self.step.label, self.step.reason)
        return MeshError(
            f"{self._where}: {label} has no readable shape: {reason}; tessellation: {problem}; "
            "expected a swept circle or another solid"
        )

    def _failure(self, record: _FailureRecord) -> Exception:
        if record.cause == "memory":
            return OutOfMemoryError()
        if record.cause == "shape":
            return self.no_shape_error(record.message)
        return MeshError(f"{self._where}: {record.message}")

    def _record(self) -> _Record:
        line = self._stream.readline(_MAX_LINE_BYTES)
        if not line.endswith(b"\n"):
            raise AnswerError("the line of a record is not complete", ended=len(line) < _MAX_LINE_BYTES)
        value, problems = parse_json(line)
        if problems:
            raise AnswerError(str(problems[0]))
        try:
            return _RECORD.validate_python(value)
        except ValidationError as error:
            raise AnswerError(f"{error.error_count()} invalid values in a record, expected none") from None

    def _array(self, rows: int, dtype: str) -> ndarray:
        """Return an array of ``rows`` x 3 values, which are finite."""
        size = rows * 3 * np.dtype(dtype).itemsize
        self._bytes_left -= size
        if self._bytes_left < 0:
            raise AnswerError(f"arrays of more than {MAX_ARRAY_BYTES} bytes")
        content = self._stream.read(size)
        if len(content) < size:
            raise AnswerError("an array is not complete", ended=True)
        values = np.frombuffer(content, dtype).reshape(rows, 3)
        if not np.isfinite(values).all():
            raise AnswerError("an array has values that are not finite")
        return values

    def _swept_bar(self, bar_id: int, record: _BarRecord) -> CageBar:
        axis_m: Float64[ndarray, "n 3"] = np.round(self._array(record.points, "<f8"), METRE_DECIMALS)
        diameter_m = round(record.diameter_m, METRE_DECIMALS)
        bar = Bar(bar_id, record.role, diameter_m, axis_of(axis_m))
        label = _bar_label(bar_id, record.source.label)
        notes = tuple(Note(record.source.label, note.code, note.text) for note in record.notes)
        return self._compared(CageBar(label, bar, notes=notes), record.source)

    def _compared(self, bar: CageBar, source: _Source) -> CageBar:
        """Return the bar with its object's names and notes on its sizes; collect a problem if they are far off."""
        notes, problem = compare_declared(bar, source.label, source.diameters_m, source.length_m, self._trust)
        self._problems += [problem] if problem else []
        notes = [*bar.notes, *notes]
        return replace(bar, source=source.global_id, host=source.host, storey=source.storey, notes=tuple(notes))

    def _surface_bars(self, bar_id: int, record: _SurfaceRecord) -> list[CageBar]:
        """Return the connected surfaces of an object as bars (``fitted_bar``)."""
        vertices_m, faces = self._array(record.vertices, "<f8"), self._array(record.faces, "<i4")
        if faces.min() < 0 or faces.max() >= record.vertices:
            raise AnswerError("a triangle refers to a vertex that does not exist")
        bars = []
        for number, part in enumerate(connected_components(Mesh(vertices_m, faces)), start=bar_id):
            label = _bar_label(number, record.source.label)
            try:
                bar = CageBar(label, fitted_bar(number, part), mesh=part)
            except ValueError as error:
                raise MeshError(f"{self._where}: {label}: is not a solid ({error}), expected a bar") from error
            bars.append(self._compared(bar, record.source))
        return bars


def _bar_label(bar_id: int, label: str) -> str:
    return f"bar {bar_id}, {label}"
