"""Small disks (tmpfs) that tests fill or make read-only; mounting needs the rights of root."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class SmallDisk:
    """Mounted disk; ``root`` is its folder."""

    root: Path

    def resize(self, size_bytes: int) -> None:
        """Change the size to a multiple of 4096 bytes."""
        self._remount(f"size={size_bytes}")

    def make_read_only(self) -> None:
        """Refuse all writes from now on."""
        self._remount("ro")

    def _remount(self, options: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{options}", self.root], check=True)

    def files(self) -> set[str]:
        """Return the paths of all files, relative to the root."""
        return {str(path.relative_to(self.root)) for path in self.root.rglob("*") if path.is_file()}


NewDisk = Callable[[int], SmallDisk]
"""Function that mounts a disk of a number of bytes."""


@contextmanager
def mounted_disks(folder: Path) -> Iterator[NewDisk]:
    """Yield a function that mounts disks below ``folder``; skip the test where mounting is not permitted."""
    disks: list[Path] = []

    def new_disk(size_bytes: int) -> SmallDisk:
        root = folder / f"disk-{len(disks)}"
        root.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size_bytes}", "none", str(root)]
        finished = subprocess.run(command, capture_output=True, text=True, check=False)
        if finished.returncode:
            pytest.skip(f"a small disk cannot be mounted here: {finished.stderr.strip()}")
        disks.append(root)
        return SmallDisk(root)

    try:
        yield new_disk
    finally:
        for root in disks:
            subprocess.run(["umount", root], check=True)
