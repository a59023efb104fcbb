"""Paths made of names from files: a name never leaves its folder, and writing and deleting never follow links.

Names are view ids, digests and names of configs, scenes, meshes and shards. The checks hold for folders that no
other process changes at the same time.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
from pathlib import Path, PurePosixPath

from rebar_depth_bench.errors import InputError, escape_text

NAME_PATTERN = "[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}"
"""Regular expression of a name, which is one part of a path: it cannot be hidden, ``..`` or empty."""
NAME_LETTERS = 'letters, digits, "_", "." and "-", not starting with a dot'
"""Description of ``NAME_PATTERN`` for messages."""
PATH_PATTERN = f"({NAME_PATTERN}/){{0,9}}{NAME_PATTERN}"
"""Regular expression of up to ten names that are joined by ``/``."""
VIEW_ID_PATTERN = f"{NAME_PATTERN}/{NAME_PATTERN}"
"""Regular expression of a view id, ``<config>/<index>``."""


def path_below(folder: Path, name: str) -> Path:
    """Return the path of ``name``, one or more names joined by ``/``, below ``folder``.

    Raises ``InputError`` for any other text, such as an absolute path or one with ``..``.
    """
    if not re.fullmatch(PATH_PATTERN, name):
        raise InputError(
            f"{folder}: {escape_text(name)} is not a path in this folder, expected names of {NAME_LETTERS}"
        )
    return folder / name


def is_below(path: str) -> bool:
    """Return whether a relative path from a file stays in its folder: it names no other files of the machine."""
    parts = PurePosixPath(path).parts
    return bool(parts) and path.isprintable() and ".." not in parts and not path.startswith(("/", "~"))


def check_no_links(folder: Path, *names: str) -> None:
    """Raise ``InputError`` if one of ``names`` below ``folder``, or a folder on the way to it, is a symbolic link.

    ``folder`` itself may be a link: the user named it.
    """
    for name in names:
        path = folder
        for part in Path(name).parts:
            path = path / part
            if path.is_symlink():
                raise InputError(
                    f"{path}: is a symbolic link, expected a file or folder (links are not followed here)"
                )


def remove_file(path: Path) -> None:
    """Delete a regular file; links, folders and missing files are left alone."""
    try:
        if stat.S_ISREG(os.lstat(path).st_mode):
            path.unlink()
    except FileNotFoundError:
        return


def remove_folder(path: Path) -> None:
    """Delete a folder with its content, without following links; a link or a missing folder is left alone."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
