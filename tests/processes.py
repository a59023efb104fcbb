"""Child processes, memory and open files of processes, read from ``/proc``, and waiting for a condition."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path

KIB = 1024


def wait_until(condition: Callable[[], object], what: str = "the condition holds", within_s: float = 120) -> None:
    """Wait until ``condition`` holds; fail after ``within_s`` seconds."""
    deadline = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {within_s} s: {what}"
        time.sleep(0.02)


def memory_bytes(pid: int, name: str = "RssAnon") -> int:
    """Return a field of ``/proc/PID/status`` in bytes: ``RssAnon`` without mapped files, ``VmHWM`` the peak."""
    match = re.search(rf"^{name}:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert match, f"process {pid} has no {name}"
    return int(match[1]) * KIB


def num_open_files(pid: int) -> int:
    """Return the number of open files, sockets and pipes of a process."""
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def is_running(pid: int) -> bool:
    """Return whether a process is running; zombies are not."""
    return bool(re.search(rb"^State:\s+[^ZX\s]", _read(Path(f"/proc/{pid}/status")), re.MULTILINE))


def children(pid: int) -> list[int]:
    """Return the ids of the child processes of ``pid``."""
    try:
        threads = list(Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return []  # The process has just ended.
    return [int(child) for thread in threads for child in _read(thread / "children").split()]


def descendants(pid: int) -> list[int]:
    """Return the ids of all direct and indirect child processes of ``pid``, direct ones first."""
    direct = children(pid)
    return [*direct, *(descendant for child in direct for descendant in descendants(child))]


def processes_below(pid: int, text: bytes) -> list[int]:
    """Return the descendants of ``pid`` whose command line contains ``text``."""
    return [descendant for descendant in descendants(pid) if text in _read(Path(f"/proc/{descendant}/cmdline"))]


def _read(path: Path) -> bytes:
    """Return the content of a file of a process or thread; empty if it has just ended."""
    try:
        return path.read_bytes()
    except OSError:
        return b""
