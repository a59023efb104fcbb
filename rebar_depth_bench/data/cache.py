"""Cache of ground truth: per-view arrays in the user's cache folder, written and read one view at a time.

An entry is one file: the values of each view as a block of raw arrays, then an index in JSON, its SHA-256 and its
length. The index holds the entry's key and, for each view, the place and the CRC-32 of its block and further
numbers, so every byte of the file is covered by a checksum. The key is a digest of everything that the values
depend on. A view that cannot be read from the cache is computed.

A file is deleted only if it is a regular file with a name of the cache's own pattern, in a folder that is no link.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy import ndarray
from pydantic import Field
from zlib_ng import zlib_ng

from rebar_depth_bench.base.errors import DatasetError, InputError, OutputError
from rebar_depth_bench.base.limits import CACHE_BYTES
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import FileSource, check_no_links, remove_file
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.validation import StrictModel
from rebar_depth_bench.base.writing import atomic_replace, temporary_target
from rebar_depth_bench.data.files import parameters_digest

FOLDER_NAME = "rebar-depth-bench"
_ENTRY = re.compile(r"[0-9a-f]{64}\.truth")


@dataclass(frozen=True, slots=True)
class CacheFile:
    """File of the cache; ``used_s`` is the time of its last use, seconds since 1970."""

    path: Path
    size_bytes: int
    used_s: float


def cache_folder() -> Path:
    """Return the user's cache folder, which may be missing: it lies in ``XDG_CACHE_HOME`` or else ``~/.cache``.

    Raises ``InputError`` if there is no home folder or the cache folder is a symbolic link.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        parent = given if given.is_absolute() else Path.home() / ".cache"
        check_no_links(parent, FOLDER_NAME)
    except RuntimeError:
        raise InputError("the home folder is unknown, expected it in HOME or XDG_CACHE_HOME") from None
    except OSError as error:
        raise InputError(str(error)) from None
    return parent / FOLDER_NAME


def entries(folder: Path) -> list[CacheFile]:
    """Return the entries of a cache folder, finished and unfinished, the least recently used first.

    There are none if the folder is missing.
    """
    files = []
    with suppress(FileNotFoundError, NotADirectoryError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):  # Another process may delete files.
                status = path.lstat()
                if _ENTRY.fullmatch(temporary_target(path.name) or path.name) and stat.S_ISREG(status.st_mode):
                    files.append(CacheFile(path, status.st_size, status.st_mtime))
    return sorted(files, key=lambda file: (file.used_s, file.path))


def clear(folder: Path) -> list[CacheFile]:
    """Delete all entries of a cache folder, and return them. Raises ``OSError`` if one cannot be deleted."""
    files = entries(folder)
    for file in files:
        remove_file(file.path)
    return files


def limit_size(folder: Path) -> None:
    """Delete the least recently used entries until the others are within the size limit."""
    kept = entries(folder)
    while total_bytes(kept) > CACHE_BYTES.value():
        with suppress(OSError):
            remove_file(kept.pop(0).path)


def total_bytes(files: Iterable[CacheFile]) -> int:
    """Return the sum of the sizes of files."""
    return sum(file.size_bytes for file in files)


# One entry: its file, and the views in it.

_FORMAT = "rebar-cache-4"
_ALIGNMENT = 8
_TRAILER = struct.Struct("<32sQ")
"""SHA-256 of the index and its length in bytes."""
_DAMAGE = (OSError, EOFError, ValueError)
"""Errors of reading a damaged entry."""


@dataclass(frozen=True, eq=False)
class ViewArrays:
    """Cached data of one view: named 1-D arrays, and a few numbers."""

    view_id: str
    arrays: Mapping[str, ndarray]
    numbers: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class CacheContent:
    """Content of an entry and how it is computed.

    ``inputs``, a value of JSON, contains everything that the arrays depend on. ``extract`` takes the ids of some
    views, or None for all ``view_ids``, and yields the views in any order. ``is_sound`` returns whether the data
    of a stored view are in their range. ``task`` is the name of the computation in a progress display.
    """

    task: str
    inputs: Mapping[str, Any]
    dtypes: Mapping[str, type]
    view_ids: tuple[str, ...]
    extract: Callable[[Collection[str] | None], Iterator[ViewArrays]]
    is_sound: Callable[[ViewArrays], bool]

    @cached_property
    def key(self) -> str:
        """Hex digest that identifies the entry."""
        arrays = [[name, np.dtype(dtype).str] for name, dtype in self.dtypes.items()]
        identity = {"format": _FORMAT, "arrays": arrays, "views": self.view_ids, "inputs": self.inputs}
        return parameters_digest(identity)

    @property
    def file_name(self) -> str:
        """Name of the entry's file."""
        return f"{self.key}.truth"

    def compute(
        self, view_ids: Collection[str] | None = None, progress: Progress = silent
    ) -> Iterator[ViewArrays]:
        """Yield some views, or all, with arrays of ``dtypes``. Every error of ``extract`` is raised."""
        total = len(self.view_ids if view_ids is None else view_ids)
        for done, view in enumerate(self.extract(view_ids), start=1):
            arrays: dict[str, ndarray] = {
                name: np.ascontiguousarray(view.arrays[name], dtype) for name, dtype in self.dtypes.items()
            }
            yield ViewArrays(view.view_id, arrays, view.numbers)
            progress(self.task, done, total)


class _Block(StrictModel):
    """Arrays of a view in an entry: their place, numbers of values and checksum, and the numbers of the view."""

    view_id: str
    start: Annotated[int, Field(ge=0)]
    size: Annotated[int, Field(ge=0)]
    counts: tuple[Annotated[int, Field(ge=0)], ...]
    crc32: int
    numbers: tuple[float, ...]


