"""Folders of one fuzz case: inputs, outputs, home and bystanders, and what changed in them.

::

    work/               everything that a case may see
      home/             HOME, with the user's cache in .cache
      victim/notes.txt  bystander; others are below a/ and b/
      a/b/case/         inputs of the entry point, its working folder
      a/b/case/out/     outputs

The inputs lie deep enough that names with ``..`` end at a bystander and not outside.
"""

from __future__ import annotations

import os
import shutil
import stat
from dataclasses import dataclass
from pathlib import Path

HOME, CASE, OUT, ELSEWHERE = "home", "a/b/case", "a/b/case/out", "elsewhere"
CACHE = f"{HOME}/.cache"
_BYSTANDERS = tuple(f"{folder}victim" for folder in ("", "a/", "a/b/", f"{HOME}/", f"{CASE}/"))

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
        """Write the folders and the bystanders, without inputs."""
        shutil.rmtree(self.root, ignore_errors=True)
        for folder in (OUT, CACHE, *_BYSTANDERS):
            (self.root / folder).mkdir(parents=True)
        for folder in _BYSTANDERS:
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
