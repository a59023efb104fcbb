"""Run of one action under observation, and the properties that hold for every input.

An action raises ``RebarDepthError`` or returns. It runs as a command does, in this process.
"""

from __future__ import annotations

import re
import resource
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from rebar_depth_bench.base.errors import RebarDepthError
from rebar_depth_bench.cli.console import EXIT_DONE, EXIT_INPUT, run_command
from tests.commands import run_in_process
from tests.fuzz.workspace import CACHE, OUT, Workspace, changes

CPU_LIMIT_S = 10.0
MEMORY_LIMIT_BYTES = 300 << 20
"""Largest growth of the resident memory; the largest sound input takes a third of it."""
MAX_OUTPUT_CHARACTERS, MAX_LINE_CHARACTERS = 50_000, 1000
_KIB = 1024


@dataclass(frozen=True)
class Observation:
    """Exit status, problem codes, output, costs and changed paths of a run; ``crash`` is a traceback or empty."""

    status: int
    codes: tuple[str, ...]
    stdout: str
    stderr: str
    crash: str
    cpu_s: float
    peak_bytes: int
    changed: tuple[str, ...]


@dataclass(frozen=True)
class Expectation:
    """What may happen.

    ``names`` are texts of which one is in every error message, ``kept_outputs`` patterns of outputs that may stay
    after a failure, ``may_change`` patterns of paths that may change, and ``cpu_s`` the processor time in seconds.
    """

    statuses: Sequence[int] = (EXIT_DONE, EXIT_INPUT)
    names: Sequence[str] = ()
    kept_outputs: Sequence[str] = ()
    may_change: Sequence[str] = ()
    cpu_s: float = CPU_LIMIT_S


def observe(action: Callable[[], object], workspace: Workspace) -> Observation:
    """Run an action and return what it did."""
    codes: list[str] = []

    def run() -> None:
        try:
            action()
        except RebarDepthError as error:
            codes.extend(problem.code for problem in getattr(error, "problems", ()))
            raise

    before = workspace.snapshot()
    start_s, start_bytes = _cpu_s(), _reset_peak_memory()
    crash = ""
    try:
        finished = run_in_process(lambda _: run_command(run))
        status, stdout, stderr = finished.returncode, finished.stdout, finished.stderr
    except Exception:
        status, stdout, stderr, crash = 1, "", "", traceback.format_exc(limit=-8)
    return Observation(
        status=status,
        codes=tuple(dict.fromkeys(codes)),
        stdout=stdout,
        stderr=stderr,
        crash=crash,
        cpu_s=_cpu_s() - start_s,
        peak_bytes=_peak_memory() - start_bytes,
        changed=tuple(changes(before, workspace.snapshot())),
    )


def failures(seen: Observation, expected: Expectation) -> list[str]:
    """Return the violated properties, each as ``kind: detail``."""
    output = seen.stdout + seen.stderr
    outside = [path for path in seen.changed if not _may_change(path, expected.may_change)]
    written = [path.removeprefix(f"{OUT}/") for path in seen.changed if path.startswith(f"{OUT}/")]
    partial = [name for name in written if not any(fnmatchcase(name, kept) for kept in expected.kept_outputs)]
    refused = not seen.crash and seen.status == EXIT_INPUT
    controls = sorted({character for character in output if not character.isprintable() and character != "\n"})
    checks = {
        "traceback": seen.crash or ("Traceback" in output and output[-2000:]),
        "status": not seen.crash and seen.status not in expected.statuses and f"{seen.status}: {output[-300:]}",
        "time": seen.cpu_s > expected.cpu_s and f"{seen.cpu_s:.1f} s of processor time",
        "memory": seen.peak_bytes > MEMORY_LIMIT_BYTES and f"{seen.peak_bytes >> 20} MiB",
        "outside": outside and ", ".join(outside[:5]),
        "partial output": seen.status != EXIT_DONE and partial and ", ".join(partial[:5]),
        "control characters": controls and ascii("".join(controls[:9])),
        "long output": len(output) > MAX_OUTPUT_CHARACTERS and f"{len(output)} characters",
        "long line": any(len(line) > MAX_LINE_CHARACTERS for line in output.splitlines()) and output[:200],
        "warning": re.search(r":[0-9]+: \w*Warning: ", seen.stderr) and seen.stderr[-500:],
        "no file name": refused and not any(name in seen.stderr for name in expected.names) and seen.stderr[:300],
    }
    return [f"{kind}: {detail}" for kind, detail in checks.items() if detail]


def _may_change(path: str, patterns: Sequence[str]) -> bool:
    """Return whether a path is an output, is in the user's cache or matches a pattern."""
    return path.startswith((f"{OUT}/", f"{CACHE}/")) or any(fnmatchcase(path, pattern) for pattern in patterns)


def _cpu_s() -> float:
    """Return the processor time of this process and its finished children."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _reset_peak_memory() -> int:
    """Let the peak begin at the present resident memory, bytes, and return that."""
    Path("/proc/self/clear_refs").write_text("5")
    return _peak_memory()


def _peak_memory() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * _KIB
