"""Reader of PLY files, text and binary: the vertices and polygons of any file with these two elements.

The counts of the header must agree with the content. Other elements and properties are skipped. The numbers of a
text are read as those of a binary file of 64-bit numbers, whose rows must be the lines.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from itertools import islice

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from numpy import ndarray

from dataset_builder.user_files.mesh_formats.parsing import NUMBER, MalformedMeshError, Surface, shown, triangulate

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
_HEADER = re.compile(
    rb"ply[ \t]*(?:\r?\n|(?P<cr>\r))(.*?[\r\n])?[ \t]*end_header[ \t]*(?:(?(cr)\r|\r?\n)|\Z)", re.DOTALL
)
"""Header, whose lines end with LF, CR LF, or all with CR: then a line feed behind it belongs to the content."""
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POLYGONS = ("vertex_index", "vertex_indices")
_NUMBERS = re.compile(
    rb"\s*+(?:(?:%b|[-+]?nan(?:\(\w*\))?|[-+]?inf(?:inity)?)(?:\s++|\Z))*+" % NUMBER, re.IGNORECASE
)

_Properties = dict[str, tuple[str, str]]
"""By name: type of the values, and of their number before them if they are a list, else an empty text."""
_Columns = dict[str, tuple[ndarray, ndarray]]
"""By property: number of values in each row, and all values."""


def read_ply(content: bytes) -> Mapping[str, Surface]:
    """Return the vertices and the triangulated polygons of a PLY file, as one object without a name.

    Raises ``MalformedMeshError`` if the header is malformed, if its counts disagree with the content, if
    there are no vertices, or for a property ``bar_id``, which only files in another layout have.
    """
    header = _HEADER.match(content[:_HEADER_BYTES])
    if header is None:
        raise MalformedMeshError("syntax", "", "no PLY header", '"ply" to "end_header"')
    order, elements = _parse_header((header[2] or b"").splitlines())
    elements = {name: (count, properties) for name, (count, properties) in elements.items() if properties}
    if any("bar_id" in properties for _, properties in elements.values()):
        raise MalformedMeshError(
            "conflict",
            "header",
            "the file has the property bar_id, but not this dataset's PLY layout",
            "a file without bar_id, whose connected components are numbered as bars",
        )
    types = elements.get("vertex", (0, {}))[1]
    if any(types.get(axis, ("", "list"))[1] for axis in "xyz"):
        raise MalformedMeshError("missing", "header", "no vertices with the properties x, y and z", "a mesh")
    body, start, columns = content[header.end() :], 0, dict[str, _Columns]()
    if not order:
        order, body = "=", _checked_numbers(elements, body).tobytes()
        elements = {
            name: (count, {item: ("d", size and "d") for item, (_, size) in properties.items()})
            for name, (count, properties) in elements.items()
        }
    for name, (count, properties) in elements.items():
        columns[name], start = _columns(name, count, properties, body, start, order)
    if body[start:].strip(b"\r\n"):
        found = f"damaged: {len(body) - start} bytes after the last row"
        raise MalformedMeshError("damaged", "", found, "as many rows as in the header")
    is_single = all(types[axis][0] == "f" for axis in "xyz")
    vertices = np.column_stack([columns["vertex"][axis][1] for axis in "xyz"])
    lists = [item for item, (_, size) in elements.get("face", (0, {}))[1].items() if size]
    polygons = [item for item in lists if item in _POLYGONS] or lists
    triangles = np.empty((0, 3), np.int64)
    if len(polygons) == 1:
        triangles = _triangles(*columns["face"][polygons[0]])
    return {"": (vertices.astype(np.float32 if is_single else np.float64), triangles)}


def _parse_header(lines: Sequence[bytes]) -> tuple[str, dict[str, tuple[int, _Properties]]]:
    """Return the byte order ("": text), and the elements by name: number of rows and properties."""
    order, elements = None, dict[str, tuple[int, _Properties]]()
    properties: _Properties = {}
    for number, line in enumerate(lines, start=2):
        match line.decode("latin-1").split():
            case ["format", name, "1.0"] if name in _ORDERS and order is None:
                order = _ORDERS[name]
            case ["element", name, count] if re.fullmatch(r"[0-9]{1,18}", count) and name not in elements:
                properties = {}
                elements[name] = int(count), properties
            case ["property", "list", size, values, name] if (
                elements and name not in properties and _TYPES.get(size, "f") not in "fd" and values in _TYPES
            ):
                properties[name] = _TYPES[values], _TYPES[size]
            case ["property", values, name] if elements and name not in properties and values in _TYPES:
                properties[name] = _TYPES[values], ""
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                expected = "a PLY header, in which a name occurs once"
                raise MalformedMeshError("syntax", f"line {number}", f"found {shown(line)}", expected)
    if order is None:
        raise MalformedMeshError("missing", "header", "no format", " or ".join(_ORDERS))
    return order, elements


def _checked_numbers(elements: Mapping[str, tuple[int, _Properties]], body: bytes) -> Float64[ndarray, " n"]:
    """Return the numbers of a text; raise ``MalformedMeshError`` if its lines are not the rows of the header."""
    if body.strip() and not body.endswith((b"\n", b"\r")):
        raise MalformedMeshError("damaged", "", "truncated: the last row has no line end", "complete rows")
    lines = [line for line in body.splitlines() if line.strip()]
    total = sum(count for count, _ in elements.values())
    if len(lines) != total:
        found = f"truncated or damaged: {len(lines)} rows after the header"
        raise MalformedMeshError("damaged", "", found, f"{total} as in the header")
    following = iter(lines)
    for name, (count, properties) in elements.items():
        for row, line in enumerate(islice(following, count)):
            if not _NUMBERS.fullmatch(line) or not _is_row(line.split(), properties):
                found, expected = f"found {shown(line)}", "the numbers that the header lists"
                raise MalformedMeshError("damaged", f"{name} {row}", found, expected)
    return np.fromstring(b" ".join(lines), sep=" ") if lines else np.empty(0)


def _is_row(words: Sequence[bytes], properties: _Properties) -> bool:
    """Return whether numbers are the values of these properties, and those of lists follow their number."""
    at = 0
    for _, size in properties.values():
        if size:
            listed = float(words[at]) if at < len(words) else -1.0
            if not (0 <= listed < len(words) and listed.is_integer()):
                return False
            at += int(listed)
        at += 1
    return at == len(words)


def _columns(
    name: str, count: int, properties: _Properties, body: bytes, start: int, order: str
) -> tuple[_Columns, int]:
    """Return the values of an element and the position of its end; raise ``MalformedMeshError`` if it is cut."""
    found = f"truncated or damaged: the file ends within the {count} rows of {name}"
    too_short = MalformedMeshError("damaged", "", found, "as many rows as in the header")
    least = sum(struct.calcsize(order + (size or value)) for value, size in properties.values())
    if start + count * least > len(body):
        raise too_short
    if not any(size for _, size in properties.values()):
        row = np.dtype([(item, order + value) for item, (value, _) in properties.items()])
        rows = np.frombuffer(body, row, count, start)
        return {item: (np.ones(count, np.int64), rows[item]) for item in properties}, start + rows.nbytes
    sizes: dict[str, list[int]] = {item: [] for item in properties}
    pieces: dict[str, list[bytes]] = {item: [] for item in properties}
    layout = [
        (item, size and struct.Struct(order + size), struct.calcsize(order + value))
        for item, (value, size) in properties.items()
    ]
    for _ in range(count):
        for item, size, width in layout:
            length = 1
            if size:
                if start + size.size > len(body):
                    raise too_short
                length = int(size.unpack_from(body, start)[0])
                start += size.size
            end = start + length * width
            if not start <= end <= len(body):
                raise too_short
            sizes[item].append(length)
            pieces[item].append(body[start:end])
            start = end
    return {
        item: (np.array(sizes[item], np.int64), np.frombuffer(b"".join(pieces[item]), order + value))
        for item, (value, _) in properties.items()
    }, start


def _triangles(sizes: Int64[ndarray, " n"], corners: Shaped[ndarray, " m"]) -> Int64[ndarray, "n 3"]:
    """Return the triangles of polygons; raise ``MalformedMeshError`` if one has no three whole corners.

    Lists of other lengths would also fit most content that is damaged, since a list states its own length.
    """
    if sizes.min(initial=3) < 3:
        found = f"{sizes.min()} corners"
        raise MalformedMeshError("damaged", f"face {sizes.argmin()}", found, "three or more")
    fractions = corners[corners != np.floor(corners)]
    if len(fractions):
        raise MalformedMeshError("invalid", "face", f"a corner is vertex {fractions[0]}", "a whole number")
    corners = corners.astype(np.int64)
    if (sizes == sizes[:1]).all():
        return triangulate(corners.reshape(len(sizes), -1)) if len(sizes) else np.empty((0, 3), np.int64)
    return triangulate(np.split(corners, np.cumsum(sizes)[:-1]))
