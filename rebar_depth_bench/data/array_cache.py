"""Cache of per-view arrays in the user's cache folder: opened, filled and repaired."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path

from rebar_depth_bench.data.cache_entry import (
    DAMAGE,
    CacheContent,
    Entry,
    ViewArrays,
    entry_in_memory,
    read_entry,
    write_entry,
)
from rebar_depth_bench.data.cache_folder import (
    UNFINISHED_SUFFIX,
    CacheFolderError,
    cache_folder,
    limit_size,
    temporary_folder,
)
from rebar_depth_bench.errors import DatasetError, terminal_text
from rebar_depth_bench.limits import CACHE_BYTES


class ArrayCache:
    """Views of an entry, in the order of its content; a damaged entry is written again, with a warning."""

    def __init__(self, content: CacheContent, entry: Entry) -> None:
        self._content, self._entry, self._lock = content, entry, threading.Lock()

    def __len__(self) -> int:
        return len(self.view_ids)

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return self._content.view_ids

    @property
    def numbers(self) -> tuple[tuple[float, ...], ...]:
        """Numbers of each view, in order."""
        entry = self._entry
        return tuple(entry.index.numbers[entry.positions[view_id]] for view_id in self.view_ids)

    def view(self, position: int) -> ViewArrays:
        """Read the view at ``position`` as read-only arrays; thread-safe.

        Raises ``DatasetError`` if the entry is damaged and cannot be written again.
        """
        entry, view_id = self._entry, self.view_ids[position]
        try:
            return entry.view(view_id)
        except DAMAGE as error:
            damage = error
        with self._lock:  # The first of several threads writes the entry.
            if self._entry is entry:
                _warn_of_damage(entry.path, damage)
                self._entry = _open(self._content, anew=True)
        try:
            return self._entry.view(view_id)
        except DAMAGE as error:
            message = f"{self._entry.path}: the cache is damaged again after it was written: {_reason(error)}"
            raise DatasetError(message) from None


def open_cache(content: CacheContent) -> ArrayCache:
    """Open the entry of ``content``; if it is missing or damaged, it is written first, one view at a time.

    If the user's cache folder cannot be used, the entry is kept in a temporary folder until this process ends; if
    that cannot be written either, in memory. A cache that cannot be written never fails a score. Raises
    ``DatasetError`` if a view is out of range or missing.
    """
    return ArrayCache(content, _open(content))


def _open(content: CacheContent, *, anew: bool = False) -> Entry:
    """Return the entry of ``content``, written first if it is missing or damaged, or if ``anew`` is set."""
    CACHE_BYTES.value()  # An invalid variable is reported before the work.
    try:
        return _open_in(cache_folder(), content, anew)
    except CacheFolderError as error:
        reason = str(error)
    except OSError as error:
        reason = f"{error.filename or cache_folder()}: {_reason(error)}"
    _warn_once(f"ground truth is cached for this run only, in a temporary folder: {reason}")
    try:
        return _open_in(temporary_folder(), content, anew)
    except OSError as error:
        _warn_once(f"ground truth is kept in memory, since no temporary file can be written: {_reason(error)}")
    try:
        return entry_in_memory(content)
    except ValueError as error:
        raise DatasetError(f"ground truth cannot be cached: {_reason(error)}") from None


def _open_in(folder: Path, content: CacheContent, anew: bool) -> Entry:
    """Return an entry as ``_open`` does. Raises ``OSError`` if it cannot be written to ``folder``."""
    path = folder / content.file_name
    if not anew and os.path.lexists(path):
        try:
            entry = read_entry(path, path, content)
        except FileNotFoundError:  # Another process has just deleted it.
            pass
        except DAMAGE as error:
            _warn_of_damage(path, error)
        else:
            with suppress(OSError):
                os.utime(path)
            return entry
    return _write(path, content)


def _write(path: Path, content: CacheContent) -> Entry:
    """Write an entry and return it open. It appears complete or not at all, without locks between processes."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    prefix = f"{path.name}."
    descriptor, name = tempfile.mkstemp(prefix=prefix, suffix=UNFINISHED_SUFFIX, dir=path.parent)
    unfinished = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            write_entry(file, content)
        try:
            entry = read_entry(unfinished, path, content)
        except (EOFError, ValueError) as error:
            raise OSError(errno.EIO, f"the written file is damaged: {_reason(error)}", path) from None
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    limit_size(path.parent)
    if not path.exists():
        limit = f"at most {CACHE_BYTES.value()} bytes ({CACHE_BYTES.variable})"
        _warn_once(f"{path}: {entry.source.size} bytes are not kept, expected a cache of {limit}")
    return entry


def _reason(error: Exception) -> str:
    return f"{getattr(error, 'strerror', None) or error}".partition("\n")[0]


def _warn_of_damage(path: Path, error: Exception) -> None:
    _warn(f"{path}: the cache is damaged and is written again: {_reason(error)}")


@cache
def _warn_once(message: str) -> None:
    _warn(message)


def _warn(message: str) -> None:
    sys.stderr.write(f"warning: {terminal_text(message)}\n")  # In one call, so that threads do not mix lines.
    sys.stderr.flush()
