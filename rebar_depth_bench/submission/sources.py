"""Random access to the bytes of an archive: a file on disk, or bytes in memory (an ``.npz`` inside it)."""

from __future__ import annotations

import hashlib
import mmap
import os
import weakref
from pathlib import Path
from typing import Protocol

# Below this a read call is cheaper than a mapping and its page faults.
_SMALLEST_MAPPING = 64 * 1024


class ByteSource(Protocol):
    """Bytes that can be read anywhere, by several threads at once."""

    @property
    def size(self) -> int:
        """Length in bytes."""

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the source holds fewer."""


_PIECE_BYTES = 1 << 20


class FileSource:
    """A regular file, read through ``pread`` and short-lived read-only mappings.

    Every large read maps its own range and the mapping dies with the last view on it, so the resident
    memory stays that of the views in use however many gigabytes are read. The file must not be shortened
    while a view is alive (the system would end the process).
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._close = weakref.finalize(self, os.close, self._fd)
        self.size = os.fstat(self._fd).st_size

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the source holds fewer."""
        if offset < 0 or length < 0 or offset + length > os.fstat(self._fd).st_size:
            raise EOFError(f"{length} bytes at {offset} lie past the end of the file")
        if length < _SMALLEST_MAPPING:
            return _exactly(memoryview(os.pread(self._fd, length, offset)), length)
        lead = offset % mmap.ALLOCATIONGRANULARITY
        # Populated at once: a fault for every page would take as long as reading what they hold.
        flags = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
        mapped = mmap.mmap(self._fd, lead + length, flags, mmap.PROT_READ, offset=offset - lead)
        return memoryview(mapped)[lead:]

    def sha256(self) -> str:
        """Return the hex SHA-256 of the whole file, read in pieces."""
        digest = hashlib.sha256()
        offset = 0
        while piece := os.pread(self._fd, _PIECE_BYTES, offset):
            digest.update(piece)
            offset += len(piece)
        return digest.hexdigest()

    def close(self) -> None:
        """Close the file; views already handed out stay valid. Closing twice is harmless."""
        self._close()
        self._fd = -1


class MemorySource:
    """Bytes in memory."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self.size = len(data)

    def read_at(self, offset: int, length: int) -> memoryview:
        """Return exactly ``length`` bytes, or raise ``EOFError`` if the source holds fewer."""
        if offset < 0 or length < 0:
            raise EOFError(f"{length} bytes at {offset} lie outside the data")
        return _exactly(self._data[offset : offset + length], length)


def _exactly(data: memoryview, length: int) -> memoryview:
    if len(data) != length:
        raise EOFError(f"{len(data)} bytes found, expected {length}")
    return data
