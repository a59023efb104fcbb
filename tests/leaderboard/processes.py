"""What the kernel tells of a process: its memory, its children, its open files."""

from __future__ import annotations

import re
from pathlib import Path

KIB = 1024


def memory_bytes(pid: int, name: str = "RssAnon") -> int:
    """Return a figure of ``/proc/PID/status``: ``RssAnon`` leaves mapped files out, ``VmHWM`` is the peak."""
    found = re.search(rf"^{name}:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert found, f"process {pid} has no {name}"
    return int(found[1]) * KIB


def children(pid: int) -> list[int]:
    """Return the processes that a process has started and that still run."""
    return [
        int(child)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for child in (task / "children").read_text().split()
    ]


def runs(pid: int) -> bool:
    """Return whether a process runs: one that has ended and was not yet asked for its status does not."""
    try:
        return not re.search(r"^State:\s+[ZX]", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    except OSError:
        return False


def open_files(pid: int) -> int:
    """Return how many files, sockets and pipes a process holds open."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def descendants(pid: int) -> list[int]:
    """Return the processes that a process has started, and those that these have started."""
    try:
        direct = children(pid)
    except OSError:
        return []  # it has just ended
    return [*direct, *(below for child in direct for below in descendants(child))]
