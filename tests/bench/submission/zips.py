"""Hand-built zip archives, in which every header field can be set to a wrong value."""

from __future__ import annotations

import io
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.submission import ExpectedViews, SubmissionReader

Array = NDArray[Any]
SHAPE = (3, 4)
EXPECTED = {"lattice/0000": SHAPE, "lattice/0001": SHAPE, "pile/0000": (2, 5)}
DEPTH = np.arange(12, dtype=np.float32).reshape(SHAPE) / 7


@dataclass(frozen=True)
class Record:
    """Zip entry: its data, its central-directory fields and the local-header fields, ``None`` where they agree."""

    name: bytes
    data: bytes = b""
    method: int = 0
    flags: int = 0
    size: int | None = None
    compressed: int | None = None
    crc: int | None = None
    mode: int = 0o100644
    offset: int | None = None
    extra: bytes = b""
    local_name: bytes | None = None
    local_method: int | None = None
    local_extra: bytes = b""
    local_size: int | None = None
    disk: int = 0
    host: int = 3


def check_archive(path: str | Path, expected: ExpectedViews) -> list[Problem]:
    """Return all problems of an archive, those of each entry included."""
    with SubmissionReader(path, expected) as reader:
        return list(reader.problems())


def deflated(name: bytes, data: bytes, level: int = 6) -> Record:
    """Return a valid deflated entry."""
    packed = zlib.compressobj(level, zlib.DEFLATED, -15)
    body = packed.compress(data) + packed.flush()
    return Record(name, body, 8, size=len(data), crc=zlib.crc32(data))


def build(records: list[Record], *, count: int | None = None, comment: bytes = b"", disk: int = 0) -> bytes:
    """Return the bytes of a zip with these entries; ``count`` and ``disk`` override the end record."""
    out, directory = io.BytesIO(), b""
    for record in records:
        offset = out.tell() if record.offset is None else record.offset
        crc = zlib.crc32(record.data) if record.crc is None else record.crc
        size = len(record.data) if record.size is None else record.size
        packed = len(record.data) if record.compressed is None else record.compressed
        name = record.name if record.local_name is None else record.local_name
        method = record.method if record.local_method is None else record.local_method
        local_size = size if record.local_size is None else record.local_size
        if record.offset is None:
            numbers = (crc, packed, local_size, len(name), len(record.local_extra))
            out.write(struct.pack("<4s5H3L2H", b"PK\3\4", 20, record.flags, method, 0, 33, *numbers))
            out.write(name + record.local_extra + record.data)
        head = struct.pack("<4s4B4H", b"PK\1\2", 20, record.host, 20, 0, record.flags, record.method, 0, 33)
        head += struct.pack("<3L3H", crc, packed, size, len(record.name), len(record.extra), 0)
        directory += head + struct.pack("<2H2L", record.disk, 0, record.mode << 16, offset)
        directory += record.name + record.extra
    start = out.tell()
    count = len(records) if count is None else count
    out.write(directory)
    end = (disk, disk, count, count, len(directory), start, len(comment))
    out.write(struct.pack("<4s4H2LH", b"PK\5\6", *end) + comment)
    return out.getvalue()


def npy(array: Array, **kwargs: object) -> bytes:
    """Return the bytes of an ``.npy`` file."""
    buffer = io.BytesIO()
    np.save(buffer, array, **kwargs)  # type: ignore[arg-type]
    return buffer.getvalue()


def npy_header(text: str, version: bytes = b"\1\0") -> bytes:
    """Return an ``.npy`` header with this text."""
    length = len(text).to_bytes(2 if version == b"\1\0" else 4, "little")
    return b"\x93NUMPY" + version + length + text.encode()


def npz(**arrays: Array) -> bytes:
    """Return the bytes of an ``.npz`` file."""
    buffer = io.BytesIO()
    save: Callable[..., None] = np.savez_compressed  # The type hints of numpy 2 take array keywords for options.
    save(buffer, **arrays)
    return buffer.getvalue()


def exr(path: Path, channels: dict[str, Array], **header: object) -> bytes:
    """Return the bytes of a scan-line ``.exr`` file."""
    fields = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(fields, channels).write(str(path))
    return path.read_bytes()


def chunk(kind: bytes, body: bytes) -> bytes:
    """Return the bytes of a PNG chunk."""
    return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")


def png(units: Array, *, bits: int = 16, colour: int = 0, interlace: int = 0, idat: bytes | None = None) -> bytes:
    """Return the bytes of a PNG of unfiltered rows; ``idat`` replaces the compressed rows."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in units)
    head = struct.pack(">2I5B", units.shape[1], units.shape[0], bits, colour, 0, 0, interlace)
    body = zlib.compress(rows) if idat is None else idat
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


META = Record(b"submission.json", b'{"method": "m", "depth_scale": 0.001}')
FIRST = Record(b"lattice/0000.npy", npy(DEPTH))
SECOND = Record(b"lattice/0001.npy", npy(DEPTH))
GOOD = [META, FIRST, SECOND]


def with_first(**changes: object) -> list[Record]:
    """Return the records of ``GOOD`` with other fields in the entry of the first view."""
    return [META, replace(FIRST, **changes), SECOND]  # type: ignore[arg-type]


def with_view(suffix: str, data: bytes) -> list[Record]:
    """Return the records of ``GOOD`` with an entry of another suffix and content for the first view."""
    return [META, Record(b"lattice/0000" + suffix.encode(), data), SECOND]


def problems_of(archive: list[Record] | bytes, expected: ExpectedViews = EXPECTED) -> list[Problem]:
    """Return the problems of an archive with this content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "submission.zip"
        path.write_bytes(archive if isinstance(archive, bytes) else build(archive))
        return check_archive(path, expected)


def located(problems: Iterable[Problem]) -> list[tuple[str, str]]:
    """Return code and location of every problem."""
    return [(problem.code, problem.where) for problem in problems]
