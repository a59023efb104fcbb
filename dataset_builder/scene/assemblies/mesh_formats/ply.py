"""Reader of PLY files, text and binary: the vertices and polygons of any file with these two elements.

The counts of the header must be those of the content. Other elements and properties are skipped.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from dataset_builder.scene.assemblies.mesh_formats.parsing import (
    MalformedMeshError,
    Surface,
    check_surface,
    first_true,
    shown,
    triangulate,
)
from dataset_builder.scene.assemblies.mesh_formats.ply_rows import (
    Columns,
    Element,
    Property,
    binary_elements,
    text_elements,
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
