"""Memory, children and open files of processes, read from ``/proc``."""

from __future__ import annotations

import re
from pathlib import Path

KIB = 1024


def memory_bytes(pid: int, name: str = "RssAnon") -> int:
    """Return a field of ``/proc/PID/status`` in bytes: ``RssAnon`` without mapped files, ``VmHWM`` the peak."""
    match = re.search(rf"^{name}:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert match, f"process {pid} has no {name}"
    return int(match[1]) * KIB


def children(pid: int) -> list[int]:
    """Return the ids of the running child processes of ``pid``."""
    return [
        int(child)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for child in (task / "children").read_text().split()
    ]


def is_running(pid: int) -> bool:
    """Return whether a process is running; zombies are not."""
    try:
        return not re.search(r"^State:\s+[ZX]", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    except OSError:
        return False


def num_open_files(pid: int) -> int:
    """Return the number of open files, sockets and pipes of a process."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def descendants(pid: int) -> list[int]:
    """Return the ids of all direct and indirect child processes of ``pid``."""
    try:
        direct = children(pid)
    except OSError:
        return []  # The process has just ended.
    return [*direct, *(descendant for child in direct for descendant in descendants(child))]
