"""``.npy`` entries: the header is parsed here, by pattern, before a single value is touched.

numpy's own reader allocates what the header claims, evaluates it as Python and warns about old ones;
none of that belongs near bytes from outside.

``.npz`` entries: a zip inside the zip, held to the same rules as the outer one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rebar_depth_bench.errors import EntryError, show, show_shape
from rebar_depth_bench.submission.zip_directory import DirectoryError, MemorySource, read_directory
from rebar_depth_bench.submission.zip_entries import check_entries, read_data

HEADER_LIMIT = 4096
Depth = NDArray[np.floating[Any]]
"""Metres along the optical axis, (H, W), float16, float32 or float64 in native byte order."""

_MAGIC = b"\x93NUMPY"
_LENGTH_BYTES = {1: 2, 2: 4, 3: 4}
_DESCR = re.compile(r"'descr'\s*:\s*(?:'([^']*)'|\[[^]]*\])")
_FORTRAN = re.compile(r"'fortran_order'\s*:\s*(True|False)")
_SHAPE = re.compile(r"'shape'\s*:\s*\(([0-9L,\s]*)\)")
_FLOATS = re.compile(r"[<>=|]?f[248]")


@dataclass(frozen=True, slots=True)
class _Header:
    dtype: np.dtype[np.floating[Any]]
    fortran_order: bool
    data_offset: int


def max_npy_bytes(shape: tuple[int, int]) -> int:
    """Return the size of the largest acceptable ``.npy`` of that (H, W): float64 and a long header."""
    return shape[0] * shape[1] * 8 + HEADER_LIMIT


def decode_npy(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the float16, float32 or float64 array of (H, W) that ``data`` holds, in native byte order.

    The array is a read-only view on ``data``, or a copy if its bytes had to be swapped or aligned.
    ``depth_scale`` does not apply: the values are metres. Raises ``EntryError``.
    """
    del depth_scale
    header = _parse_header(name, data, shape)
    found = len(data) - header.data_offset
    expected = shape[0] * shape[1] * header.dtype.itemsize
    if found != expected:
        raise EntryError(
            f"{name}: {found} bytes of values follow the header, "
            f"expected {expected} for {show_shape(shape)} {header.dtype.name}"
        )
    values = np.frombuffer(data, header.dtype, offset=header.data_offset)
    array = values.reshape(shape[::-1]).T if header.fortran_order else values.reshape(shape)
    return np.require(array, array.dtype.newbyteorder("="), "A")


def _parse_header(name: str, data: memoryview, shape: tuple[int, int]) -> _Header:
    text, data_offset = _header_text(name, bytes(data[: HEADER_LIMIT + 1]))
    descr, fortran, dims = (pattern.findall(text) for pattern in (_DESCR, _FORTRAN, _SHAPE))
    rest = _SHAPE.sub("", _FORTRAN.sub("", _DESCR.sub("", text)))
    if not len(descr) == len(fortran) == len(dims) == 1 or re.sub(r"[\s,]", "", rest) != "{}":
        raise EntryError(
            f"{name}: the .npy header is {show(text.strip())}, expected descr, fortran_order and shape"
        )
    if _is_object(descr[0]):
        raise EntryError(f"{name}: the array holds pickled Python objects (dtype object), expected float16/32/64")
    if not _FLOATS.fullmatch(descr[0]):
        found = show(descr[0]) if descr[0] else "structured"
        raise EntryError(f"{name}: the dtype is {found}, expected float16, float32 or float64")
    found_shape = [show(size) for size in dims[0].replace("L", "").replace(",", " ").split()]
    if found_shape != [str(size) for size in shape]:
        found = " x ".join(found_shape) if found_shape else "a single value"
        raise EntryError(f"{name}: the shape is {found}, expected {show_shape(shape)} (H x W)")
    return _Header(np.dtype(descr[0].replace("|", "=")), fortran[0] == "True", data_offset)


def _is_object(descr: str) -> bool:
    return descr.lstrip("<>=|").startswith("O")


def _header_text(name: str, head: bytes) -> tuple[str, int]:
    """Return the header's text and the byte where the values start."""
    version = head[6] if head.startswith(_MAGIC) and len(head) >= 8 else 0
    if version not in _LENGTH_BYTES:
        pickled = head[:1] == b"\x80"
        found = "a Python pickle" if pickled else f"bytes that start with {head[:8]!r}"
        raise EntryError(f"{name}: {found} was found, expected a .npy array of version 1, 2 or 3")
    start = 8 + _LENGTH_BYTES[version]
    length = int.from_bytes(head[8:start], "little")
    if start + length > HEADER_LIMIT:
        raise EntryError(
            f"{name}: the .npy header declares {length} bytes, expected at most {HEADER_LIMIT - start}"
        )
    if start + length > len(head):
        raise EntryError(f"{name}: the .npy header is cut off at {len(head)} bytes, expected {start + length}")
    return head[start : start + length].decode("utf-8", "backslashreplace"), start + length


# More than the one array that is expected, so that a wrong file can still be described.
_MAX_MEMBERS = 256
_CONTAINER_BYTES = 64 * 1024


def max_npz_bytes(shape: tuple[int, int]) -> int:
    """Return the size of the largest acceptable ``.npz`` of that (H, W), in bytes."""
    values = max_npy_bytes(shape)
    return values + values // 1024 + _CONTAINER_BYTES


def decode_npz(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the one array of (H, W) inside, as ``decode_npy`` does. Raises ``EntryError``."""
    source = MemorySource(data)
    try:
        directory = read_directory(source, _MAX_MEMBERS)
    except DirectoryError as error:
        raise EntryError(f"{name}: inside the .npz, {error}") from error
    members = [show(entry.name) for entry in directory.entries]
    if len(members) != 1:
        listed = f" ({', '.join(members[:4])}{', ...' if len(members) > 4 else ''})" if members else ""
        raise EntryError(f"{name}: the .npz holds {len(members)} arrays{listed}, expected exactly one")
    (checked,) = check_entries(source, directory, lambda _: max_npy_bytes(shape))
    if checked.problems:
        raise EntryError(f"{name}: inside the .npz, {'; '.join(checked.problems)}")
    if not checked.entry.name.endswith(".npy"):
        raise EntryError(f"{name}: the .npz holds {members[0]}, expected one .npy array")
    try:
        values = read_data(source, checked)
    except EntryError as error:
        raise EntryError(f"{name}: inside the .npz, {error.problem}") from error
    return decode_npy(f"{name} ({members[0]})", values, shape, depth_scale)
