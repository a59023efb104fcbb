"""Reinforcing bars of an IFC file, read by a process of their own with limits of time and memory.

Bars that are swept circles have axes and diameters as modelled; another solid gives one bar for each connected
surface, with the axis and the diameter of ``fitted_bar`` and the role "imported". ``scene.ifc_reader`` says which
objects are read. ifcopenshell may crash, hang or use any amount of memory on damaged files. The process has read
content from a stranger, so its answer (``scene.ifc_reader.answer``) is checked like any other file.

The geometry is always what is built. Some programs model the outer diameter of the ribs (some 10 % more), so
diameters may differ from the declared ones; beyond a quarter, one of the two values is wrong. Lengths are compared
for information: some programs write them in another unit, or for a whole row of bars.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from threading import Event, Timer
from typing import IO, Annotated, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import Field, TypeAdapter, ValidationError

from dataset_builder.config.file_specs import Trust
from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut, unit_scale
from dataset_builder.scene.assemblies.mesh_import import connected_components
from dataset_builder.scene.assemblies.surface_bar import fitted_bar
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS, Mesh, Note, axis_of
from dataset_builder.scene.selection import TABLES, Selection
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError, MeshError, Problem
from rebar_depth_bench.limits import IFC_MEMORY_BYTES, IFC_SECONDS
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.validation import StrictModel

COMMAND = (sys.executable, "-P", "-m", "dataset_builder.scene.ifc_reader")
"""Command of the process; the memory limit, the time limit and the id of this process follow."""

_WALL_CLOCK_FACTOR = 2
"""Largest duration of the process, in multiples of its processor time."""


def ifc_cage(content: bytes, where: str, select: tuple[Selection, ...] = (), trust: Trust = "declared") -> Cage:
    """Return the bars of an IFC file's ``content`` (its frame, metres); ``where`` names the file in messages.

    Without ``select``, all reinforcement is read. Bar ids start at 1 and follow the instance numbers in the file.
    Diameters and lengths are always those of the geometry; with ``trust`` "declared", a diameter that is far from
    the declared one is a problem of the cage (see the module).

    Raises ``MeshError`` if the file is not a complete IFC file, has no known length unit, nothing to read or
    a bar without usable geometry (with its GlobalId), if a bar depends on an instance that cannot be read as
    written, or if reading exceeds a limit; ``InputError`` if ifcopenshell is not installed.
    """
    if importlib.util.find_spec("ifcopenshell") is None:
        raise InputError(
            "not installed: ifcopenshell; expected the ifc extra for IFC models: "
            "pip install 'rebar-depth-bench[ifc]'"
        )
    with _reader(TABLES.dump_json(select) + b"\n" + content) as reader:
        answer = Answer(reader.stdout, where, trust)
        try:
            return answer.cage()
        except OutOfMemoryError:
            raise MeshError(f"{where}: reading needs {_memory_limit()}") from None
        except AnswerError as error:
            if not error.ended:
                raise MeshError(f"{where}: the IFC reader gave an invalid answer: {error}") from None
            problem = reader.end_reason()
        if answer.step is not None:
            raise answer.no_shape_error(problem)
        raise MeshError(f"{where}: the file cannot be read: {problem}, expected a sound IFC file")


@dataclass(frozen=True)
class _Reader:
    """Running process; ``expired`` is set when its duration has passed and it was killed."""

    process: subprocess.Popen[bytes]
    stdout: IO[bytes]
    expired: Event

    def end_reason(self) -> str:
        """Return how the process ended, which gave no complete answer."""
        status = self.process.wait()
        if self.expired.is_set() or status == -signal.SIGXCPU:
            return f"reading takes more than {IFC_SECONDS.value()} s ({IFC_SECONDS.variable} raises the limit)"
        if status == -signal.SIGALRM:
            return "it takes more than the time limit for one object"
        end = signal.strsignal(-status) if status < 0 else f"status {status}"
        return f"ifcopenshell crashed ({end}), or needs {_memory_limit()}"


def _memory_limit() -> str:
    limit = IFC_MEMORY_BYTES
    return f"more than {limit.value()} bytes of memory ({limit.variable} raises the limit)"


@contextmanager
def _reader(request: bytes) -> Iterator[_Reader]:
    """Start the process and pass it ``request``; it is killed at the end, or after its largest duration."""
    seconds = IFC_SECONDS.value()
    command = (*COMMAND, str(IFC_MEMORY_BYTES.value()), str(seconds), str(os.getpid()))
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdin
        assert process.stdout
        expired = Event()

        def expire() -> None:
            expired.set()
            process.kill()

        timer = Timer(_WALL_CLOCK_FACTOR * seconds, expire)
        timer.start()
        try:
            # The pipe is broken if the process has ended, for a reason that its status tells.
            with suppress(BrokenPipeError), process.stdin as stream:
                stream.write(request)
            yield _Reader(process, process.stdout, expired)
        finally:
            timer.cancel()
            process.kill()


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

        Diameters that are far from the declared ones are problems of the cage (see the module). Raises
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


_NOTED, _REFUSED = 0.05, 0.25
"""Differences, relative to the declared value, above which there is a note, and above which a bar is refused."""


def compare_declared(
    bar: CageBar, name: str, diameters_m: Sequence[float], length_m: float | None, trust: Trust
) -> tuple[list[Note], Problem | None]:
    """Return notes (with ``name`` as source) on a bar, and the reason to refuse it or None.

    The declared ``diameters_m`` may be none, one, or two for a mesh, of which the nearest counts; ``length_m`` is
    the declared length of the centreline or None. A bar without axis and diameter is not compared.
    """
    if not bar.bar.has_axis:
        return [], None
    notes: list[Note] = []
    found_m = bar.bar.diameter_m
    if diameters_m:
        nearest_m = min(diameters_m, key=lambda declared_m: abs(declared_m - found_m))
        difference = abs(found_m - nearest_m) / nearest_m
        values = f"the diameter is {found_m * 1000:.4g} mm in the geometry, {nearest_m * 1000:.4g} mm as declared"
        if difference > _REFUSED and trust != "geometry":
            return [], Problem("invalid", bar.label, values, f"at most {_REFUSED:.0%} difference")
        if difference > _NOTED:
            notes.append(Note(name, "diameter", values))
    if length_m and abs(bar.bar.length_m - length_m) > _NOTED * length_m:
        values = f"the length is {bar.bar.length_m:.4g} m in the geometry, {length_m:.4g} m as declared"
        notes.append(Note(name, "length", values))
    return notes, None
