"""Limits for a process that reads an untrusted archive: memory, priority, termination with its parent (Linux)."""

from __future__ import annotations

import ctypes
import os
import resource
import signal

_PR_SET_PDEATHSIG = 1
NICENESS = 10
MIN_MEMORY_BYTES = 1 << 30
"""Minimum memory limit: interpreter, libraries and thread stacks alone take several hundred megabytes."""


def limit_process(memory: int, parent: int) -> None:
    """Limit the memory of this process to ``memory`` bytes and have it killed when process ``parent`` dies.

    Its priority is lowered, so that it does not slow down the server, and core dumps are disabled.
    """
    os.nice(NICENESS)
    limit = max(memory, MIN_MEMORY_BYTES)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))  # Not RLIMIT_AS, because archives are memory-mapped.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    die_with_parent(parent)


def die_with_parent(parent: int) -> None:
    """Have this process killed when the thread that started it ends.

    ``parent`` is the parent's process id as passed by the parent itself; ``os.getppid()`` alone would not detect a
    parent that died before this call.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # The parent died before the signal was set.
        os.kill(os.getpid(), signal.SIGKILL)
