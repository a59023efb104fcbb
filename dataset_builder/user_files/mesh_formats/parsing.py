"""Helpers of the readers of mesh formats: their error, strict numbers, and polygons as triangles."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.base.errors import Problem, ProblemCode, escape_text

Surface = tuple[Float[ndarray, "v 3"], Int64[ndarray, "n 3"]]
"""Vertices in the file's unit and axes, and triangles, whose corners are indices of these vertices.

Vertices are float32 where the file stores them so, otherwise float64.
"""

Place = Callable[[int], str]
"""Function from the index of a row or vertex to its place in the file."""

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_NUMBER = re.compile(rb"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")


class MalformedMeshError(ValueError):
    """Content that is not a sound file of its format; ``problem`` is the reason."""

    def __init__(self, code: ProblemCode, where: str, found: str, expected: str = "") -> None:
        self.problem = Problem(code, where, found, expected)
        super().__init__(str(self.problem))


def parse_numbers(rows: Sequence[bytes], place: Place) -> Float64[ndarray, " n"]:
    """Return all numbers of text rows, which are separated by spaces.

    Raises ``MalformedMeshError`` if a word is not a number.
    """
    text = b" ".join(rows)
    if not text.strip():
        return np.empty(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # NumPy warns if it stops before the end of the text.
        try:
            return np.fromstring(text, sep=" ")
        except DeprecationWarning:
            pass
    row, word = next(
        (row, word) for row, line in enumerate(rows) for word in line.split() if not _NUMBER.fullmatch(word)
    )
    raise MalformedMeshError("invalid", place(row), f"got {shown(word)}", "a number")


def shown(line: bytes) -> str:
    """Return the start of a line of the file for a message."""
    return escape_text(line[:200].decode(errors="replace").strip())


def check_finite(vertices: Float[ndarray, "v 3"], place: Place) -> None:
    """Raise ``MalformedMeshError`` for a vertex that is not finite."""
    row = first_true(~np.isfinite(vertices).all(axis=1))
    if row is not None:
        found = f"a vertex is {vertices[row].tolist()}"
        raise MalformedMeshError("invalid", place(row), found, "finite coordinates")


def triangulate(polygons: Sequence[Int64[ndarray, " k"]] | Int64[ndarray, "n k"]) -> Int64[ndarray, "n 3"]:
    """Return the triangles of convex polygons: first the triangles, then quadrilaterals, then fans of others."""
    import trimesh

    return np.asarray(trimesh.geometry.triangulate_quads(polygons), np.int64).reshape(-1, 3)


def first_true(flags: ndarray) -> int | None:
    """Return the index of the first true value, or None."""
    return int(flags.argmax()) if flags.any() else None
