"""PLY as other programs write it: text or binary, any vertex type, triangles or polygons of one size.

An own reader, because trimesh's takes truncated files for shorter ones and keeps ``bar_id`` to itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from dataset_builder.mesh_tools import checked_mesh
from dataset_builder.model import Mesh
from rebar_depth_bench.errors import MeshError

_OLD_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_NEW_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_NUMPY_NAMES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_TYPES = dict(zip(_OLD_NAMES + _NEW_NAMES, 2 * _NUMPY_NAMES, strict=True))
_BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_INDEX_NAMES = ("vertex_indices", "vertex_index")
_HEADER_LIMIT = 1 << 16
# Beyond it a float64 no longer tells whole numbers apart.
_MAX_WHOLE = 1 << 53

Columns = dict[str, ndarray]


@dataclass
class _Element:
    """An element of the header; each property is (name, type, type of a list's count or None)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]]


def read_ply(content: bytes, where: str) -> tuple[Mesh, Int64[ndarray, " n"] | None] | None:
    """Return the mesh in file units and each triangle's ``bar_id``, where the file tells one.

    Polygons become fans of triangles in their place. None where the file has no face. Raises ``MeshError``.
    """
    try:
        text, elements, body = _header(content)
        table = _body(elements, _BYTE_ORDERS[text], body, text == "ascii")
        vertex, face = table.get("vertex", {}), table.get("face", {})
        name = next((name for name in _INDEX_NAMES if name in face), None)
        if name is None or not len(face[name]):
            return None
        polygons = _whole(face[name], name)
        bar_id = _whole(face["bar_id"], "bar_id") if "bar_id" in face else None
        positions = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    except (LookupError, TypeError, ValueError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise MeshError(f"{where}: not a whole PLY that can be read: {reason}") from error
    fan = polygons.shape[1] - 2
    corners = np.stack([polygons[:, [0, k + 1, k + 2]] for k in range(fan)], axis=1)
    return checked_mesh(positions, corners, where), None if bar_id is None else np.repeat(bar_id, fan)


def _header(content: bytes) -> tuple[str, list[_Element], bytes]:
    """Return the encoding's name, the elements and what follows the header. Raises ``ValueError``."""
    head, mark, _ = content[:_HEADER_LIMIT].partition(b"end_header")
    lines = head.decode("latin-1").splitlines()
    if not lines or lines[0] != "ply" or not mark:
        raise ValueError(f"found a file that starts with {content[:20]!r}, expected a PLY header")
    encoding, elements = "", list[_Element]()
    for line in lines[1:]:
        match line.split():
            case ["format", name, "1.0"] if name in _BYTE_ORDERS:
                encoding = name
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", counter, kind, name] if elements and {counter, kind} <= _TYPES.keys():
                elements[-1].properties.append((name, _TYPES[kind], _TYPES[counter]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the header says {line[:60]!r}, which is no PLY 1.0")
    if not encoding:
        raise ValueError("the header tells no format")
    line_end = content.find(b"\n", len(head)) + 1
    return encoding, elements, content[line_end:] if line_end else b""


def _body(elements: list[_Element], order: str, body: bytes, is_text: bool) -> dict[str, Columns]:
    """Return every element's columns; text is read as binary of float64 throughout. Raises ``ValueError``."""
    if is_text:
        words = body.split()
        body = np.fromiter(map(float, words), np.float64, len(words)).tobytes()
    table, position = {}, 0
    for element in elements:
        dtype = _row_type(element, order, body[position : position + (1 << 20)], is_text)
        size = element.count * dtype.itemsize
        if size > len(body) - position:
            raise ValueError(f"it ends before its {element.count} {element.name} rows do")
        rows = np.frombuffer(body, dtype, element.count, position) if size else np.empty(0, dtype)
        table[element.name] = _columns(element, rows)
        position += size
    if position != len(body):
        raise ValueError(f"{len(body) - position} bytes are left over after the last row")
    return table


def _row_type(element: _Element, order: str, start: bytes, is_text: bool) -> np.dtype[Any]:
    """Return the type of an element's rows; the first row, in ``start``, tells how long its lists are."""
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for name, kind, counter in element.properties:
        item = "<f8" if is_text else order + kind
        if counter is None:
            fields.append((name, item))
            continue
        fields.append((f"{name} count", "<f8" if is_text else order + counter))
        so_far = np.dtype(fields)
        if not element.count:
            length = 3.0
        elif so_far.itemsize <= len(start):
            length = float(np.frombuffer(start, so_far, 1)[f"{name} count"][0])
        else:
            raise ValueError(f"it ends before its {element.count} {element.name} rows do")
        if not 3 <= length <= 255 or length != int(length):
            raise ValueError(
                f"the first {name} list of {element.name} has {length:g} entries, expected 3 to 255"
            )
        fields.append((name, item, (int(length),)))
    return np.dtype(fields)


def _columns(element: _Element, rows: ndarray) -> Columns:
    """Return a column for each property, lists as (n, k). Raises ``ValueError`` where k varies."""
    for name, _, counter in element.properties:
        if counter is None:
            continue
        counts, expected = rows[f"{name} count"], rows[name].shape[1]
        other = np.flatnonzero(counts != expected)
        if len(other):
            raise ValueError(
                f"{element.name} {other[0]} has {counts[other[0]]:g} corners and the first {expected}; "
                "triangulate the mesh first"
            )
    return {name: rows[name] for name, _, _ in element.properties}


def _whole(column: ndarray, name: str) -> Int64[ndarray, "*n"]:
    """Return whole numbers of any type as int64. Raises ``ValueError`` for fractions and the like."""
    with np.errstate(invalid="ignore"):
        wrong = ~((column == np.floor(column)) & (np.abs(column.astype(np.float64)) < _MAX_WHOLE))
    if wrong.any():
        raise ValueError(f"{name} {column[wrong][0]} found, expected whole numbers")
    return column.astype(np.int64)
