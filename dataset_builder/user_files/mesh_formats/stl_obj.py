"""Readers of STL files, binary and text, and of Wavefront OBJ files.

An STL file is binary if its size is that of the triangle count in its header, also if it begins with "solid", as
files of several programs do. Normals, attributes and names are ignored.

Of an OBJ file the vertices, polygons and the objects that they belong to are read. Texture coordinates, normals,
groups, materials, lines and points are ignored, and the files that a material library or a texture names are never
opened.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.user_files.mesh_formats.parsing import (
    BYTE_ORDER_MARK,
    MalformedMeshError,
    Surface,
    check_finite,
    first_true,
    parse_numbers,
    shown,
    triangulate,
)

_HEADER_BYTES = 84
_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])

_SOLID = re.compile(rb"\s*solid\b[^\r\n]*", re.IGNORECASE)
_FACET = re.compile(
    rb"\s*facet(?:\s+normal(?:\s+\S+){3})?\s+outer\s*loop"
    rb"((?:\s+vertex(?:\s+\S+){3}){3})\s+end\s*loop\s+end\s*facet\b",
    re.IGNORECASE,
)
_VERTEX = re.compile(rb"vertex\b", re.IGNORECASE)
_END = re.compile(rb"\s*end\s*solid\b[^\r\n]*", re.IGNORECASE)
_PADDING = b"\0\x1a"
"""Bytes that some programs append: zeros, and the end-of-file character of DOS."""


def read_stl(content: bytes) -> Mapping[str, Surface]:
    """Return the triangles of all solids, in order, as one object without a name; each has its own three vertices.

    Raises ``MalformedMeshError`` if the content is neither a binary nor a text STL, or is truncated.
    """
    corners = _binary_corners(content)
    if corners is None:
        corners = _text_corners(content)
    check_finite(corners, _corner_place)
    return {"": (corners, np.arange(len(corners)).reshape(-1, 3))}


def _binary_corners(content: bytes) -> ndarray | None:
    """Return the corners of a binary STL, (3 n, 3), or None if the content is a text.

    Raises ``MalformedMeshError`` if the content is neither.
    """
    triangles = int.from_bytes(content[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")
    size = _HEADER_BYTES + triangles * _TRIANGLE.itemsize
    if len(content) == size:
        rows = np.frombuffer(content, _TRIANGLE, triangles, _HEADER_BYTES)
        return rows["corners"].reshape(-1, 3).astype(np.float32)
    if _SOLID.match(content.removeprefix(BYTE_ORDER_MARK)) and b"\0" not in content[:_HEADER_BYTES]:
        return None
    if len(content) < _HEADER_BYTES:
        raise MalformedMeshError("syntax", "", f"{len(content)} bytes", "a text or binary STL file")
    found = f"truncated or damaged: the header counts {triangles} triangles, but the file has {len(content)} bytes"
    raise MalformedMeshError("damaged", "", found, f"{size}")


def _text_corners(content: bytes) -> ndarray:
    """Return the corners of a text STL, (3 n, 3)."""
    text = content.removeprefix(BYTE_ORDER_MARK).rstrip(_PADDING).rstrip()
    corners: list[bytes] = []
    position = 0
    while position < len(text):
        position = _matched(_SOLID, text, position, '"solid"').end()
        while facet := _FACET.match(text, position):
            corners.append(facet[1])
            position = facet.end()
        position = _matched(_END, text, position, 'a facet of three vertices, or "endsolid"').end()
    rows = [_VERTEX.sub(b"", row) for row in corners]
    return parse_numbers(rows, lambda row: _corner_place(3 * row)).reshape(-1, 3)


def _corner_place(corner: int) -> str:
    return f"triangle {corner // 3 + 1}"


def _matched(pattern: re.Pattern[bytes], text: bytes, position: int, expected: str) -> re.Match[bytes]:
    """Return the match at ``position``; raise ``MalformedMeshError`` that names the line if there is none."""
    if match := pattern.match(text, position):
        return match
    start = position + len(text[position:]) - len(text[position:].lstrip())
    line = text.count(b"\n", 0, start) + 1
    rest = text[start : start + 200].splitlines()
    found = f"found {shown(rest[0])}" if rest else "the file ends"
    raise MalformedMeshError("damaged", f"line {line}", found, expected)


_NOT_READ = (b"curv", b"curv2", b"surf", b"cstype", b"call", b"csh")
"""Statements of free-form curves and surfaces, and of other files: without them, a part would be missing."""
_UNNAMED = b"geometry"
"""Name of the object of faces that precede the first name."""
_NUMBERS_OF_VERTICES = {3, 6}
"""Numbers of a vertex, without and with a colour, which may both occur in one file."""
_CORNERS = re.compile(rb"(?:-?\d+(?:/-?\d*){0,2}(?: +|$))*+")
_NUMERIC = re.compile(rb"[-+./eE]*+\d[-+.\d/eE]*+")
_CONTINUATION = re.compile(rb"(?<=[\d/ ])\\\r?\n")
"""End of a line of numbers that continues; a path in a comment may end in a backslash too."""
_IGNORED = {b"vt", b"vn", b"vp", b"vc", b"l", b"p", b"s", b"g", b"mg", b"lod", b"usemtl", b"mtllib"}
"""Statements that do not affect the surfaces and may consist of numbers."""


@dataclass(frozen=True)
class _Rows:
    """Statements of one kind: line numbers from 1, texts, and the number of vertices above each of them."""

    lines: list[int] = field(default_factory=list)
    texts: list[bytes] = field(default_factory=list)
    vertices_above: list[int] = field(default_factory=list)

    def place(self, row: int) -> str:
        """Return the place of a statement in messages."""
        return f"line {self.lines[row]}"


def read_obj(content: bytes) -> Mapping[str, Surface]:
    """Return the objects of the file by name, each with all vertices of the file and its own triangles.

    Raises ``MalformedMeshError`` if a vertex or face is malformed, or the file has surfaces that are no polygons.
    """
    vertex_rows, face_rows = _statements(content)
    vertices = _vertices(vertex_rows)
    triangles = {_decoded(name): _triangles(rows, len(vertices)) for name, rows in face_rows.items()}
    check_finite(vertices, vertex_rows.place)
    return {name: (vertices, faces) for name, faces in triangles.items()}


def _statements(content: bytes) -> tuple[_Rows, Mapping[bytes, _Rows]]:
    """Return the vertices, and the faces of each object; continued lines count as one.

    Raises ``MalformedMeshError`` for a line that would be a vertex or face if its first word were not damaged.
    """
    vertices, faces = _Rows(), defaultdict[bytes, _Rows](_Rows)
    current = faces[_UNNAMED]
    text = _CONTINUATION.sub(b" ", content.removeprefix(BYTE_ORDER_MARK).replace(b"\t", b" "))
    for number, line in enumerate(text.splitlines(), start=1):
        key, _, rest = line.strip().partition(b" ")
        if key == b"v":
            vertices.lines.append(number)
            vertices.texts.append(rest.partition(b" #")[0])
        elif key == b"f":
            current.lines.append(number)
            current.texts.append(rest.partition(b" #")[0].strip())
            current.vertices_above.append(len(vertices.lines))
        elif key == b"o":
            current = faces[rest.strip() or _UNNAMED]
        elif key and key not in _IGNORED and not key.startswith(b"#"):
            _check_unknown(number, key, rest)
    return vertices, {name: rows for name, rows in faces.items() if rows.lines}


def _check_unknown(number: int, key: bytes, rest: bytes) -> None:
    if key in _NOT_READ:
        raise MalformedMeshError("unknown", f"line {number}", f"found {shown(key)}", "polygons in one file")
    if all(_NUMERIC.fullmatch(word) for word in rest.split() or [key]):
        found = f"found {shown(key + b' ' + rest)}"
        raise MalformedMeshError("unknown", f"line {number}", found, '"v", "f" or a comment')


def _vertices(rows: _Rows) -> Float64[ndarray, "v 3"]:
    sizes = [len(text.split()) for text in rows.texts]
    if set(sizes) - _NUMBERS_OF_VERTICES and (len(set(sizes)) > 1 or sizes[0] < 3):
        row = next(row for row, size in enumerate(sizes) if size not in _NUMBERS_OF_VERTICES)
        found = f"a vertex of {sizes[row]} numbers"
        raise MalformedMeshError("damaged", rows.place(row), found, "3, or 6 with a colour")
    texts = rows.texts if set(sizes) == {3} else [b" ".join(text.split()[:3]) for text in rows.texts]
    return parse_numbers(texts, rows.place).reshape(-1, 3)


def _triangles(rows: _Rows, vertex_count: int) -> Int64[ndarray, "n 3"]:
    """Return the triangles of the faces of an object; raise ``MalformedMeshError`` for an invalid face."""
    text = b" ".join(rows.texts)
    sizes = [len(text.split()) for text in rows.texts]
    if min(sizes) < 3 or not _CORNERS.fullmatch(text):
        row = next(n for n, size in enumerate(sizes) if size < 3 or not _CORNERS.fullmatch(rows.texts[n]))
        found = f"found f {shown(rows.texts[row])}"
        raise MalformedMeshError("invalid", rows.place(row), found, "three or more corners")
    numbers = parse_numbers([re.sub(rb"/[-/\d]*", b"", text)], rows.place).astype(np.int64)
    corners = np.where(numbers < 0, np.repeat(rows.vertices_above, sizes) + numbers, numbers - 1)
    ends = np.cumsum(sizes)
    outside = first_true((corners < 0) | (corners >= vertex_count))
    if outside is not None:
        place = rows.place(int(np.searchsorted(ends, outside, side="right")))
        raise MalformedMeshError(
            "invalid", place, f"a corner is vertex {numbers[outside]}", f"1 to {vertex_count}"
        )
    if len(set(sizes)) == 1:
        return triangulate(corners.reshape(-1, sizes[0]))
    return np.concatenate([_fan(polygon) for polygon in np.split(corners, ends[:-1])])


def _fan(polygon: Int64[ndarray, " k"]) -> Int64[ndarray, "n 3"]:
    """Return the triangles of a convex polygon; those of a quadrilateral begin at opposite corners."""
    if len(polygon) == 4:
        return polygon[[[0, 1, 2], [2, 3, 0]]]
    return np.stack([np.full(len(polygon) - 2, polygon[0]), polygon[1:-1], polygon[2:]], axis=1)


def _decoded(name: bytes) -> str:
    """Return the text of a name, in UTF-8 or else Latin-1; different names stay different."""
    try:
        return name.decode()
    except UnicodeDecodeError:
        return name.decode("latin-1")
