"""Threads with progress, and limits of a process: memory, times, and its end with the parent."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import pytest

from rebar_depth_bench.base.errors import EntryError, InputError, Problem
from rebar_depth_bench.base.parallel import map_in_threads
from tests.processes import is_running, wait_until


def mapped(work: Callable[[int], int], items: Sequence[int], workers: int | None) -> list[int]:
    return list(map_in_threads(work, items, len(items), "t", workers=workers))


@pytest.mark.parametrize("workers", [None, 1, 3])
def test_results_are_in_input_order(workers: int | None) -> None:
    assert mapped(lambda n: n * n, range(50), workers) == [n * n for n in range(50)]
    assert mapped(lambda n: n, [], workers) == []


def test_look_ahead_is_two_items_per_thread() -> None:
    taken: list[int] = []
    steps: list[tuple[str, int, int]] = []

    def progress(task: str, done: int, total: int) -> None:
        assert len(taken) <= done + 3
        steps.append((task, done, total))

    for _ in map_in_threads(taken.append, range(100), 100, "t", workers=2, progress=progress):
        time.sleep(0.001)  # The threads could take more items meanwhile.
    assert steps == [("t", done, 100) for done in range(1, 101)]


def test_exceptions_of_the_function_propagate() -> None:
    with pytest.raises(ZeroDivisionError):
        mapped(lambda n: 1 // n, [1, 0, 2], 2)


def test_zero_workers_raises_input_error() -> None:
    with pytest.raises(InputError, match="workers is 0, expected 1 or more"):
        mapped(lambda n: n, [1], 0)


def test_error_of_an_entry_arrives_from_another_process() -> None:
    error = EntryError(Problem("size", "lattice/0000", "4 bytes follow", "none"))
    received = pickle.loads(pickle.dumps(error))
    assert str(received) == "lattice/0000: 4 bytes follow, expected none"
    assert received.problems == error.problems


LIMIT = "import os, sys, time; from rebar_depth_bench.base.system import limit_process; "
MIB = 1 << 20


def status(code: str) -> int:
    """Return the exit status of a process that runs ``code``."""
    return subprocess.run([sys.executable, "-c", LIMIT + code], check=False, timeout=60).returncode


@pytest.mark.slow
def test_memory_and_times_end_the_process() -> None:
    limits = f"limit_process(os.getppid(), {200 * MIB}"
    failed = "raise SystemExit('allocated')\nexcept MemoryError: raise SystemExit(7)"
    assert status(f"{limits})\ntry: bytearray({100 * MIB}); bytearray({300 * MIB}); {failed}") == 7
    assert status(f"{limits}, cpu_seconds=1)\nwhile True: pass") == -signal.SIGXCPU
    begin_s = time.monotonic()
    assert status(f"{limits}, wall_seconds=0.2); time.sleep(50)") == -signal.SIGALRM
    assert time.monotonic() - begin_s < 40


@pytest.mark.slow
def test_lower_limit_in_force_is_kept() -> None:
    code = (
        f"import resource; resource.setrlimit(resource.RLIMIT_DATA, ({300 * MIB}, {300 * MIB})); "
        f"limit_process(os.getppid(), {8 << 30}, cpu_seconds=30); "
        f"assert resource.getrlimit(resource.RLIMIT_DATA) == ({300 * MIB}, {300 * MIB}); "
        "assert resource.getrlimit(resource.RLIMIT_CPU) == (30, 31); "
        "assert resource.getrlimit(resource.RLIMIT_CORE) == (0, 0)"
    )
    assert status(code) == 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_process_ends_with_its_parent_also_if_that_has_ended_before() -> None:
    assert status(f"limit_process({os.getpid() + 1}, {200 * MIB})") == -signal.SIGKILL
    child = (
        LIMIT + f"limit_process(int(sys.argv[1]), {200 * MIB}); print(os.getpid(), flush=True); time.sleep(100)"
    )
    start = f"subprocess.Popen([sys.executable, '-c', {child!r}, str(os.getpid())]); time.sleep(100)"
    parent = f"import os, subprocess, sys, time; {start}"
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE) as process:
        assert process.stdout
        pid = int(process.stdout.readline())
        assert is_running(pid)
        assert resource.prlimit(pid, resource.RLIMIT_DATA) == (200 * MIB, 200 * MIB)
        process.kill()
    wait_until(lambda: not is_running(pid), "the process ends", within_s=30)
