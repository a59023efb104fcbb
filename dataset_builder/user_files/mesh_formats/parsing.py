"""Helpers of the readers of mesh formats: their error, strict numbers, and polygons as triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from rebar_depth_bench.base.errors import Problem, ProblemCode, escape_text

Surface = tuple[Float[ndarray, "v 3"], Int64[ndarray, "n 3"]]
"""Vertices in the file's unit and axes, and triangles, whose corners are indices of these vertices.

Vertices are float32 where the file stores them so, otherwise float64.
"""

BYTE_ORDER_MARK = b"\xef\xbb\xbf"
NUMBER = rb"[-+]?+(?:\d++(?:\.\d*+)?+|\.\d++)(?:[eE][-+]?+\d++)?+"
"""Pattern of a number, in time proportional to its length."""


class MalformedMeshError(ValueError):
    """Content that is not a sound file of its format; ``problem`` is the reason."""

    def __init__(self, code: ProblemCode, where: str, found: str, expected: str = "") -> None:
        self.problem = Problem(code, where, found, expected)
        super().__init__(str(self.problem))


def shown(line: bytes) -> str:
    """Return the start of a line of the file for a message."""
    return escape_text(line[:200].decode(errors="replace").strip())


def triangulate(polygons: Sequence[Int64[ndarray, " k"]] | Int64[ndarray, "n k"]) -> Int64[ndarray, "n 3"]:
    """Return the triangles of convex polygons: first the triangles, then quadrilaterals, then fans of others."""
    import trimesh

    return np.asarray(trimesh.geometry.triangulate_quads(polygons), np.int64).reshape(-1, 3)


def first_true(flags: Bool[ndarray, " n"]) -> int | None:
    """Return the index of the first true value, or None."""
    return int(flags.argmax()) if flags.any() else None
