"""Reinforcing bars of an IFC file, read by a process of their own with limits of time and memory.

Bars that are swept circles have axes and diameters as modelled; another solid gives one bar for each connected
surface, with the axis and the diameter of ``fitted_bar`` and the role "imported". ``user_files.ifc_reader`` says
which objects are read. ifcopenshell may crash, hang or use any amount of memory on damaged files.

The geometry is always what is built. Some programs model the outer diameter of the ribs (some 10 % more), so
diameters may differ from the declared ones; beyond a quarter, one of the two values is wrong. Lengths are compared
for information: some programs write them in another unit, or for a whole row of bars.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from typing import IO

import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut, unit_scale
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS, Mesh, Note, axis_of
from dataset_builder.specs.file_specs import TABLES, Selection, Trust
from dataset_builder.user_files.ifc_records import (
    AnswerError,
    BarRecord,
    FailureRecord,
    LeftOutRecord,
    ProjectRecord,
    Source,
    StepRecord,
    SurfaceRecord,
    read_records,
)
from dataset_builder.user_files.mesh_import import connected_components, fitted_bar
from rebar_depth_bench.base.errors import MeshError, Problem, require_extra
from rebar_depth_bench.base.limits import IFC_MEMORY_BYTES, IFC_SECONDS
from rebar_depth_bench.data.bars import Bar

COMMAND = (sys.executable, "-P", "-m", "dataset_builder.user_files.ifc_reader")
"""Command of the process; the id of this process, the memory limit and both time limits follow."""

_WALL_CLOCK_FACTOR = 2
"""Largest duration of the process, in multiples of its processor time."""

_NOTED, _REFUSED = 0.05, 0.25
"""Differences, relative to the declared value, above which there is a note, and above which a bar is refused."""


def ifc_cage(content: bytes, where: str, select: tuple[Selection, ...] = (), trust: Trust = "declared") -> Cage:
    """Return the bars of an IFC file's ``content`` (its frame, metres); ``where`` names the file in messages.

    Without ``select``, all reinforcement is read. Bar ids start at 1 and follow the instance numbers in the file.
    Diameters and lengths always come from the geometry; with ``trust`` "declared", a diameter that is far from
    the declared one is a problem of the cage.

    Raises ``MeshError`` if the file is not a complete IFC file, has no known length unit, nothing to read or
    a bar without usable geometry (with its GlobalId), if a part of it cannot be read, if a bar depends on an
    instance that is not as its class says, or if reading exceeds a limit; ``InputError`` if ifcopenshell is not
    installed.
    """
    require_extra("ifc", ["ifcopenshell"])
    seconds = IFC_SECONDS.value()
    wall_seconds = _WALL_CLOCK_FACTOR * seconds
    limits = map(str, (os.getpid(), IFC_MEMORY_BYTES.value(), seconds, wall_seconds))
    deadline_s = time.monotonic() + wall_seconds
    with subprocess.Popen(
        [*COMMAND, *limits], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdin
        assert process.stdout
        answer = Answer(process.stdout, where, trust)
        try:
            # The pipe is broken if the process has ended, for a reason that its status tells.
            with suppress(BrokenPipeError), process.stdin as stream:
                stream.write(TABLES.dump_json(select) + b"\n" + content)
            return answer.cage()
        except AnswerError as error:
            if not error.ended:
                raise MeshError(f"{where}: the IFC reader gave an invalid answer: {error}") from None
            problem = _end_reason(process.wait(), time.monotonic() >= deadline_s)
        finally:
            process.kill()
    if answer.step is None:
        raise MeshError(f"{where}: the file cannot be read: {problem}, expected a sound IFC file")
    raise MeshError(f"{where}: {answer.step.failure(problem)}")


def _end_reason(status: int, is_late: bool) -> str:
    """Return how the process ended, which gave no complete answer; ``is_late``: after its largest duration."""
    if status == -signal.SIGXCPU or (status == -signal.SIGALRM and is_late):
        return f"reading takes more than {IFC_SECONDS.value()} s ({IFC_SECONDS.variable} raises the limit)"
    if status == -signal.SIGALRM:
        return "it takes more than the time limit for one object"
    end = signal.strsignal(-status) if status < 0 else f"status {status}"
    return f"ifcopenshell crashed ({end}), or needs {_memory_limit()}"


def _memory_limit() -> str:
    limit = IFC_MEMORY_BYTES
    return f"more than {limit.value()} bytes of memory ({limit.variable} raises the limit)"


class Answer:
    """Answer of the process as the bars of a cage; ``step`` is the last object that was to be tessellated."""

    def __init__(self, stream: IO[bytes], where: str, trust: Trust = "declared") -> None:
        self._stream, self._where, self._trust = stream, where, trust
        self._problems: list[Problem] = []
        self.step: StepRecord | None = None

    def cage(self) -> Cage:
        """Return the bars (the file's frame, metres), with ids from 1 in the order of the answer.

        Diameters that are far from the declared ones are problems of the cage. Raises ``MeshError`` if the process
        refused the file, had not enough memory, or if a surface is not a bar, and ``AnswerError`` if the answer is
        not complete and valid.
        """
        bars: list[CageBar] = []
        left_out: list[LeftOut] = []
        unit_m = None
        for record, arrays in read_records(self._stream):
            match record:
                case ProjectRecord():
                    unit_m = record.unit_m
                case LeftOutRecord():
                    left_out.append(LeftOut(record.global_id, record.reason))
                case BarRecord():
                    bars.append(self._swept_bar(len(bars) + 1, record, *arrays))
                case SurfaceRecord():
                    bars += self._surface_bars(len(bars) + 1, record, *arrays)
                case StepRecord():
                    self.step = record
                case FailureRecord():
                    reason = record.message or f"reading needs {_memory_limit()}"
                    raise MeshError(f"{self._where}: {reason}")
            if len(bars) > MAX_BARS:
                raise MeshError(f"{self._where}: more than {MAX_BARS} bars found, expected at most {MAX_BARS}")
        if unit_m is None:
            raise AnswerError("there is no project")
        return Cage(tuple(bars), tuple(left_out), unit_scale(unit_m), tuple(self._problems))

    def _swept_bar(self, bar_id: int, record: BarRecord, axis_m: Float64[ndarray, "n 3"]) -> CageBar:
        axis = axis_of(np.round(axis_m, METRE_DECIMALS))
        bar = Bar(bar_id, record.role, round(record.diameter_m, METRE_DECIMALS), axis)
        notes = tuple(Note(record.source.label, code, text) for code, text in record.notes.items())
        return self._compared(CageBar(_bar_label(bar_id, record.source), bar, notes=notes), record.source)

    def _surface_bars(
        self,
        bar_id: int,
        record: SurfaceRecord,
        vertices_m: Float64[ndarray, "v 3"],
        faces: Int32[ndarray, "f 3"],
    ) -> list[CageBar]:
        """Return the connected surfaces of an object as bars (``fitted_bar``)."""
        if faces.min() < 0 or faces.max() >= record.vertices:
            raise AnswerError("a triangle refers to a vertex that does not exist")
        bars = []
        for number, part in enumerate(connected_components(Mesh(vertices_m, faces)), start=bar_id):
            label = _bar_label(number, record.source)
            try:
                bar = CageBar(label, fitted_bar(number, part), mesh=part)
            except ValueError as error:
                raise MeshError(f"{self._where}: {label}: is not a solid ({error}), expected a bar") from error
            bars.append(self._compared(bar, record.source))
        return bars

    def _compared(self, bar: CageBar, source: Source) -> CageBar:
        """Return the bar with its object's names and notes on its sizes; collect a problem if they are far off.

        The nearest of the declared diameters counts. A bar without axis and diameter is not compared.
        """
        notes = list(bar.notes)
        found_m, length_m = bar.bar.diameter_m, source.length_m
        if bar.bar.has_axis and source.diameters_m:
            declared_m = min(source.diameters_m, key=lambda declared_m: abs(declared_m - found_m))
            difference = abs(found_m - declared_m) / declared_m
            values = (
                f"the diameter is {found_m * 1000:.4g} mm in the geometry, {declared_m * 1000:.4g} mm as declared"
            )
            if difference > _REFUSED and self._trust != "geometry":
                problem = Problem("invalid", bar.label, values, f"at most {_REFUSED:.0%} difference")
                self._problems.append(problem)
            elif difference > _NOTED:
                notes.append(Note(source.label, "diameter", values))
        if bar.bar.has_axis and length_m and abs(bar.bar.length_m - length_m) > _NOTED * length_m:
            values = f"the length is {bar.bar.length_m:.4g} m in the geometry, {length_m:.4g} m as declared"
            notes.append(Note(source.label, "length", values))
        return replace(bar, source=source.global_id, host=source.host, storey=source.storey, notes=tuple(notes))


def _bar_label(bar_id: int, source: Source) -> str:
    return f"bar {bar_id}, {source.label}"
