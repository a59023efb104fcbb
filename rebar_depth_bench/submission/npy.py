"""``.npy`` entries: the header is parsed here, by pattern, before a single value is touched.

numpy's own reader allocates what the header claims, evaluates it as Python and warns about old ones;
none of that belongs near bytes from outside.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rebar_depth_bench.submission.problems import EntryError, show, show_shape

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
