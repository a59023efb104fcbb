"""Reader of PLY files, text and binary: the vertices and polygons of any file with these two elements.

The counts of the header must be those of the content. Other elements and properties are skipped.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.scene.assemblies.mesh_formats.parsing import (
    MalformedMeshError,
    Surface,
    check_surface,
    first_true,
    parse_numbers,
    shown,
    triangulate,
)

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
}
_HEADER_BYTES = 1 << 16
_HEADER = re.compile(rb"ply[ \t]*\r?\n(.*?\n)?[ \t]*end_header[ \t]*(?:\r?\n|\Z)", re.DOTALL)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POLYGONS = ("vertex_index", "vertex_indices")
_CODES = dict(zip(("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), "bBhHiIqQfd", strict=True))
"""Codes of the module ``struct`` by NumPy type."""

Columns = Mapping[str, Any]
"""Values of an element by property, one for each row; those of a list property are sequences."""


@dataclass(frozen=True)
class Property:
    """Property of an element: NumPy types of the values, and of the number of values if they are a list."""

    name: str
    values: str
    count: str | None = None


@dataclass
class Element:
    """Element of the header, ``count`` rows with these properties."""

    name: str
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        """Return whether a property is a list."""
        return any(item.count for item in self.properties)


def read_ply(content: bytes) -> Surface:
    """Return the vertices and the triangulated polygons of a PLY file.

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
    read = text_elements(elements, body) if not order else binary_elements(elements, body, order)
    vertices = _vertices(elements, read)
    return check_surface(
        (vertices, _triangles(elements, read)), lambda row: f"vertex {row}", lambda row: f"triangle {row}"
    )


def _parse_header(lines: Sequence[bytes]) -> tuple[str, list[Element]]:
    """Return the byte order ("": text) and the elements."""
    order, elements = None, list[Element]()
    for number, line in enumerate(lines, start=2):
        match line.decode("latin-1").split():
            case ["format", name, "1.0"] if name in _ORDERS and order is None:
                order = _ORDERS[name]
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count, re.ASCII):
                elements.append(Element(name, int(count), []))
            case ["property", "list", count, values, name] if elements and _are_list_types(count, values):
                elements[-1].properties.append(Property(name, _TYPES[values], _TYPES[count]))
            case ["property", values, name] if elements and values in _TYPES:
                elements[-1].properties.append(Property(name, _TYPES[values]))
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
    return _TYPES.get(count, "f")[0] != "f" and values in _TYPES


def _vertices(elements: Sequence[Element], read: Mapping[str, Columns]) -> ndarray:
    """Return the coordinates, (n, 3), rounded to the type that the header gives them, as float32 or float64."""
    types = {
        item.name: item.values for e in elements if e.name == "vertex" for item in e.properties if not item.count
    }
    if not {"x", "y", "z"} <= types.keys():
        raise MalformedMeshError("missing", "header", "no vertices with the properties x, y and z", "a mesh")
    columns = read["vertex"]
    with np.errstate(over="ignore"):  # A number beyond float32 becomes infinite and is refused.
        vertices = np.column_stack([np.asarray(columns[axis]).astype(types[axis]) for axis in "xyz"])
    return vertices if vertices.dtype == np.float32 else vertices.astype(np.float64)


def _triangles(elements: Sequence[Element], read: Mapping[str, Columns]) -> Int64[ndarray, "n 3"]:
    """Return the triangles of the polygons; raise ``MalformedMeshError`` if one has no three whole corners.

    Lists of other lengths would also fit most content that is damaged, since a list states its own length.
    """
    lists = [item.name for e in elements if e.name == "face" for item in e.properties if item.count]
    names = [name for name in lists if name in _POLYGONS] or (lists if len(lists) == 1 else [])
    polygons = read["face"][names[0]] if names else []
    sizes = [len(polygon) for polygon in polygons]
    if not sizes:
        return np.empty((0, 3), np.int64)
    short = first_true(np.array(sizes) < 3)
    if short is not None:
        raise MalformedMeshError("damaged", f"face {short}", f"{sizes[short]} corners", "three or more")
    corners = (
        np.asarray(polygons).ravel() if len(set(sizes)) == 1 else np.array(list(chain.from_iterable(polygons)))
    )
    fraction = first_true(corners != np.floor(corners))
    if fraction is not None:
        raise MalformedMeshError("invalid", "face", f"a corner is vertex {corners[fraction]}", "a whole number")
    corners = corners.astype(np.int64)
    if len(set(sizes)) == 1:
        return triangulate(corners.reshape(len(sizes), -1))
    return triangulate(np.split(corners, np.cumsum(sizes)[:-1]))


def text_elements(elements: Sequence[Element], body: bytes) -> dict[str, Columns]:
    """Return the values of each element; every row is one line."""
    if body.strip() and not body.endswith((b"\n", b"\r")):
        raise MalformedMeshError("damaged", "", "truncated: the last row has no line end", "complete rows")
    rows = [line for line in body.splitlines() if line.strip()]
    total = sum(element.count for element in elements if element.properties)
    if len(rows) != total:
        found = f"truncated or damaged: {len(rows)} rows after the header"
        raise MalformedMeshError("damaged", "", found, f"{total} as in the header")
    read: dict[str, Columns] = {}
    start = 0
    for element in elements:
        if element.properties:
            read[element.name] = _text_columns(element, rows[start : start + element.count])
            start += element.count
    return read


