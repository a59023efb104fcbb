"""Disk cache of per-view arrays, written and read one view at a time.

A cache is a folder with one file of raw values per array, in which the values of all views are concatenated, and
an index ``views.json`` with the views' ids, the offset of each view's values, their CRC-32 and metadata. The
folder is created atomically.
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

from rebar_depth_bench.atomic_io import fsync_path
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.submission.zip_directory import FileSource

_INDEX_FILE = "views.json"
_KEYS = ("view_ids", "starts", "checksums", "notes")


@dataclass(frozen=True, eq=False)
class ViewArrays:
    """Cached data of one view: named 1-D arrays of equal length, and small JSON-serialisable metadata."""

    view_id: str
    arrays: Mapping[str, ndarray]
    metadata: Any


@dataclass(frozen=True, eq=False)
class ArrayCache:
    """Open cache: the index of all views in order, and the files their values are read from on demand.

    View ``i`` occupies the values ``starts[i]`` to ``starts[i + 1]`` of each file. Files stay open, so that a
    reader is not affected by another process that deletes or replaces the folder.
    """

    path: Path
    dtypes: Mapping[str, type]
    view_ids: tuple[str, ...]
    starts: tuple[int, ...]
    checksums: tuple[int, ...]
    metadata: tuple[Any, ...]
    sources: Mapping[str, FileSource]

    def __len__(self) -> int:
        return len(self.view_ids)

    def view(self, index: int) -> ViewArrays:
        """Read the view at position ``index`` as read-only arrays; thread-safe.

        Raises ``DatasetError`` if the values do not match their checksum.
        """
        start, end = self.starts[index], self.starts[index + 1]
        arrays: dict[str, ndarray] = {}
        for name, dtype in self.dtypes.items():
            size = np.dtype(dtype).itemsize
            arrays[name] = np.frombuffer(self.sources[name].read_at(start * size, (end - start) * size), dtype)
        if _checksum(arrays.values()) != self.checksums[index]:
            raise DatasetError(
                f"{self.path}: the cached values of {self.view_ids[index]} are damaged; delete this folder, it "
                "will be filled again"
            )
        return ViewArrays(self.view_ids[index], arrays, self.metadata[index])


def open_cache(
    path: Path, dtypes: Mapping[str, type], fill: Callable[[], Iterator[ViewArrays]], *, stale_pattern: str
) -> ArrayCache:
    """Open the cache at ``path``; if it is missing or damaged, write it from the views that ``fill`` yields.

    ``stale_pattern`` is a glob pattern of folder names next to ``path``; matching folders are deleted when a new
    cache is written. At most one view is held in memory. Raises ``DatasetError`` if the cache cannot be written.
    """
    for is_retry in (False, True):  # Retry once: another process may have just created the cache.
        try:
            return _read(path, dtypes)
        except (OSError, ValueError, LookupError, TypeError):
            if is_retry:
                shutil.rmtree(path, ignore_errors=True)  # The folder is missing or damaged.
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=".filling-", dir=path.parent))
    except OSError as error:
        raise _write_error(path, error) from None
    try:
        _write(temporary, dtypes, fill())
        for stale in path.parent.glob(stale_pattern):
            if stale != path:
                shutil.rmtree(stale, ignore_errors=True)
        _move_into_place(temporary, path)
        return _read(path, dtypes)
    except OSError as error:
        raise _write_error(path, error) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _move_into_place(temporary: Path, path: Path) -> None:
    try:
        temporary.rename(path)
    except OSError:
        if not path.is_dir():  # Otherwise another process created the same cache first.
            raise


def _write_error(path: Path, error: OSError) -> DatasetError:
    return DatasetError(f"{path}: the cache of ground truth cannot be written: {error.strerror or error}")


def _read(path: Path, dtypes: Mapping[str, type]) -> ArrayCache:
    index = json.loads((path / _INDEX_FILE).read_text())
    view_ids, starts, checksums, metadata = (tuple(index[key]) for key in _KEYS)
    if not len(starts) - 1 == len(view_ids) == len(checksums) == len(metadata):
        raise ValueError(f"{path}: the outline is inconsistent")
    sources = {name: FileSource(path / name) for name in dtypes}
    for name, dtype in dtypes.items():
        size_bytes, expected_bytes = sources[name].size, starts[-1] * np.dtype(dtype).itemsize
        if size_bytes != expected_bytes:
            raise ValueError(f"{path / name}: {size_bytes} bytes, expected {expected_bytes}")
    return ArrayCache(path, dtypes, view_ids, starts, checksums, metadata, sources)


def _write(folder: Path, dtypes: Mapping[str, type], views: Iterator[ViewArrays]) -> None:
    view_ids, starts, checksums, metadata = [], [0], [], []
    with ExitStack() as stack:
        files = {name: stack.enter_context((folder / name).open("wb")) for name in dtypes}
        for view in views:
            arrays: list[ndarray] = [
                np.ascontiguousarray(view.arrays[name], dtype) for name, dtype in dtypes.items()
            ]
            for file, array in zip(files.values(), arrays, strict=True):
                file.write(array.data)
            view_ids.append(view.view_id)
            starts.append(starts[-1] + len(arrays[0]))
            checksums.append(_checksum(arrays))
            metadata.append(view.metadata)
    index = dict(zip(_KEYS, (view_ids, starts, checksums, metadata), strict=True))
    (folder / _INDEX_FILE).write_text(json.dumps(index))
    for path in (*folder.iterdir(), folder):
        fsync_path(path)


def _checksum(arrays: Iterable[ndarray]) -> int:
    checksum = 0
    for array in arrays:
        checksum = zlib_ng.crc32(array.view(np.uint8).data, checksum)
    return checksum
