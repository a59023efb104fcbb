"""Cache of ground truth: per-view arrays in the user's cache folder, written and read one view at a time.

An entry is one file: the values of each view as a block of raw arrays, then an index in JSON, its SHA-256 and its
length. The index holds the entry's key, the ids of the views, the number of values and the CRC-32 of each block,
and further numbers of each view, so every byte of the file is covered by a checksum. The key is a digest of
everything that the values depend on.

A file is deleted only if it is a regular file with a name of the cache's own pattern, in a folder that is no link.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import re
import stat
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy import ndarray
from zlib_ng import zlib_ng

from rebar_depth_bench.data.files import parameters_digest
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.limits import CACHE_BYTES
from rebar_depth_bench.reading import ByteSource, FileSource, MemorySource, check_no_links, remove_file
from rebar_depth_bench.terminal import print_notice
from rebar_depth_bench.validation import StrictModel

FOLDER_NAME = "rebar-depth-bench"
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


@cache
def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """Return the private folder of this process, created at the first call and deleted when the process ends."""
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


_FORMAT = "rebar-cache-2"
_ALIGNMENT = 8
_TRAILER = struct.Struct("<32sQ")
"""SHA-256 of the index and its length in bytes."""
_MAX_INDEX_BYTES_PER_VIEW = 4096
_DAMAGED = "the cache is damaged and is written again"
_DAMAGE = (OSError, EOFError, ValueError)
"""Errors of reading a damaged entry."""


@dataclass(frozen=True, eq=False)
class ViewArrays:
    """Cached data of one view: named 1-D arrays of equal length, and a few numbers."""

    view_id: str
    arrays: Mapping[str, ndarray]
    numbers: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class CacheContent:
    """Content of an entry and how it is made.

    ``inputs``, a value of JSON, contains everything that the arrays depend on. ``view_ids`` are those of the views
    that ``extract`` yields in any order; ``is_sound`` returns whether the data of a view are in their range.
    ``source`` is the dataset, for messages.
    """

    source: str
    inputs: Mapping[str, Any]
    dtypes: Mapping[str, type]
    view_ids: tuple[str, ...]
    extract: Callable[[], Iterator[ViewArrays]]
    is_sound: Callable[[ViewArrays], bool]

    @cached_property
    def key(self) -> str:
        """Hex digest that identifies the entry."""
        arrays = [[name, np.dtype(dtype).str] for name, dtype in self.dtypes.items()]
        return parameters_digest({"format": _FORMAT, "arrays": arrays, "inputs": self.inputs})

    @property
    def file_name(self) -> str:
        """Name of the entry's file."""
        return f"{self.key}.truth"

    def block_bytes(self, count: int) -> int:
        """Return the size of a block with ``count`` values in each array."""
        return sum(_aligned(count * np.dtype(dtype).itemsize) for dtype in self.dtypes.values())


class _Index(StrictModel):
    """Index of an entry: one element per view, in the order of the blocks."""

    key: str
    view_ids: tuple[str, ...]
    counts: tuple[int, ...]
    checksums: tuple[int, ...]
    numbers: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, eq=False)
class _Entry:
    """Open entry. Its file stays open, so it remains readable while another process deletes or replaces it."""

    path: Path
    content: CacheContent
    source: ByteSource
    index: _Index
    starts: tuple[int, ...]
    positions: Mapping[str, int]

    def view(self, view_id: str) -> ViewArrays:
        """Return the arrays of a view, read-only. Raises one of ``_DAMAGE``."""
        position = self.positions[view_id]
        start, count = self.starts[position], self.index.counts[position]
        block = self.source.read_at(start, self.starts[position + 1] - start)
        if zlib_ng.crc32(block) != self.index.checksums[position]:
            raise ValueError(f"the values of {view_id} do not match their checksum")
        arrays: dict[str, ndarray] = {}
        offset = 0
        for name, dtype in self.content.dtypes.items():
            arrays[name] = np.frombuffer(block, dtype, count, offset)
            offset += _aligned(arrays[name].nbytes)
        view = ViewArrays(view_id, arrays, self.index.numbers[position])
        if not self.content.is_sound(view):
            raise ValueError(f"the values of {view_id} are out of range")
        return view


def _write_entry(file: BinaryIO, content: CacheContent) -> None:
    """Extract the views of an entry and write them. Raises ``DatasetError`` if a view is out of range."""
    rows = []
    for view in content.extract():
        arrays: dict[str, ndarray] = {
            name: np.ascontiguousarray(view.arrays[name], dtype) for name, dtype in content.dtypes.items()
        }
        if not content.is_sound(ViewArrays(view.view_id, arrays, view.numbers)):
            raise DatasetError(f"{content.source}: the ground truth of view {view.view_id} is out of range")
        count, checksum = 0, 0
        for array in arrays.values():
            values = array.tobytes()
            block = values + bytes(_aligned(len(values)) - len(values))
            file.write(block)
            count, checksum = len(array), zlib_ng.crc32(block, checksum)
        rows.append((view.view_id, count, checksum, view.numbers))
    view_ids, counts, checksums, numbers = zip(*rows, strict=True) if rows else ((), (), (), ())
    index = _Index(key=content.key, view_ids=view_ids, counts=counts, checksums=checksums, numbers=numbers)
    encoded = index.model_dump_json().encode()
    file.write(encoded + _TRAILER.pack(hashlib.sha256(encoded).digest(), len(encoded)))


