"""Reading of an IFC model's objects in two processes, on Linux.

Reading takes milliseconds an object. The second process is a fork, so the model is parsed once. It only saves
time: where it stops early, for whatever reason, the first process reads the rest and meets the same errors.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, BinaryIO, TypeVar

MIN_OBJECTS = 500
"""Smallest number of objects for a second process."""

_PR_SET_PDEATHSIG = 1

_Object = TypeVar("_Object")
_Result = TypeVar("_Result")


def read_in_order(
    read: Callable[[_Object], _Result],
    objects: Sequence[_Object],
    read_ahead: Callable[[_Object], _Result] | None,
) -> Iterator[_Result]:
    """Yield ``read`` of every object, in order.

    ``read_ahead`` reads the second half in a second process, until it raises an exception for an object; its
    results must be those of ``read``. With None there is one process.
    """
    if read_ahead is None or len(objects) < MIN_OBJECTS or sys.platform != "linux":
        yield from map(read, objects)
        return
    half = len(objects) // 2
    with _second_process(read_ahead, objects[half:]) as answer:
        yield from map(read, objects[:half])
        results = _received(answer)
    yield from results
    yield from map(read, objects[half + len(results) :])


def end_with_parent(parent_pid: int) -> None:
    """Let the kernel end this process when its parent ends, where the system can do so (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent_pid:
            os._exit(1)


@contextmanager
def _second_process(read: Callable[[_Object], _Result], objects: Sequence[_Object]) -> Iterator[BinaryIO]:
    """Fork a process that reads ``objects``, yield the stream of its answer, and end it."""
    receive, send = os.pipe()
    parent_pid = os.getpid()
    pid = os.fork()
    if pid == 0:
        try:
            end_with_parent(parent_pid)
            os.close(receive)
            with os.fdopen(send, "wb") as stream:
                pickle.dump(_results(read, objects), stream)
        finally:
            os._exit(0)  # Buffers and exit handlers are those of the first process.
    os.close(send)
    try:
        with os.fdopen(receive, "rb") as stream:
            yield stream
    finally:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def _results(read: Callable[[_Object], _Result], objects: Sequence[_Object]) -> list[_Result]:
    """Return the results up to the first object that cannot be read."""
    results = []
    with suppress(Exception):
        for item in objects:
            results.append(read(item))  # noqa: PERF401 (those before an exception are kept)
    return results


def _received(answer: BinaryIO) -> list[Any]:
    """Return the results of the second process; none if it ended without an answer."""
    try:
        results: list[Any] = pickle.load(answer)  # noqa: S301 (it is a fork of this process)
    except (EOFError, pickle.UnpicklingError):
        return []
    return results
