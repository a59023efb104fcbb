"""Damaged inputs of every entry point: accepted or refused with a message, within limits and without side effects.

``python -m tests.fuzz`` runs more of these cases, and one of them again.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError, Problem, RebarDepthError
from tests.fuzz.cases import ENTRY_POINTS, number_of_cases
from tests.fuzz.oracle import CPU_LIMIT_S, Expectation, failures, observe
from tests.fuzz.worker import Worker
from tests.fuzz.workspace import Workspace

SEED = 0
QUICK_CASES = 100
NUMBERS = {
    name: max(number, QUICK_CASES if ENTRY_POINTS[name].is_quick else 0)
    for name, number in number_of_cases(300, list(ENTRY_POINTS)).items()
}
EXPECTED = Expectation(names=("a.json",))


@pytest.fixture(scope="module")
def worker() -> Iterator[Worker]:
    """Start the process that runs the cases."""
    with Worker() as process:
        yield process


@pytest.mark.slow
@pytest.mark.parametrize("entry", ENTRY_POINTS)
def test_damaged_input_is_accepted_or_refused(entry: str, worker: Worker) -> None:
    outcomes = [worker.run(entry, SEED, case) for case in range(NUMBERS[entry])]
    failed = [outcome for outcome in outcomes if outcome.failures]
    assert not failed, "\n".join(f"{outcome.command}: {outcome.damage}: {outcome.failures}" for outcome in failed)
    if ENTRY_POINTS[entry].is_quick:
        assert sum(outcome.kind == "refused" for outcome in outcomes) > QUICK_CASES // 10


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["depth: npy", "depth: npz", "depth: EXR", "depth: PNG", "import: TIFF", "import: PFM"]
)
def test_depth_map_is_refused_or_read_wherever_it_ends(name: str, workspace: Workspace) -> None:
    entry = ENTRY_POINTS[name]
    entry.prepare(workspace)
    [path] = entry.files(workspace.root)
    sound = path.read_bytes()
    expected = Expectation(names=(path.name,))
    for end in range(len(sound)):
        path.write_bytes(sound[:end])
        assert failures(observe(lambda: entry.run(workspace), workspace), expected) == [], end
        (workspace.out / "result").unlink(missing_ok=True)


def _write_and_refuse(path: Path) -> None:
    path.write_text("half of it")
    raise InputError("a.json: cannot be read")


def _raise(error: Exception) -> None:
    raise error


def _allocate(size_bytes: int) -> None:
    assert np.ones(size_bytes, np.uint8)[-1]


VIOLATIONS: dict[str, Callable[[Workspace], object]] = {
    "traceback": lambda _: _raise(ValueError("no number")),
    "status": lambda _: _raise(RebarDepthError("a.json: not the fault of the input")),
    "memory": lambda _: _allocate(400 << 20),
    "outside": lambda work: (work.case / "victim" / "notes.txt").unlink(),
    "partial output": lambda work: _write_and_refuse(work.out / "r.json"),
    "control characters": lambda _: print("\x1b[2J"),
    "long output": lambda _: print("a\n" * 30_000),
    "long line": lambda _: print("a" * 1_001),
    "warning": lambda _: print("a.py:7: RuntimeWarning: divide by zero", file=sys.stderr),
    "no file name": lambda _: _raise(InputError("it cannot be read")),
}


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    made = Workspace(tmp_path / "work")
    made.make()
    return made


@pytest.mark.slow
@pytest.mark.parametrize("kind", VIOLATIONS)
def test_violated_property_is_found(kind: str, workspace: Workspace) -> None:
    seen = observe(lambda: VIOLATIONS[kind](workspace), workspace)
    assert [failure.partition(":")[0] for failure in failures(seen, EXPECTED)] == [kind]


def test_sound_actions_have_no_failure(workspace: Workspace) -> None:
    refused = observe(lambda: _raise(InputError.from_problems("a.json", [Problem("syntax", "", "x")])), workspace)
    accepted = observe(lambda: (workspace.out / "r.json").write_text("{}"), workspace)
    assert (refused.status, refused.codes, accepted.status) == (2, ("syntax",), 0)
    assert failures(refused, EXPECTED) == failures(accepted, EXPECTED) == []
    slow = replace(accepted, cpu_s=CPU_LIMIT_S + 1)
    assert failures(slow, EXPECTED) == [f"time: {CPU_LIMIT_S + 1:.1f} s of processor time"]


@pytest.mark.slow
def test_dead_and_hanging_workers_fail_the_case() -> None:
    with Worker() as worker, Worker(hang_s=0.01) as slow_worker:
        first = worker.run("calibration: TOML", 1, 2)
        assert worker.process is not None
        os.kill(worker.process.pid, signal.SIGKILL)
        crashed = worker.run("calibration: TOML", 1, 2)
        again = worker.run("calibration: TOML", 1, 2)
        hanging = slow_worker.run("calibration: TOML", 1, 2)
    assert replace(first, cpu_s=0, peak_mib=0, stderr="") == replace(again, cpu_s=0, peak_mib=0, stderr="")
    assert crashed.failures[0].startswith("crash: exit status -9")
    assert hanging.failures[0].startswith("hang: ")
