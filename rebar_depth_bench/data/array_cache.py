"""Arrays of many views kept as a few flat files: written and read view by view.

A cache is a folder: ``views.json`` with the views' ids, where each one's part starts, its checksum and a note,
and a file of raw values per array. It appears under its name whole or not at all.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from zlib_ng import zlib_ng

from rebar_depth_bench.atomic_io import sync
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.submission.zip_directory import FileSource

_OUTLINE = "views.json"
_KEYS = ("view_ids", "starts", "checksums", "notes")


@dataclass(frozen=True, eq=False)
class ViewArrays:
    """One view's part: arrays of one length by name, and a small JSON-able note."""

    view_id: str
    arrays: Mapping[str, ndarray]
    note: Any


@dataclass(frozen=True, eq=False)
class FlatCache:
    """All views' parts, in order; each is read when it is asked for, so that memory holds only those in use.

    The files stay open: whoever deletes or replaces the folder takes nothing from those who read.
    """

    path: Path
    dtypes: Mapping[str, type]
    view_ids: tuple[str, ...]
    starts: tuple[int, ...]
    checksums: tuple[int, ...]
    notes: tuple[Any, ...]
    sources: Mapping[str, FileSource]

    def __len__(self) -> int:
        return len(self.view_ids)

    def view(self, place: int) -> ViewArrays:
        """Return the view at ``place``, read-only; threads may ask at once.

        Raises ``DatasetError`` if its values are not those that were written.
        """
        start, end = self.starts[place], self.starts[place + 1]
        arrays: dict[str, ndarray] = {}
        for name, dtype in self.dtypes.items():
            size = np.dtype(dtype).itemsize
            arrays[name] = np.frombuffer(self.sources[name].read_at(start * size, (end - start) * size), dtype)
        if _checksum(arrays.values()) != self.checksums[place]:
            raise DatasetError(
                f"{self.path}: the cached values of {self.view_ids[place]} are damaged; delete this folder, it is "
                "filled again"
            )
        return ViewArrays(self.view_ids[place], arrays, self.notes[place])


def open_cache(
    path: Path, dtypes: Mapping[str, type], fill: Callable[[], Iterator[ViewArrays]], *, outdated: str
) -> FlatCache:
    """Return the cache at ``path``; where there is none or a damaged one, write it from the views ``fill`` yields.

    ``outdated`` is a pattern of names beside it that a new cache replaces. Filling holds one view in memory.
    Raises ``DatasetError`` where it cannot be written.
    """
    for last in (False, True):  # a second look, for another process may have put it there a moment ago
        try:
            return _read(path, dtypes)
        except (OSError, ValueError, LookupError, TypeError):
            if last:
                shutil.rmtree(path, ignore_errors=True)  # not there, or damaged
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=".filling-", dir=path.parent))
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        _write(temporary, dtypes, fill())
        for old in path.parent.glob(outdated):
            if old != path:
                shutil.rmtree(old, ignore_errors=True)
        _put_in_place(temporary, path)
        return _read(path, dtypes)
    except OSError as error:
        raise _unwritable(path, error) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _put_in_place(temporary: Path, path: Path) -> None:
    try:
        temporary.rename(path)
    except OSError:
        if not path.is_dir():  # else another process was faster, with the same bytes
            raise


def _unwritable(path: Path, error: OSError) -> DatasetError:
    return DatasetError(f"{path}: the cache of ground truth cannot be written: {error.strerror or error}")


def _read(path: Path, dtypes: Mapping[str, type]) -> FlatCache:
    outline = json.loads((path / _OUTLINE).read_text())
    view_ids, starts, checksums, notes = (tuple(outline[key]) for key in _KEYS)
    if not len(starts) - 1 == len(view_ids) == len(checksums) == len(notes):
        raise ValueError(f"{path}: the outline contradicts itself")
    sources = {name: FileSource(path / name) for name in dtypes}
    for name, dtype in dtypes.items():
        found, expected = sources[name].size, starts[-1] * np.dtype(dtype).itemsize
        if found != expected:
            raise ValueError(f"{path / name}: {found} bytes, expected {expected}")
    return FlatCache(path, dtypes, view_ids, starts, checksums, notes, sources)


def _write(into: Path, dtypes: Mapping[str, type], views: Iterator[ViewArrays]) -> None:
    view_ids, starts, checksums, notes = [], [0], [], []
    with ExitStack() as stack:
        files = {name: stack.enter_context((into / name).open("wb")) for name in dtypes}
        for view in views:
            arrays: list[ndarray] = [
                np.ascontiguousarray(view.arrays[name], dtype) for name, dtype in dtypes.items()
            ]
            for file, array in zip(files.values(), arrays, strict=True):
                file.write(array.data)
            view_ids.append(view.view_id)
            starts.append(starts[-1] + len(arrays[0]))
            checksums.append(_checksum(arrays))
            notes.append(view.note)
    outline = dict(zip(_KEYS, (view_ids, starts, checksums, notes), strict=True))
    (into / _OUTLINE).write_text(json.dumps(outline))
    for path in (*into.iterdir(), into):
        sync(path)


def _checksum(arrays: Iterable[ndarray]) -> int:
    checksum = 0
    for array in arrays:
        checksum = zlib_ng.crc32(array.view(np.uint8).data, checksum)
    return checksum
