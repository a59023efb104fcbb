"""Reader of PLY files, text and binary: the vertices and polygons of any file with these two elements.

The counts of the header must be those of the content. Other elements and properties are skipped.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from jaxtyping import Float, Int64, Shaped
from numpy import ndarray

from dataset_builder.user_files.mesh_formats.parsing import (
    MalformedMeshError,
    Surface,
    check_finite,
    first_true,
    parse_numbers,
    shown,
    triangulate,
)

_TYPES = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
    "int64": "q",
    "uint64": "Q",
}
"""Codes of the types, which NumPy and the module ``struct`` share."""
_HEADER_BYTES = 1 << 16
_HEADER = re.compile(rb"ply[ \t]*\r?\n(.*?\n)?[ \t]*end_header[ \t]*(?:\r?\n|\Z)", re.DOTALL)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POLYGONS = ("vertex_index", "vertex_indices")


@dataclass(frozen=True)
class _Property:
    """Property of an element: type codes of the values, and of the number of values if they are a list."""

    name: str
    values: str
    count: str | None = None


@dataclass(frozen=True)
class _Element:
    """Element of the header, ``count`` rows with these properties."""

    name: str
    count: int
    properties: list[_Property]


@dataclass(frozen=True, eq=False)
class _Lists:
    """Values of a list property: the number of values of each row, and all values in one array."""

    sizes: Int64[ndarray, " n"]
    values: Shaped[ndarray, " m"]


_Columns = Mapping[str, ndarray | _Lists]
"""Values of an element by property."""


def read_ply(content: bytes) -> Mapping[str, Surface]:
    """Return the vertices and the triangulated polygons of a PLY file, as one object without a name.

    Raises ``MalformedMeshError`` if the header is malformed, if counts in it are not those of the content, if
    there are no vertices or faces, or for a property ``bar_id``, which only files in another layout have.
    """
    header = _HEADER.match(content[:_HEADER_BYTES])
    if header is None:
        raise MalformedMeshError("syntax", "", "no PLY header", '"ply" to "end_header"')
    order, elements = _parse_header((header[1] or b"").split(b"\n"))
    if any(item.name == "bar_id" for element in elements for item in element.properties):
        raise MalformedMeshError(
            "conflict",
            "header",
            "the file has the property bar_id, but not this dataset's PLY layout",
            "a file without bar_id, whose connected components are numbered as bars",
        )
    body = content[header.end() :]
    elements = [element for element in elements if element.properties]
    read = _binary_elements(elements, body, order) if order else _text_elements(elements, body)
    vertices, triangles = _vertices(read.get("vertex", {})), _triangles(read.get("face", {}))
    check_finite(vertices, lambda row: f"vertex {row}")
    row = first_true(((triangles < 0) | (triangles >= len(vertices))).any(axis=1))
    if row is not None:
        found = f"the corners are the vertices {triangles[row].tolist()}"
        raise MalformedMeshError("invalid", f"triangle {row}", found, f"0 to {len(vertices) - 1}")
    return {"": (vertices, triangles)}


def _parse_header(lines: Sequence[bytes]) -> tuple[str, list[_Element]]:
    """Return the byte order ("": text) and the elements."""
    order, elements = None, list[_Element]()
    for number, line in enumerate(lines, start=2):
        match line.decode("latin-1").split():
            case ["format", name, "1.0"] if name in _ORDERS and order is None:
                order = _ORDERS[name]
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count, re.ASCII):
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, values, name] if elements and _are_list_types(count, values):
                elements[-1].properties.append(_Property(name, _TYPES[values], _TYPES[count]))
            case ["property", values, name] if elements and values in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[values]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise MalformedMeshError("syntax", f"line {number}", f"found {shown(line)}", "a PLY header")
    if order is None:
        raise MalformedMeshError("missing", "header", "no format", " or ".join(_ORDERS))
    for names in ([e.name for e in elements], *([item.name for item in e.properties] for e in elements)):
        if len(set(names)) < len(names):
            raise MalformedMeshError(
                "duplicate", "header", "an element or property occurs twice", "each name once"
            )
    return order, elements


def _are_list_types(count: str, values: str) -> bool:
    return _TYPES.get(count, "f") not in "fd" and values in _TYPES


def _vertices(columns: _Columns) -> Float[ndarray, "v 3"]:
    """Return the coordinates as float32 or float64, as the file has them."""
    axes = [column for axis in "xyz" if isinstance(column := columns.get(axis), ndarray)]
    if len(axes) < 3:
        raise MalformedMeshError("missing", "header", "no vertices with the properties x, y and z", "a mesh")
    vertices = np.column_stack(axes)
    return vertices if vertices.dtype == np.float32 else vertices.astype(np.float64)


def _triangles(columns: _Columns) -> Int64[ndarray, "n 3"]:
    """Return the triangles of the polygons; raise ``MalformedMeshError`` if one has no three whole corners.

    Lists of other lengths would also fit most content that is damaged, since a list states its own length.
    """
    lists = {name: column for name, column in columns.items() if isinstance(column, _Lists)}
    found = [column for name, column in lists.items() if name in _POLYGONS]
    if not found and len(lists) == 1:
        found = [*lists.values()]
    if not found or not len(found[0].sizes):
        return np.empty((0, 3), np.int64)
    sizes, corners = found[0].sizes, found[0].values
    short = first_true(sizes < 3)
    if short is not None:
        raise MalformedMeshError("damaged", f"face {short}", f"{sizes[short]} corners", "three or more")
    fraction = first_true(corners != np.floor(corners))
    if fraction is not None:
        raise MalformedMeshError("invalid", "face", f"a corner is vertex {corners[fraction]}", "a whole number")
    corners = corners.astype(np.int64)
    if (sizes == sizes[0]).all():
        return triangulate(corners.reshape(len(sizes), -1))
    return triangulate(np.split(corners, np.cumsum(sizes)[:-1]))


def _text_elements(elements: Sequence[_Element], body: bytes) -> dict[str, _Columns]:
    """Return the values of each element; every row is one line."""
    if body.strip() and not body.endswith((b"\n", b"\r")):
        raise MalformedMeshError("damaged", "", "truncated: the last row has no line end", "complete rows")
    rows = [line for line in body.splitlines() if line.strip()]
    total = sum(element.count for element in elements)
    if len(rows) != total:
        found = f"truncated or damaged: {len(rows)} rows after the header"
        raise MalformedMeshError("damaged", "", found, f"{total} as in the header")
    following = iter(rows)
    return {element.name: _text_columns(element, [*islice(following, element.count)]) for element in elements}


def _text_columns(element: _Element, rows: Sequence[bytes]) -> _Columns:
    """Return the values of the rows of an element, of which one property after the other is read."""
    numbers = parse_numbers(rows, lambda row: f"{element.name} {row}")
    row_sizes = np.array([len(row.split()) for row in rows], np.int64)
    ends = np.cumsum(row_sizes)
    at = ends - row_sizes
    columns: dict[str, ndarray | _Lists] = {}
    for item in element.properties:
        values, is_sound = np.take(numbers, at, mode="clip"), at < ends
        at = at + 1
        if item.count is None:
            with np.errstate(over="ignore"):  # A number beyond float32 becomes infinite and is refused.
                columns[item.name] = values.astype(item.values)
        else:
            is_sound &= (values >= 0) & (values <= ends - at) & (values == np.floor(values))
            sizes = np.where(is_sound, values, 0).astype(np.int64)
            inside = np.arange(sizes.sum()) + np.repeat(at - np.cumsum(sizes) + sizes, sizes)
            columns[item.name] = _Lists(sizes, numbers[inside])
            at = at + sizes
        # Only the rows before the first one that is not sound are read on, so that the time is linear.
        sound_rows = first_true(~is_sound)
        at, ends = at[:sound_rows], ends[:sound_rows]
    row = first_true(np.append(at != ends, len(at) < len(rows)))
    if row is not None:
        found = f"found {shown(rows[row])}"
        raise MalformedMeshError("damaged", f"{element.name} {row}", found, "the values that the header lists")
    return columns


def _binary_elements(elements: Sequence[_Element], body: bytes, order: str) -> dict[str, _Columns]:
    """Return the values of each element; ``order`` is "<" or ">"."""
    read: dict[str, _Columns] = {}
    start = 0
    for element in elements:
        columns = _equal_rows(element, body, start, order) or _unequal_rows(element, body, start, order)
        read[element.name], start = columns
    if body[start:].strip(b"\r\n"):
        found = f"damaged: {len(body) - start} bytes after the last row"
        raise MalformedMeshError("damaged", "", found, "as many rows as in the header")
    return read


def _equal_rows(element: _Element, body: bytes, start: int, order: str) -> tuple[_Columns, int] | None:
    """Return the values of an element and the position of its end, or None if its lists differ in length.

    Raises ``MalformedMeshError`` before anything is allocated if the content is too short.
    """
    fields: list[Any] = []
    for item in element.properties:
        shape: tuple[int, ...] = ()
        if item.count is not None:
            position, count = start + np.dtype(fields).itemsize, np.dtype(order + item.count)
            first = body[position : position + count.itemsize]
            shape = (int.from_bytes(first, "little" if order == "<" else "big"),)
            if shape[0] * np.dtype(item.values).itemsize > len(body):
                return None
            fields.append((f"{item.name} count", count))
        fields.append((item.name, order + item.values, shape))
    dtype = np.dtype(fields)
    if start + element.count * dtype.itemsize > len(body):
        if any(item.count for item in element.properties):
            return None
        raise _too_short(element)
    rows = np.frombuffer(body, dtype, element.count, start)
    columns: dict[str, ndarray | _Lists] = {}
    for item in element.properties:
        values = columns[item.name] = rows[item.name]
        if item.count is not None:
            if (rows[f"{item.name} count"] != values.shape[1]).any():
                return None
            columns[item.name] = _Lists(np.broadcast_to(values.shape[1], len(values)), values.ravel())
    return columns, start + rows.nbytes


def _unequal_rows(element: _Element, body: bytes, start: int, order: str) -> tuple[_Columns, int]:
    """Return the values of an element with lists of different lengths, and the position of its end."""
    sizes: list[list[int]] = [[] for _ in element.properties]
    values: list[list[Any]] = [[] for _ in element.properties]
    try:
        for _ in range(element.count):
            for number, item in enumerate(element.properties):
                size = 1
                if item.count is not None:
                    [size] = struct.unpack_from(order + item.count, body, start)
                    start += struct.calcsize(item.count)
                form = f"{order}{size}{item.values}"
                values[number] += struct.unpack_from(form, body, start)
                start += struct.calcsize(form)
                sizes[number].append(size)
    except struct.error:  # The content ends, or a length is negative.
        raise _too_short(element) from None
    columns: dict[str, ndarray | _Lists] = {}
    for item, item_sizes, item_values in zip(element.properties, sizes, values, strict=True):
        array = columns[item.name] = np.array(item_values, item.values)
        if item.count is not None:
            columns[item.name] = _Lists(np.array(item_sizes, np.int64), array)
    return columns, start


def _too_short(element: _Element) -> MalformedMeshError:
    found = f"truncated or damaged: the file ends within the {element.count} rows of {element.name}"
    return MalformedMeshError("damaged", "", found, "as many rows as in the header")
