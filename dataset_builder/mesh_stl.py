"""STL, binary or text: three corners a triangle, no shared vertices.

An own reader, because trimesh's takes a truncated text STL for a shorter one.
"""

from __future__ import annotations

import re
from itertools import chain

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from dataset_builder.mesh_tools import checked_mesh
from dataset_builder.model import Mesh
from rebar_depth_bench.errors import MeshError

_PREAMBLE_BYTES = 84
_ROW = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FACET = re.compile(rb"^[ \t]*facet\b", re.MULTILINE | re.IGNORECASE)
_VERTEX = re.compile(
    rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.MULTILINE | re.IGNORECASE
)


def read_stl(content: bytes, where: str) -> Mesh:
    """Return all triangles in file order, in file units, with three vertices of their own each.

    The solids of a text STL are taken together. Raises ``MeshError`` where the file is not whole.
    """
    count = int.from_bytes(content[_PREAMBLE_BYTES - 4 : _PREAMBLE_BYTES], "little")
    # Binary files may begin with "solid" too; only the length tells.
    if len(content) >= _PREAMBLE_BYTES and len(content) == _PREAMBLE_BYTES + count * _ROW.itemsize:
        rows = np.frombuffer(content[_PREAMBLE_BYTES:], _ROW)
        return _mesh(rows["corners"], where)
    words = content.lower().split()
    if not words or words[0] != b"solid" or b"endsolid" not in words:
        raise MeshError(
            f"{where}: no whole STL: {len(content)} bytes found; a binary STL has 84 and 50 for each "
            "triangle that its header counts, a text STL begins with solid and closes with endsolid"
        )
    return _mesh(_text_corners(content, where), where)


def _text_corners(content: bytes, where: str) -> Float[ndarray, "k 3"]:
    facets, corners = len(_FACET.findall(content)), _VERTEX.findall(content)
    if len(corners) != 3 * facets:
        raise MeshError(
            f"{where}: no whole STL: {facets} facets and {len(corners)} vertices of three numbers found, "
            f"expected {3 * facets}"
        )
    try:
        values = np.fromiter(map(float, chain.from_iterable(corners)), np.float64, 3 * len(corners))
    except ValueError as error:
        raise MeshError(f"{where}: a vertex of this text STL is no number: {error}") from error
    return values.reshape(-1, 3)


def _mesh(corners: Float[ndarray, "*n 3"], where: str) -> Mesh:
    return checked_mesh(corners, np.arange(corners.size // 3), where)
