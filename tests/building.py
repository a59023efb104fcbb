"""``rebar-build`` as the tests run it: in a process of its own, finished or under way."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests.processes import processes_below

TINY = ("--width", "160", "--height", "90", "--quality", "preview")
"""Small pictures, rendered in two passes like those of the default quality."""
TINY_VIEWS = 9
"""One more than a shard holds."""
TINY_DATASET = Path(__file__).parent / "data" / "tiny"
"""Dataset folder of ``TINY_VIEWS`` views of the lattice and two of its orbit; its mesh is packed."""
TWO_BARS = Path(__file__).parent / "data" / "two-bars.toml"
"""Cage that renders in a third of the time of the lattice."""

RunBuild = Callable[..., subprocess.CompletedProcess[str]]
StartBuild = Callable[..., subprocess.Popen[bytes]]


def run_build(*arguments: str | Path, timeout_s: float = 3600) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-build`` to its end. Tests get this function as a fixture of the same name."""
    command = [sys.executable, "-m", "dataset_builder", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


def start_build(root: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start ``rebar-build`` in its own process group. Tests get this function as a fixture of the same name."""
    command = [sys.executable, "-m", "dataset_builder", "--out", str(root), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)


def render_processes_of(pid: int) -> list[int]:
    return processes_below(pid, b"dataset_builder.blender")


def staged_rows(root: Path) -> int:
    # Tests of the core run without the packages of the extra ``build``, which this import needs.
    from dataset_builder.pipeline.plan import BUILD_FOLDER

    return len(list(root.glob(f"{BUILD_FOLDER}/*/rows/????.parquet")))


def progressed_or_ended(root: Path, already: int, build: subprocess.Popen[bytes]) -> bool:
    return staged_rows(root) > already or build.poll() is not None


def contents(root: Path) -> dict[str, str]:
    """Return the SHA-256 of every file of a dataset folder, the scoring cache left out."""
    files = (path for path in root.rglob("*") if path.is_file())
    named = {path.relative_to(root).as_posix(): path for path in files}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in named.items()
        if not name.startswith(".")
    }
