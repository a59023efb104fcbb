"""Special files in place of an input: pipes, devices, folders, links, and empty, huge or missing files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

HUGE_BYTES = 1 << 30


def replace_by_special_file(path: Path, kind: str, elsewhere: Path) -> None:
    """Replace a file by a special one of ``kind``; ``elsewhere`` is a folder for the file and targets of links."""
    elsewhere.mkdir(exist_ok=True)
    shutil.move(path, elsewhere / path.name)
    SPECIAL_FILES[kind](path, elsewhere)


def _link_to_pipe(path: Path, elsewhere: Path) -> None:
    os.mkfifo(elsewhere / "pipe")
    path.symlink_to(elsewhere / "pipe")


def _huge_file(path: Path, elsewhere: Path) -> None:
    shutil.copy(elsewhere / path.name, path)
    os.truncate(path, path.stat().st_size + HUGE_BYTES)


SPECIAL_FILES: Mapping[str, Callable[[Path, Path], object]] = {
    "missing": lambda *_: None,
    "empty": lambda path, _: path.touch(),
    "folder": lambda path, _: path.mkdir(),
    "pipe": lambda path, _: os.mkfifo(path),
    "link to a pipe": _link_to_pipe,
    "link to /dev/zero": lambda path, _: path.symlink_to("/dev/zero"),
    "link to itself": lambda path, _: path.symlink_to(path.name),
    "link to nothing": lambda path, elsewhere: path.symlink_to(elsewhere / "nothing"),
    "link to a folder": lambda path, elsewhere: path.symlink_to(elsewhere),
    "link to the file": lambda path, elsewhere: path.symlink_to(elsewhere / path.name),
    "huge": _huge_file,
}
"""Functions that make a special file, by its kind."""
