"""Entry points of the fuzz tests, and the folders of one case: inputs, outputs, home and files of others.

::

    work/               everything that a case may see
      home/             HOME, with the user's cache in .cache
      victim/notes.txt  file of others; more are below a/ and b/
      a/b/case/         inputs of the entry point, its working folder
      a/b/case/out/     outputs

The inputs lie deep enough that names with ``..`` end at a file of others and not outside.
"""

from __future__ import annotations

import argparse
import os
import shutil
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rebar_depth_bench.cli.console import EXIT_DONE, EXIT_INPUT, check_outputs
from rebar_depth_bench.cli.main import argument_parser

HOME, CASE, OUT, ELSEWHERE = "home", "a/b/case", "a/b/case/out", "elsewhere"
CACHE = f"{HOME}/.cache"
_OF_OTHERS = tuple(f"{folder}victim" for folder in ("", "a/", "a/b/", f"{HOME}/", f"{CASE}/"))

Snapshot = dict[str, tuple[int, int, int, str]]
"""Type, size, time of change and link target of every path below a folder; size and time of files only."""


@dataclass(frozen=True)
class Workspace:
    """Work folder; ``make`` writes it anew and ``restore`` copies one that was saved."""

    root: Path

    @property
    def case(self) -> Path:
        """Folder of the inputs."""
        return self.root / CASE

    @property
    def out(self) -> Path:
        """Folder of the outputs."""
        return self.root / OUT

    def make(self) -> None:
        """Write the folders and the files of others, without inputs."""
        shutil.rmtree(self.root, ignore_errors=True)
        for folder in (OUT, CACHE, *_OF_OTHERS):
            (self.root / folder).mkdir(parents=True)
        for folder in _OF_OTHERS:
            (self.root / folder / "notes.txt").write_text("Not to be changed.\n")

    def environment(self, temporary: Path) -> dict[str, str]:
        """Return the variables that place home, caches and temporary files; the latter lie outside."""
        home, cache = self.root / HOME, self.root / CACHE
        folders = {"HOME": home, "XDG_CACHE_HOME": cache, "HF_HOME": cache / "huggingface", "TMPDIR": temporary}
        return {name: str(path) for name, path in folders.items()}

    def save(self, folder: Path) -> None:
        """Copy the work folder to ``folder``, which is replaced."""
        _copy(self.root, folder)

    def restore(self, folder: Path) -> None:
        """Replace the work folder by a saved one."""
        _copy(folder, self.root)

    def snapshot(self) -> Snapshot:
        """Return the state of every path."""
        return {
            path.relative_to(self.root).as_posix(): _state(path)
            for folder, names, files in os.walk(self.root)
            for path in (Path(folder, name) for name in (*names, *files))
        }


def changes(before: Snapshot, after: Snapshot) -> list[str]:
    """Return the paths that were created, deleted or changed, sorted."""
    return sorted(path for path in before.keys() | after.keys() if before.get(path) != after.get(path))


def _copy(source: Path, target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, symlinks=True)


def _state(path: Path) -> tuple[int, int, int, str]:
    status = path.lstat()
    kind = stat.S_IFMT(status.st_mode)
    if stat.S_ISREG(kind):
        return kind, status.st_size, status.st_mtime_ns, ""
    return kind, 0, 0, str(path.readlink()) if stat.S_ISLNK(kind) else ""


@dataclass(frozen=True)
class EntryPoint:
    """Entry point under test.

    ``prepare`` writes sound inputs into the folder of a workspace and may run commands; ``run`` reads them and
    raises ``RebarDepthError`` for unsound ones. ``targets`` are glob patterns, below the work folder, of the files
    to damage. ``share`` is its share of the cases of a run. If it ``is_quick``, it reads one file within
    milliseconds, and ``make test`` runs at least 100 of its cases. ``cpu_s`` is the allowed processor time.

    ``result`` returns what an accepted case has found. It equals that of the sound inputs in every case if a
    digest covers the targets (``covered``), and in cases with a truncated file if the format of the targets
    ``shows_truncation``. ``check`` examines the outputs of an accepted case and raises ``AssertionError``.

    ``statuses`` are the allowed exit statuses, ``kept_outputs`` patterns of outputs that may stay after a failure,
    and ``may_change`` patterns of other paths that may change. Without ``special_files`` only content is damaged.
    """

    name: str
    share: int
    prepare: Callable[[Workspace], object]
    run: Callable[[Workspace], object]
    targets: Sequence[str]
    result: Callable[[Workspace], bytes] | None = None
    is_quick: bool = False
    cpu_s: float = 10.0
    covered: bool = False
    shows_truncation: bool = False
    check: Callable[[Workspace], object] | None = None
    statuses: Sequence[int] = (EXIT_DONE, EXIT_INPUT)
    kept_outputs: Sequence[str] = ()
    may_change: Sequence[str] = ()
    special_files: bool = True
    names: Sequence[str] = ()

    def files(self, root: Path) -> list[Path]:
        """Return the files to damage below a work folder, sorted."""
        found = {path for pattern in self.targets for path in root.glob(pattern) if path.is_file()}
        assert found, f"{self.name}: no file matches {', '.join(self.targets)}"
        return sorted(found)


def bench(*arguments: str | Path) -> None:
    """Run ``rebar-bench`` with these arguments; unlike its ``main`` this raises the errors."""
    run_options(argument_parser(), *arguments)


def run_options(parser: argparse.ArgumentParser, *arguments: str | Path) -> None:
    """Run the command that a parser selects."""
    options = parser.parse_args([str(argument) for argument in arguments])
    check_outputs(vars(options))
    options.run(options)
