"""What a scene is made of before any renderer sees it: bars, meshes, parts. World frame, metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, UInt16
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar as Bar

NOT_STEEL = 0
"""The bar id of every surface that is not reinforcement."""


MAX_BARS = int(np.iinfo(np.uint16).max)
"""Bar ids are 16-bit, and 0 is taken."""

STEEL = "steel"
"""The material of bars."""

ESTIMATED = "imported"
"""The role of a bar whose axis and diameter were estimated from its surface."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, counter-clockwise from outside; ``vertices_m`` in its own frame."""

    vertices_m: Float64[ndarray, "v 3"]
    faces: Int32[ndarray, "f 3"]


@dataclass(frozen=True, eq=False)
class Part:
    """One object of a scene: a mesh in the world frame, the bar it is (0: none) and its material's name."""

    name: str
    mesh: Mesh
    bar_id: int
    material: str


@dataclass(frozen=True, eq=False)
class Assembly:
    """The steel of a scene: its bars, and a part for each of them."""

    bars: tuple[Bar, ...]
    parts: tuple[Part, ...]

    @property
    def vertices_m(self) -> Float64[ndarray, "v 3"]:
        """The vertices of all parts, world frame, metres."""
        return np.concatenate([part.mesh.vertices_m for part in self.parts])


@dataclass(frozen=True, eq=False)
class WorldMesh:
    """All surfaces of a scene as one mesh: what rays are cast against and what ``meshes/*.ply`` holds."""

    vertices_m: Float64[ndarray, "v 3"]
    faces: Int32[ndarray, "f 3"]
    face_bar_id: UInt16[ndarray, " f"]