def _text_columns(element: Element, rows: Sequence[bytes]) -> Columns:
    table = parse_numbers(rows, lambda row: f"{element.name} {row}")
    sizes = [len(row.split()) for row in rows]
    equal = _equal_columns(element.properties, table.reshape(len(rows), -1)) if len(set(sizes)) == 1 else None
    if equal is not None:
        return equal
    numbers = table.tolist()
    columns: list[list[Any]] = [[] for _ in element.properties]
    start = 0
    for row, line in enumerate(rows):
        end = start + sizes[row]
        values = _row_values(element.properties, numbers[start:end])
        if values is None:
            found = f"found {shown(line)}"
            raise MalformedMeshError("damaged", f"{element.name} {row}", found, "the values that the header lists")
        for column, value in zip(columns, values, strict=True):
            column.append(value)
        start = end
    return {item.name: column for item, column in zip(element.properties, columns, strict=True)}


def _equal_columns(properties: Sequence[Property], table: Float64[ndarray, "n k"]) -> Columns | None:
    """Return the columns of rows whose lists have equal lengths, or None if these or the rows differ from that."""
    columns, column = {}, 0
    for item in properties:
        if column >= table.shape[1]:
            return None
        width = 1
        if item.count is not None:
            lengths = table[:, column]
            if not 0 <= lengths[0] < table.shape[1] or (lengths != int(lengths[0])).any():
                return None
            width = int(lengths[0])
            column += 1
        columns[item.name] = table[:, column] if item.count is None else table[:, column : column + width]
        column += width
    return columns if column == table.shape[1] else None


def _row_values(properties: Sequence[Property], numbers: Sequence[float]) -> list[Any] | None:
    """Return the value of each property, a list for each list, or None if the numbers are more or fewer."""
    values: list[Any] = []
    position = 0
    for item in properties:
        if position >= len(numbers):
            return None
        if item.count is None:
            values.append(numbers[position])
            position += 1
        else:
            length = numbers[position]
            if not (0 <= length < len(numbers) and length == int(length)):
                return None
            values.append(numbers[position + 1 : position + 1 + int(length)])
            position += 1 + int(length)
    return values if position == len(numbers) else None


def binary_elements(elements: Sequence[Element], body: bytes, order: str) -> dict[str, Columns]:
    """Return the values of each element; ``order`` is "<" or ">"."""
    read: dict[str, Columns] = {}
    start = 0
    for element in elements:
        if element.properties:
            rows = _equal_rows(element, body, start, order)
            if rows is not None:
                read[element.name] = {item.name: rows[item.name] for item in element.properties}
                start += rows.nbytes
            else:
                read[element.name], start = _unequal_rows(element, body, start, order)
    if body[start:].strip(b"\r\n"):
        found = f"damaged: {len(body) - start} bytes after the last row"
        raise MalformedMeshError("damaged", "", found, "as many rows as in the header")
    return read


def _equal_rows(element: Element, body: bytes, start: int, order: str) -> ndarray | None:
    """Return the rows of an element, or None if its lists differ in length.

    Raises ``MalformedMeshError`` before anything is allocated if the content is too short.
    """
    fields: list[Any] = []
    for item in element.properties:
        if item.count is None:
            fields.append((item.name, order + item.values))
            continue
        fields.append((f"{item.name} count", order + item.count))
        position = start + np.dtype(fields).itemsize - np.dtype(item.count).itemsize
        length = int.from_bytes(
            body[position : position + np.dtype(item.count).itemsize], "little" if order == "<" else "big"
        )
        if length * np.dtype(item.values).itemsize > len(body):
            return None
        fields.append((item.name, order + item.values, (length,)))
    dtype = np.dtype(fields)
    if start + element.count * dtype.itemsize > len(body):
        if element.has_lists:
            return None
        raise _too_short(element)
    rows = np.frombuffer(body, dtype, element.count, start)
    lengths = [(f"{item.name} count", rows[item.name].shape[1]) for item in element.properties if item.count]
    return rows if all((rows[name] == length).all() for name, length in lengths) else None


def _unequal_rows(element: Element, body: bytes, start: int, order: str) -> tuple[Columns, int]:
    """Return the values of an element with lists of different lengths, and the position of its end."""
    columns: dict[str, list[Any]] = {item.name: [] for item in element.properties}
    try:
        for _ in range(element.count):
            for item in element.properties:
                length = 1
                if item.count is not None:
                    [length] = struct.unpack_from(order + _CODES[item.count], body, start)
                    start += struct.calcsize(_CODES[item.count])
                form = f"{order}{length}{_CODES[item.values]}"
                values = struct.unpack_from(form, body, start)
                start += struct.calcsize(form)
                columns[item.name].append(values[0] if item.count is None else values)
    except struct.error:  # The content ends, or a length is negative.
        raise _too_short(element) from None
    return columns, start


def _too_short(element: Element) -> MalformedMeshError:
    found = f"truncated or damaged: the file ends within the {element.count} rows of {element.name}"
    return MalformedMeshError("damaged", "", found, "as many rows as in the header")
