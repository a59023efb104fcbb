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

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from dataset_builder.user_files.mesh_formats.parsing import (
    BYTE_ORDER_MARK,
    NUMBER,
    MalformedMeshError,
    Surface,
    first_true,
    shown,
    triangulate,
)

_HEADER_BYTES = 84
_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_SOLID = re.compile(rb"\s*solid\b[^\r\n]*", re.IGNORECASE)
_FACET = re.compile(
    rb"\s*facet(?:\s+normal(?:\s+\S+){3})?\s+outer\s*loop"
    rb"((?:\s+vertex(?:\s+%b){3}){3})\s+end\s*loop\s+end\s*facet\b" % NUMBER,
    re.IGNORECASE,
)
_END = re.compile(rb"\s*end\s*solid\b[^\r\n]*", re.IGNORECASE)
_PADDING = b"\0\x1a"
"""Bytes that some programs append: zeros, and the end-of-file character of DOS."""


def read_stl(content: bytes) -> Mapping[str, Surface]:
    """Return the triangles of all solids, in order, as one object without a name; each has its own three vertices.

    Raises ``MalformedMeshError`` if the content is neither a binary nor a text STL, or is truncated.
    """
    count = int.from_bytes(content[_HEADER_BYTES - 4 : _HEADER_BYTES], "little")
    size = _HEADER_BYTES + count * _TRIANGLE.itemsize
    if len(content) == size:
        corners = np.frombuffer(content, _TRIANGLE, count, _HEADER_BYTES)["corners"].reshape(-1, 3)
    elif _SOLID.match(content.removeprefix(BYTE_ORDER_MARK)) and b"\0" not in content[:_HEADER_BYTES]:
        text = content.removeprefix(BYTE_ORDER_MARK).rstrip(_PADDING).rstrip()
        numbers = re.sub(rb"(?i)vertex", b" ", b"".join(_facets(text)))
        corners = np.fromstring(numbers, sep=" ").reshape(-1, 3)
    else:
        found = f"truncated or damaged: the header counts {count} triangles, but the file has {len(content)} bytes"
        raise MalformedMeshError("damaged", "", found, f'{size}, or a text that begins with "solid"')
    return {"": (corners, np.arange(len(corners)).reshape(-1, 3))}


def _facets(text: bytes) -> list[bytes]:
    """Return the lines of vertices of each facet; raise ``MalformedMeshError`` if anything else is in the text."""
    facets: list[bytes] = []
    position = 0
    while position < len(text):
        start = _SOLID.match(text, position)
        position = start.end() if start else position
        while facet := _FACET.match(text, position):
            facets.append(facet[1])
            position = facet.end()
        end = _END.match(text, position)
        if start is None or end is None:
            rest = text[position:].lstrip()
            line = len((text[: len(text) - len(rest)] + b"x").splitlines())
            found = f"found {shown(rest[:200].splitlines()[0])}" if rest else "the file ends"
            expected = '"solid", facets of three vertices of three numbers, and "endsolid"'
            raise MalformedMeshError("damaged", f"line {line}", found, expected)
        position = end.end()
    return facets


_VERTEX = re.compile(rb"v((?: +%b){3,})" % NUMBER)
_FACE = re.compile(rb"f(?: +-?\d{1,18}(?:/-?\d*){0,2}){3,}")
_NUMERIC = re.compile(rb"[-+./eE]*+\d[-+.\d/eE]*+")
_CONTINUATION = re.compile(rb"(?<=[\d/ ])\\(?:\r\n|\r|\n)")
"""End of a line of numbers that continues; a path in a comment may end in a backslash too."""
_UNNAMED = b"geometry"
"""Name of the object of faces that precede the first name."""
_NUMBERS_OF_VERTICES = {3, 6}
"""Numbers of a vertex, without and with a colour, which may both occur in one file."""
_IGNORED = {b"vt", b"vn", b"vp", b"vc", b"l", b"p", b"s", b"g", b"mg", b"lod", b"usemtl", b"mtllib"}
"""Statements that do not affect the surfaces and may consist of numbers."""
_NOT_READ = {b"v", b"f", b"curv", b"curv2", b"surf", b"cstype", b"call", b"csh"}
"""Malformed vertices and faces, free-form surfaces and other files: without them, a part would be missing."""


