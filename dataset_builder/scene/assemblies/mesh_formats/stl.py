"""Reader of STL files, binary and text.

A file is binary if its size is that of the triangle count in its header, also if it begins with "solid", as files
of several programs do. Normals, attributes and names are ignored.
"""

from __future__ import annotations

import re

import numpy as np
from numpy import ndarray

from dataset_builder.scene.assemblies.mesh_formats.parsing import (
    BYTE_ORDER_MARK,
    MalformedMeshError,
    Surface,
    check_surface,
    parse_numbers,
    shown,
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


def read_stl(content: bytes) -> Surface:
    """Return the triangles of all solids, in order; each has its own three vertices.

    Raises ``MalformedMeshError`` if the content is neither a binary nor a text STL, or is truncated.
    """
    corners = _binary_corners(content)
    if corners is None:
        corners = _text_corners(content)
    return check_surface((corners, np.arange(len(corners)).reshape(-1, 3)), _corner_place, str)


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