class _Index(StrictModel):
    key: str
    blocks: tuple[_Block, ...]


@dataclass(frozen=True, eq=False)
class _Entry:
    """Open entry. Its file stays open, so it remains readable while another process deletes or replaces it."""

    path: Path
    source: FileSource
    blocks: Mapping[str, _Block]


def _padding(size_bytes: int) -> int:
    return -size_bytes % _ALIGNMENT


def _read_entry(path: Path, content: CacheContent) -> _Entry | None:
    """Open an entry. Return None if it is missing or, with a warning, if it is damaged."""
    try:
        if path.is_symlink():
            raise ValueError("it is a symbolic link")
        source = FileSource(path)
        end = source.size - _TRAILER.size
        digest, length = _TRAILER.unpack(source.read_at(end, _TRAILER.size))
        encoded = source.read_at(end - length, length)
        if hashlib.sha256(encoded).digest() != digest:
            raise ValueError("its index does not match its checksum")
        index = _Index.model_validate_json(bytes(encoded))
        blocks = {block.view_id: block for block in index.blocks}
        if index.key != content.key or blocks.keys() != set(content.view_ids):
            raise ValueError("it holds other views")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except _DAMAGE as error:
        _warn_of_damage(path, error)
        return None
    with suppress(OSError):
        os.utime(path)
    return _Entry(path, source, blocks)


def _write_entry(path: Path, content: CacheContent, progress: Progress) -> _Entry:
    """Write an entry and open it. It appears complete or not at all, without locks between processes.

    Every error of computing the views is raised, and ``OSError``, ``OutputError`` or ``InputError`` if the entry
    cannot be written.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    blocks = []
    with atomic_replace(path, 0o600) as unfinished:
        with unfinished.open("wb") as file:
            for view in content.compute(progress=progress):
                start, checksum = file.tell(), 0
                for array in view.arrays.values():
                    values = array.tobytes() + bytes(_padding(array.nbytes))
                    file.write(values)
                    checksum = zlib_ng.crc32(values, checksum)
                blocks.append(
                    _Block(
                        view_id=view.view_id,
                        start=start,
                        size=file.tell() - start,
                        counts=tuple(map(len, view.arrays.values())),
                        crc32=checksum,
                        numbers=view.numbers,
                    )
                )
            index = _Index(key=content.key, blocks=tuple(blocks)).model_dump_json().encode()
            file.write(index + _TRAILER.pack(hashlib.sha256(index).digest(), len(index)))
        source = FileSource(unfinished)
    limit_size(path.parent)
    if not path.exists():
        limit = f"{CACHE_BYTES.value()} bytes ({CACHE_BYTES.variable})"
        _warn_once(f"{path}: {source.size} bytes are not kept, expected a cache of at most {limit}")
    return _Entry(path, source, {block.view_id: block for block in blocks})


@dataclass(frozen=True, eq=False)
class ArrayCache:
    """Views of an entry, in the order of its content; a view that the entry does not hold intact is computed.

    ``numbers`` holds the numbers of each view.
    """

    content: CacheContent
    entry: _Entry | None
    numbers: tuple[tuple[float, ...], ...]

    def __len__(self) -> int:
        return len(self.view_ids)

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return self.content.view_ids

    def view(self, position: int) -> ViewArrays:
        """Return the view at ``position`` as arrays that must not be changed; thread-safe.

        Raises ``DatasetError`` if it has to be computed and cannot be.
        """
        view_id = self.view_ids[position]
        if self.entry is not None:
            try:
                block = self.entry.blocks[view_id]
                values = self.entry.source.read_at(block.start, block.size)
                if zlib_ng.crc32(values) != block.crc32:
                    raise ValueError(f"the values of {view_id} do not match their checksum")
                arrays: dict[str, ndarray] = {}
                offset = 0
                for (name, dtype), count in zip(self.content.dtypes.items(), block.counts, strict=True):
                    arrays[name] = np.frombuffer(values, dtype, count, offset)
                    offset += arrays[name].nbytes + _padding(arrays[name].nbytes)
                view = ViewArrays(view_id, arrays, block.numbers)
                if not self.content.is_sound(view):
                    raise ValueError(f"the values of {view_id} are out of range")
                return view
            except _DAMAGE as error:
                with suppress(OSError):  # Of several threads, only the first can delete the file.
                    self.entry.path.unlink()
                    _warn_of_damage(self.entry.path, error)
        [view] = self.content.compute([view_id])
        return view


def open_cache(content: CacheContent, progress: Progress = silent) -> ArrayCache:
    """Open the entry of ``content``; if it is missing or damaged, it is written first, one view at a time.

    If it cannot be written, a warning is printed, and each view is computed whenever it is needed: without a
    cache, a score only takes longer. Raises ``DatasetError`` if a view cannot be computed.
    """
    CACHE_BYTES.value()  # An invalid variable is reported before the work.
    try:
        path = cache_folder() / content.file_name
        entry = _read_entry(path, content) or _write_entry(path, content, progress)
        numbers = {view_id: block.numbers for view_id, block in entry.blocks.items()}
    except DatasetError:
        raise
    except (InputError, OutputError, OSError) as error:
        reason = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else error
        _warn_once(f"ground truth is not cached, but computed whenever it is needed: {reason}")
        entry, numbers = None, {view.view_id: view.numbers for view in content.compute(progress=progress)}
    return ArrayCache(content, entry, tuple(numbers[view_id] for view_id in content.view_ids))


def _warn_of_damage(path: Path, damage: Exception) -> None:
    reason = f"{getattr(damage, 'strerror', None) or damage}".partition("\n")[0]
    print_notice(f"warning: {path}: the cache is damaged, and its values are computed again: {reason}")


@cache
def _warn_once(message: str) -> None:
    print_notice(f"warning: {message}")
