"""Bounds for a process that reads a stranger's archive: memory, priority, and death with its parent (Linux)."""

from __future__ import annotations

import ctypes
import os
import resource
import signal

_PR_SET_PDEATHSIG = 1
NICENESS = 10
LEAST_BYTES = 1 << 30
"""Interpreter, libraries and the stacks of their threads alone take several hundred megabytes."""


def confine(memory: int, parent: int) -> None:
    """Limit this process's memory, bytes, and have it killed when its parent, a process id, dies.

    It also gives way to whoever answers requests.
    """
    os.nice(NICENESS)
    limit = max(memory, LEAST_BYTES)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))  # not RLIMIT_AS: archives are mapped whole
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    die_with_parent(parent)


def die_with_parent(parent: int) -> None:
    """Have this process killed when the thread that started it ends.

    ``parent`` is told by who started it: asked for here, a parent that died meanwhile would not be missed.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before it could be watched
        os.kill(os.getpid(), signal.SIGKILL)
