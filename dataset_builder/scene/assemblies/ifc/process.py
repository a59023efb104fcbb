"""Reinforcing bars of an IFC file, read by a process of their own with limits of time and memory.

Bars that are swept circles have axes and diameters as modelled; another solid gives one bar for each connected
surface, with the axis and the diameter of ``fitted_bar`` and the role "imported". ``scene.ifc_reader`` says which
objects are read. ifcopenshell may crash, hang or use any amount of memory on damaged files.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Event, Timer
from typing import IO

from dataset_builder.config.file_specs import Trust
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.scene.assemblies.ifc.answer import Answer, AnswerError, OutOfMemoryError
from dataset_builder.scene.selection import TABLES, Selection
from rebar_depth_bench.errors import InputError, MeshError
from rebar_depth_bench.limits import IFC_MEMORY_BYTES, IFC_SECONDS

COMMAND = (sys.executable, "-P", "-m", "dataset_builder.scene.ifc_reader")
"""Command of the process; the memory limit, the time limit and the id of this process follow."""

_WALL_CLOCK_FACTOR = 2
"""Largest duration of the process, in multiples of its processor time."""


def ifc_cage(content: bytes, where: str, select: tuple[Selection, ...] = (), trust: Trust = "declared") -> Cage:
    """Return the bars of an IFC file's ``content`` (its frame, metres); ``where`` names the file in messages.

    Without ``select``, all reinforcement is read. Bar ids start at 1 and follow the instance numbers in the file.
    Diameters and lengths are always those of the geometry; with ``trust`` "declared", a diameter that is far from
    the declared one is a problem of the cage (``ifc.declared``).

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