def read_obj(content: bytes) -> Mapping[str, Surface]:
    """Return the objects of the file by name, each with all vertices of the file and its own triangles.

    Raises ``MalformedMeshError`` if a vertex or face is malformed, for a line that would be one if its first word
    were not damaged, or if the file has surfaces that are no polygons. Continued lines count as one.
    """
    text = _CONTINUATION.sub(b" ", content.removeprefix(BYTE_ORDER_MARK).replace(b"\t", b" "))
    coordinates, lengths = list[float](), set[int]()
    corners: dict[bytes, list[int]] = defaultdict(list)
    lines_of_corners: dict[bytes, list[int]] = defaultdict(list)
    name = _UNNAMED
    for number, line in enumerate(text.splitlines(), start=1):
        statement = line.partition(b" #")[0].strip()
        key, _, rest = statement.partition(b" ")
        if vertex := _VERTEX.fullmatch(statement):
            numbers = vertex[1].split()
            lengths.add(len(numbers))
            if len(lengths) > 1 and not lengths <= _NUMBERS_OF_VERTICES:
                found = f"a vertex of {len(numbers)} numbers"
                raise MalformedMeshError("damaged", f"line {number}", found, "as many as above, or 3, or 6")
            coordinates.extend(map(float, numbers[:3]))
        elif _FACE.fullmatch(statement):
            polygon = [int(word.partition(b"/")[0]) for word in rest.split()]
            if min(polygon) < 0:  # Negative numbers count back from the last vertex above, others from 1.
                polygon = [n if n >= 0 else len(coordinates) // 3 + 1 + n for n in polygon]
            corners[name].extend(polygon)
            lines_of_corners[name] += [number] * len(polygon)
        elif key == b"o":
            name = line.strip()[1:].strip() or _UNNAMED
        elif key in _NOT_READ or (
            key and key not in _IGNORED and all(_NUMERIC.fullmatch(word) for word in rest.split() or [key])
        ):
            expected = "v with 3 numbers, or 6 with a colour, f with three or more corners, or a comment"
            raise MalformedMeshError("invalid", f"line {number}", f"found {shown(statement)}", expected)
    vertices = np.array(coordinates).reshape(-1, 3)
    surfaces = {}
    for name, listed in corners.items():
        numbers, lines = np.array(listed), np.array(lines_of_corners[name])
        outside = first_true((numbers < 1) | (numbers > len(vertices)))
        if outside is not None:
            found = f"a corner is vertex {numbers[outside]}"
            raise MalformedMeshError("invalid", f"line {lines[outside]}", found, f"1 to {len(vertices)}")
        polygons = np.split(numbers - 1, np.flatnonzero(np.diff(lines)) + 1)
        surfaces[_decoded(name)] = vertices, _triangles(polygons)
    return surfaces


def _triangles(polygons: list[Int64[ndarray, " k"]]) -> Int64[ndarray, "n 3"]:
    """Return the triangles of convex polygons; the two of a quadrilateral begin at opposite corners."""
    if len({len(polygon) for polygon in polygons}) == 1:
        return triangulate(np.array(polygons))
    triangles = []
    for polygon in polygons:
        if len(polygon) == 4:
            triangles.append(polygon[[[0, 1, 2], [2, 3, 0]]])
        else:
            triangles.append(np.stack([np.full(len(polygon) - 2, polygon[0]), polygon[1:-1], polygon[2:]], axis=1))
    return np.concatenate(triangles)


def _decoded(name: bytes) -> str:
    """Return the text of a name, in UTF-8 or else Latin-1; different names stay different."""
    try:
        return name.decode()
    except UnicodeDecodeError:
        return name.decode("latin-1")
