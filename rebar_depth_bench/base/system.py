"""What differs between operating systems: opening and reading files, flushing them, locks, limits, processors.

Loading, writing archives and scoring use nothing of Linux outside this module. Locks and limits of processes,
which the builder and the leaderboard need, exist on POSIX systems only.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_IS_POSIX = hasattr(os, "O_DIRECTORY")
READ_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY"))
"""Flags for reading: a pipe does not block, and a terminal does not become that of the process."""


def read_range(descriptor: int, offset: int, length: int) -> bytes:
    """Return up to ``length`` bytes of a file, whose position does not matter and does not change."""
    if hasattr(os, "pread"):
        return os.pread(descriptor, length, offset)
    if not length:  # An empty file cannot be mapped.
        return b""
    with mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ) as mapped:
        return mapped[offset : offset + length]


def fsync_path(path: Path) -> None:
    """Flush the content of a file, or of a folder where the system can open one, to disk (fsync)."""
    if path.is_dir() and not _IS_POSIX:
        return
    descriptor = os.open(path, os.O_RDONLY if _IS_POSIX else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes() -> int | None:
    """Return the size of the machine's memory; None where the system does not tell."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None


@contextmanager
def exclusive_lock(path: Path, *, wait: bool = False, mode: int = 0o666) -> Iterator[None]:
    """Hold an exclusive lock on a folder, or on a file that is created with ``mode`` if it does not exist (POSIX).

    The kernel releases the lock however the process ends. Raises ``BlockingIOError`` if another process holds it,
    unless ``wait`` is set.
    """
    import fcntl

    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT, mode)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def limit_process(
    parent: int, memory_bytes: int, *, cpu_seconds: int | None = None, wall_seconds: float | None = None
) -> None:
    """Limit this process, which ``parent`` (its process id) has started, and turn off its core dumps (POSIX).

    Allocations beyond ``memory_bytes`` fail. SIGXCPU ends the process after its processor time, SIGALRM after its
    duration, and SIGKILL when its parent has ended, where the system can do so (Linux). The limits hold for this
    process alone: one that it forks would have the same again, without the duration.
    """
    import resource

    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # The parent ended before the signal was set.
            os.kill(os.getpid(), signal.SIGKILL)
    # Not RLIMIT_AS: files are memory-mapped, and libraries reserve address space that they never use.
    limits = {resource.RLIMIT_DATA: (memory_bytes, memory_bytes), resource.RLIMIT_CORE: (0, 0)}
    if cpu_seconds is not None:
        limits[resource.RLIMIT_CPU] = (cpu_seconds, cpu_seconds + 1)
    for kind, (soft, hard) in limits.items():
        present = resource.getrlimit(kind)[1]
        if present != resource.RLIM_INFINITY:  # A lower limit that is in force stays.
            soft, hard = min(soft, present), min(hard, present)
        resource.setrlimit(kind, (soft, hard))
    if wall_seconds is not None:
        signal.setitimer(signal.ITIMER_REAL, wall_seconds)
