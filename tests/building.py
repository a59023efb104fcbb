"""``rebar-build`` as the tests run it: in a process of its own, finished or under way."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from dataset_builder.pipeline.plan import BUILD_FOLDER

TINY = ("--width", "160", "--height", "90", "--samples", "1")
TINY_VIEWS = 9
"""One more than a shard holds."""
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
    children = [child for task in tasks_of(pid) for child in children_of(task)]
    return [int(child) for child in children if b"dataset_builder.blender" in command_line(child)]


def tasks_of(pid: int) -> list[Path]:
    try:
        return list(Path(f"/proc/{pid}/task").iterdir())
    except OSError:
        return []  # it has ended


def children_of(task: Path) -> list[str]:
    try:
        return (task / "children").read_text().split()
    except OSError:
        return []  # threads come and go


def command_line(pid: str) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""  # it has ended


def staged_rows(root: Path) -> int:
    return len(list(root.glob(f"{BUILD_FOLDER}/*/rows/????.parquet")))


def wait_until(condition: Callable[[], object], timeout_s: float = 120) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.02)


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
