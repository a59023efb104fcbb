"""Folder of the ground-truth cache: its place, its size limit and the removal of its files.

It lies in the user's cache directory and holds one file for each entry. A file is deleted only if it is a regular
file with a name of the cache's own pattern, in a folder that is not a link.
"""

from __future__ import annotations

import functools
import os
import re
import stat
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.limits import CACHE_BYTES
from rebar_depth_bench.reading import check_no_links, remove_file

FOLDER_NAME = "rebar-depth-bench"
ENTRY_SUFFIX, UNFINISHED_SUFFIX = ".truth", ".tmp"
_ENTRY = re.compile(r"[0-9a-f]{64}\.truth")
_UNFINISHED = re.compile(r"[0-9a-f]{64}\.truth\.\w+\.tmp")
_ABANDONED_AFTER_S = 24 * 3600


class CacheFolderError(InputError):
    """Cache folder whose place is unknown, or that is a symbolic link."""


@dataclass(frozen=True, slots=True)
class CacheFile:
    """File of the cache; ``used_s`` is the time of its last use, seconds since 1970."""

    path: Path
    size_bytes: int
    used_s: float


def cache_folder() -> Path:
    """Return the user's cache folder, which may be missing: it lies in ``XDG_CACHE_HOME`` or else ``~/.cache``.

    Raises ``CacheFolderError`` if there is no home folder or the cache folder is a symbolic link.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        parent = given if given.is_absolute() else Path.home() / ".cache"
        check_no_links(parent, FOLDER_NAME)
    except RuntimeError:
        raise CacheFolderError("the home folder is unknown, expected it in HOME or XDG_CACHE_HOME") from None
    except (InputError, OSError) as error:
        raise CacheFolderError(str(error)) from None
    return parent / FOLDER_NAME


def temporary_folder() -> Path:
    """Return the private folder of this process, created at the first call and deleted when the process ends."""
    return Path(_temporary_folder().name)


@functools.cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix=f"{FOLDER_NAME}-")


def entries(folder: Path) -> list[CacheFile]:
    """Return the entries of a cache folder, the least recently used first."""
    return _files(folder, _ENTRY)


def clear(folder: Path) -> list[CacheFile]:
    """Delete all entries of a cache folder and the files of unfinished ones, and return them.

    Raises ``OSError`` if a file cannot be deleted.
    """
    files = _files(folder, _UNFINISHED) + entries(folder)
    for file in files:
        remove_file(file.path)
    return files


def limit_size(folder: Path) -> None:
    """Delete the least recently used entries beyond the size limit, and the files that killed processes left."""
    kept, now_s = entries(folder), time.time()
    removed = [file for file in _files(folder, _UNFINISHED) if now_s - file.used_s > _ABANDONED_AFTER_S]
    while total_bytes(kept) > CACHE_BYTES.value():
        removed.append(kept.pop(0))
    for file in removed:
        with suppress(OSError):
            remove_file(file.path)


def total_bytes(files: Iterable[CacheFile]) -> int:
    """Return the sum of the sizes of files."""
    return sum(file.size_bytes for file in files)


def _files(folder: Path, pattern: re.Pattern[str]) -> list[CacheFile]:
    """Return the regular files whose names match, the least recently used first; none if the folder is missing."""
    files = []
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):  # Another process may delete files.
                status = path.lstat()
                if pattern.fullmatch(path.name) and stat.S_ISREG(status.st_mode):
                    files.append(CacheFile(path, status.st_size, status.st_mtime))
    return sorted(files, key=lambda file: (file.used_s, file.path))
