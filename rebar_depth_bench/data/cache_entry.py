"""File format of the ground-truth cache: per-view arrays, written and read one view at a time.

An entry is one file: the values of each view as a block of raw arrays, then an index in JSON, its SHA-256 and its
length. The index holds the entry's key, the ids of the views, the number of values and the CRC-32 of each block,
and further numbers of each view, so every byte of the file is covered by a checksum. The key is a digest of
everything that the values depend on.
"""

from __future__ import annotations

import hashlib
import io
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy import ndarray
from zlib_ng import zlib_ng

from rebar_depth_bench.data.cache_folder import ENTRY_SUFFIX
from rebar_depth_bench.data.files import parameters_digest
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.reading import ByteSource, FileSource, MemorySource
from rebar_depth_bench.validation import StrictModel

_FORMAT = "rebar-cache-2"
_ALIGNMENT = 8
_TRAILER = struct.Struct("<32sQ")
"""SHA-256 of the index and its length in bytes."""
_MAX_INDEX_BYTES_PER_VIEW = 4096
DAMAGE = (OSError, EOFError, ValueError)
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
        return self.key + ENTRY_SUFFIX

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
class Entry:
    """Open entry. Its file stays open, so it remains readable while another process deletes or replaces it."""

    path: Path
    content: CacheContent
    source: ByteSource
    index: _Index
    starts: tuple[int, ...]
    positions: Mapping[str, int]

    def view(self, view_id: str) -> ViewArrays:
        """Return the arrays of a view, read-only. Raises one of ``DAMAGE``."""
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


def write_entry(file: BinaryIO, content: CacheContent) -> None:
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


def entry_in_memory(content: CacheContent) -> Entry:
    """Return an entry that is in no file.

    Raises ``DatasetError`` if a view is out of range, and ``ValueError`` if views are missing.
    """
    file = io.BytesIO()
    write_entry(file, content)
    return _read_source(MemorySource(file.getbuffer()), Path("the cache in memory"), content)


def read_entry(file: Path, path: Path, content: CacheContent) -> Entry:
    """Open ``file``, the entry that is or will be at ``path``; raise one of ``DAMAGE`` if it is not sound."""
    if file.is_symlink() or not file.is_file():
        raise ValueError("it is not a regular file")
    return _read_source(FileSource(file), path, content)


def _read_source(source: ByteSource, path: Path, content: CacheContent) -> Entry:
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
    return Entry(path, content, source, index, starts, positions)


def _aligned(size_bytes: int) -> int:
    return -(-size_bytes // _ALIGNMENT) * _ALIGNMENT
