"""Known hostile inputs of each command, in a process of its own."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.cases import work_folder
from tests.fuzz.dataset_entries import write_dataset_and_archive
from tests.fuzz.known_cases import KNOWN_CASES, KnownCase
from tests.fuzz.oracle import Expectation, Observation, failures
from tests.fuzz.workspace import CASE, Workspace, changes

PROJECT = Path(__file__).parents[2]
TIMEOUT_S = 120.0
MEMORY_BYTES = 3 << 30
LIMITS = {"REBAR_MAX_IFC_SECONDS": "8", "REBAR_MAX_IFC_MEMORY_BYTES": str(1 << 30)}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Save a work folder with the tiny dataset and an archive."""
    folder = tmp_path_factory.mktemp("sound")
    workspace = Workspace(folder / "work")
    workspace.make()
    write_dataset_and_archive(workspace)
    return workspace.root


@pytest.mark.slow
@pytest.mark.parametrize("known", KNOWN_CASES, ids=lambda known: known.name)
def test_hostile_input_is_refused(known: KnownCase, sound: Path, tmp_path: Path) -> None:
    workspace = Workspace(work_folder(tmp_path))
    workspace.restore(sound)
    arguments = known.prepare(workspace)
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    before = workspace.snapshot()
    environment = {**os.environ, **workspace.environment(temporary), **LIMITS, "PYTHONPATH": str(PROJECT)}
    start_s = _children_cpu_s()
    process = subprocess.run(
        [sys.executable, "-P", "-m", known.program, *map(str, arguments)],
        cwd=workspace.case,
        env=environment,
        preexec_fn=_limit_memory,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    seen = Observation(
        status=process.returncode,
        codes=(),
        stdout=process.stdout,
        stderr=process.stderr,
        crash="",
        cpu_s=_children_cpu_s() - start_s,
        peak_bytes=0,  # The limit of the process shows an excess as a traceback.
        changed=tuple(changes(before, workspace.snapshot())),
    )
    names = (CASE, str(workspace.root), "settings: ")
    assert failures(seen, Expectation(known.statuses, names, known.kept_outputs)) == []
    assert list(temporary.iterdir()) == []


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
