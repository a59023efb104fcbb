"""Decoders of ``.npy`` and ``.npz`` entries.

The ``.npy`` header is parsed with regular expressions before any value is read. NumPy's reader is not used on
untrusted data: it allocates the size that the header declares, evaluates the header as a Python literal and emits
warnings for old format versions. An ``.npz`` entry is a zip inside the archive and is checked by the same rules as
the archive itself.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rebar_depth_bench.errors import EntryError, Problem, escape_text, format_shape
from rebar_depth_bench.reading import MemorySource
from rebar_depth_bench.submission.zip_directory import DirectoryError, read_directory
from rebar_depth_bench.submission.zip_entries import check_entries, read_data

MAX_HEADER_BYTES = 4096
"""Largest accepted ``.npy`` header, magic string included, in bytes."""

Depth = NDArray[np.floating[Any]]
"""Planar depth along the optical axis in metres: (H, W), float16, float32 or float64 in native byte order."""

_MAGIC = b"\x93NUMPY"
_LENGTH_BYTES = {1: 2, 2: 4, 3: 4}
_DESCR = re.compile(r"'descr'\s*:\s*(?:'([^']*)'|\[[^]]*\])")
_FORTRAN_ORDER = re.compile(r"'fortran_order'\s*:\s*(True|False)")
_SHAPE = re.compile(r"'shape'\s*:\s*\(([0-9L,\s]*)\)")
_FLOAT_DESCR = re.compile(r"[<>=|]?f[248]")


@dataclass(frozen=True, slots=True)
class _Header:
    dtype: np.dtype[np.floating[Any]]
    fortran_order: bool
    data_offset: int


def max_npy_bytes(shape: tuple[int, int]) -> int:
    """Return the largest acceptable size of an ``.npy`` file of shape (H, W) in bytes (float64 values)."""
    return shape[0] * shape[1] * 8 + MAX_HEADER_BYTES


def decode_npy(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the depth array in ``data``, in metres: (H, W), float16, float32 or float64 in native byte order.

    The array is a read-only view on ``data``, or a copy if its bytes had to be swapped or aligned.
    ``depth_scale`` is ignored, since the values are metres. Raises ``EntryError`` if the data is damaged or has
    another shape or dtype.
    """
    del depth_scale
    header = _parse_header(name, data, shape)
    actual_bytes = len(data) - header.data_offset
    expected_bytes = shape[0] * shape[1] * header.dtype.itemsize
    if actual_bytes != expected_bytes:
        expected = f"{expected_bytes} for {format_shape(shape)} {header.dtype.name}"
        raise EntryError(Problem("size", name, f"{actual_bytes} bytes of values follow the header", expected))
    values = np.frombuffer(data, header.dtype, offset=header.data_offset)
    array = values.reshape(shape[::-1]).T if header.fortran_order else values.reshape(shape)
    return np.require(array, array.dtype.newbyteorder("="), "A")


def _parse_header(name: str, data: memoryview, shape: tuple[int, int]) -> _Header:
    text, data_offset = _header_text(name, bytes(data[: MAX_HEADER_BYTES + 1]))
    descr, fortran, shapes = (pattern.findall(text) for pattern in (_DESCR, _FORTRAN_ORDER, _SHAPE))
    remainder = _SHAPE.sub("", _FORTRAN_ORDER.sub("", _DESCR.sub("", text)))
    if not len(descr) == len(fortran) == len(shapes) == 1 or re.sub(r"[\s,]", "", remainder) != "{}":
        found = f"the .npy header is {escape_text(text.strip())}"
        raise EntryError(Problem("syntax", name, found, "descr, fortran_order and shape"))
    if _is_object(descr[0]):
        found = "the array holds pickled Python objects (dtype object)"
        raise EntryError(Problem("invalid", name, found, "float16/32/64"))
    if not _FLOAT_DESCR.fullmatch(descr[0]):
        actual = escape_text(descr[0]) if descr[0] else "structured"
        raise EntryError(Problem("invalid", name, f"the dtype is {actual}", "float16, float32 or float64"))
    actual_shape = [escape_text(size) for size in shapes[0].replace("L", "").replace(",", " ").split()]
    if actual_shape != [str(size) for size in shape]:
        actual = " x ".join(actual_shape) if actual_shape else "a single value"
        raise EntryError(Problem("invalid", name, f"the shape is {actual}", f"{format_shape(shape)} (H x W)"))
    return _Header(np.dtype(descr[0].replace("|", "=")), fortran[0] == "True", data_offset)


def _is_object(descr: str) -> bool:
    return descr.lstrip("<>=|").startswith("O")


def _header_text(name: str, head: bytes) -> tuple[str, int]:
    """Return the header's text and the byte offset of the values."""
    version = head[6] if head.startswith(_MAGIC) and len(head) >= 8 else 0
    if version not in _LENGTH_BYTES:
        pickled = head[:1] == b"\x80"
        actual = "a Python pickle" if pickled else f"bytes that start with {head[:8]!r}"
        raise EntryError(Problem("syntax", name, f"{actual} was found", "a .npy array of version 1, 2 or 3"))
    start = 8 + _LENGTH_BYTES[version]
    length = int.from_bytes(head[8:start], "little")
    if start + length > MAX_HEADER_BYTES:
        found = f"the .npy header declares {length} bytes"
        raise EntryError(Problem("size", name, found, f"at most {MAX_HEADER_BYTES - start}"))
    if start + length > len(head):
        found = f"the .npy header is cut off at {len(head)} bytes"
        raise EntryError(Problem("damaged", name, found, f"{start + length}"))
    return head[start : start + length].decode("utf-8", "backslashreplace"), start + length


# More than the one expected array, so that the error message can list the members of a wrong file.
_MAX_NPZ_MEMBERS = 256
_MAX_NPZ_OVERHEAD_BYTES = 64 * 1024


def max_npz_bytes(shape: tuple[int, int]) -> int:
    """Return the largest acceptable size of an ``.npz`` file of shape (H, W), in bytes."""
    values = max_npy_bytes(shape)
    return values + values // 1024 + _MAX_NPZ_OVERHEAD_BYTES


def decode_npz(name: str, data: memoryview, shape: tuple[int, int], depth_scale: float = 1.0) -> Depth:
    """Return the only array of an ``.npz`` file, as ``decode_npy`` does. Raises ``EntryError``."""
    source = MemorySource(data)
    try:
        directory = read_directory(source, _MAX_NPZ_MEMBERS)
    except DirectoryError as error:
        raise _inner_error(name, error.problems) from error
    members = [escape_text(entry.name) for entry in directory.entries]
    if len(members) != 1:
        listed = f" ({', '.join(members[:4])}{', ...' if len(members) > 4 else ''})" if members else ""
        raise EntryError(Problem("invalid", name, f"the .npz holds {len(members)} arrays{listed}", "exactly one"))
    (checked,) = check_entries(source, directory, lambda _: max_npy_bytes(shape))
    if checked.problems:
        raise _inner_error(name, checked.problems)
    if not checked.entry.name.endswith(".npy"):
        raise EntryError(Problem("invalid", name, f"the .npz holds {members[0]}", "one .npy array"))
    try:
        values = read_data(source, checked)
    except EntryError as error:
        raise _inner_error(name, error.problems) from error
    return decode_npy(f"{name} ({members[0]})", values, shape, depth_scale)


def _inner_error(name: str, problems: Sequence[Problem]) -> EntryError:
    """Return the error of an ``.npz`` entry whose zip or member has the given problems."""
    found = f"inside the .npz, {'; '.join(map(str, problems))}"
    return EntryError(Problem(problems[0].code, name, found))