def _entry_in_memory(content: CacheContent) -> _Entry:
    """Return an entry that is in no file.

    Raises ``DatasetError`` if a view is out of range, and ``ValueError`` if views are missing.
    """
    file = io.BytesIO()
    _write_entry(file, content)
    return _read_source(MemorySource(file.getbuffer()), Path("the cache in memory"), content)


def _read_entry(file: Path, path: Path, content: CacheContent) -> _Entry:
    """Open ``file``, the entry that is or will be at ``path``; raise one of ``_DAMAGE`` if it is not sound."""
    if file.is_symlink() or not file.is_file():
        raise ValueError("it is not a regular file")
    return _read_source(FileSource(file), path, content)


def _read_source(source: ByteSource, path: Path, content: CacheContent) -> _Entry:
    end = source.size - _TRAILER.size
    digest, length = _TRAILER.unpack(source.read_at(end, _TRAILER.size))
    if length > _MAX_INDEX_BYTES_PER_VIEW * (len(content.view_ids) + 1):
        raise ValueError("its index is too large")
    encoded = bytes(source.read_at(end - length, length))
    if hashlib.sha256(encoded).digest() != digest:
        raise ValueError("its index does not match its checksum")
    index = _Index.model_validate_json(encoded)
    starts = tuple(accumulate(map(content.block_bytes, index.counts), initial=0))
    columns = {len(index.view_ids), len(index.checksums), len(index.numbers), len(starts) - 1}
    if len(columns) > 1 or min(index.counts, default=0) < 0 or starts[-1] != end - length:
        raise ValueError("its index is inconsistent")
    positions = {view_id: position for position, view_id in enumerate(index.view_ids)}
    if index.key != content.key or sorted(index.view_ids) != sorted(content.view_ids):
        raise ValueError("it holds other views")
    return _Entry(path, content, source, index, starts, positions)


def _aligned(size_bytes: int) -> int:
    return -(-size_bytes // _ALIGNMENT) * _ALIGNMENT


class ArrayCache:
    """Views of an entry, in the order of its content; a damaged entry is written again, with a warning."""

    def __init__(self, content: CacheContent, entry: _Entry) -> None:
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
        except _DAMAGE as error:
            damage = error
        with self._lock:  # The first of several threads writes the entry.
            if self._entry is entry:
                _warn(f"{entry.path}: {_DAMAGED}: {_reason(damage)}")
                self._entry = _open(self._content, anew=True)
        try:
            return self._entry.view(view_id)
        except _DAMAGE as error:
            found = f"the cache is damaged again after it was written: {_reason(error)}"
            raise DatasetError(f"{self._entry.path}: {found}") from None


def open_cache(content: CacheContent) -> ArrayCache:
    """Open the entry of ``content``; if it is missing or damaged, it is written first, one view at a time.

    If the user's cache folder cannot be used, the entry is kept in a temporary folder until this process ends; if
    that cannot be written either, in memory. A cache that cannot be written never fails a score. Raises
    ``DatasetError`` if a view is out of range or missing.
    """
    return ArrayCache(content, _open(content))


def _open(content: CacheContent, *, anew: bool = False) -> _Entry:
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
        return _open_in(Path(_temporary_folder().name), content, anew)
    except OSError as error:
        _warn_once(f"ground truth is kept in memory, since no temporary file can be written: {_reason(error)}")
    try:
        return _entry_in_memory(content)
    except ValueError as error:
        raise DatasetError(f"ground truth cannot be cached: {_reason(error)}") from None


def _open_in(folder: Path, content: CacheContent, anew: bool) -> _Entry:
    """Return an entry as ``_open`` does. Raises ``OSError`` if it cannot be written to ``folder``."""
    path = folder / content.file_name
    if not anew and os.path.lexists(path):
        try:
            entry = _read_entry(path, path, content)
        except FileNotFoundError:  # Another process has just deleted it.
            pass
        except _DAMAGE as error:
            _warn(f"{path}: {_DAMAGED}: {_reason(error)}")
        else:
            with suppress(OSError):
                os.utime(path)
            return entry
    return _write(path, content)


def _write(path: Path, content: CacheContent) -> _Entry:
    """Write an entry and return it open. It appears complete or not at all, without locks between processes."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(".tmp", f"{path.name}.", path.parent)
    unfinished = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            _write_entry(file, content)
        try:
            entry = _read_entry(unfinished, path, content)
        except (EOFError, ValueError) as error:
            raise OSError(errno.EIO, f"the written file is damaged: {_reason(error)}", path) from None
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
    limit_size(path.parent)
    if not path.exists():
        limit = f"{CACHE_BYTES.value()} bytes ({CACHE_BYTES.variable})"
        _warn_once(f"{path}: {entry.source.size} bytes are not kept, expected a cache of at most {limit}")
    return entry


def _reason(error: Exception) -> str:
    return f"{getattr(error, 'strerror', None) or error}".partition("\n")[0]


@cache
def _warn_once(message: str) -> None:
    _warn(message)


def _warn(message: str) -> None:
    print_notice(f"warning: {message}")
