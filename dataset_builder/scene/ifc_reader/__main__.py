"""Process that reads an IFC file: a line of JSON and the content on standard input, answer on standard output.

The line is a list of the tables that select objects (``scene.selection.TABLES``).

``python -m dataset_builder.scene.ifc_reader MEMORY_BYTES CPU_SECONDS PARENT_PID``
"""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SECONDS_PER_SHAPE = 60
"""Time limit for tessellating one object; SIGALRM ends the process after it."""

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Set the limits, read the content and write the answer; native output is redirected to standard error."""
    memory_bytes, cpu_seconds, parent_pid = map(int, sys.argv[1:])
    _end_with_parent(parent_pid)
    _set_limits(memory_bytes, cpu_seconds)
    from dataset_builder.scene.ifc_reader.answer import write_answer
    from dataset_builder.scene.selection import TABLES

    with os.fdopen(os.dup(1), "wb") as stream:
        os.dup2(2, 1)
        select = TABLES.validate_json(sys.stdin.buffer.readline())
        write_answer(sys.stdin.buffer.read(), stream, select, _limited_time)


def _end_with_parent(parent_pid: int) -> None:
    """Let the kernel end this process when its parent ends, where the system can do so (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent_pid:
            os._exit(1)


@contextmanager
def _limited_time() -> Iterator[None]:
    """Limit the time of a use of the geometry kernel."""
    signal.alarm(SECONDS_PER_SHAPE)
    try:
        yield
    finally:
        signal.alarm(0)


def _set_limits(memory_bytes: int, cpu_seconds: int) -> None:
    """Limit memory and processor time, and turn off core dumps."""
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_seconds, cpu_seconds + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main()
