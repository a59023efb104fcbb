"""Scene model, independent of any renderer: bars, meshes and parts. World frame, metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32, UInt16
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.schema import FormPlane

NOT_STEEL = 0
"""Bar id of all surfaces that are not reinforcement."""


MAX_BARS = int(np.iinfo(np.uint16).max)
"""Maximum number of bars: bar ids are 16-bit, and 0 is reserved for ``NOT_STEEL``."""

METRE_DECIMALS = 12
"""Rounding of the lengths in scene files and IFC models after conversion to metres: to the picometre."""


def to_metres(length: float, unit_m: float) -> float:
    """Return a length in metres, rounded to the picometre.

    The rounding removes the floating-point error of the conversion: 9 mm is exactly 0.009 m, 16 mm exactly 0.016.
    """
    return round(length * unit_m, METRE_DECIMALS)


STEEL = "steel"
"""Material name of bars."""

Colour = tuple[float, float, float]
"""Red, green and blue, linear Rec. 709."""

ESTIMATED_ROLE = "imported"
"""Role of bars whose axis and diameter were fitted to their surface, or could not be."""


def axis_of(line_m: Float64[ndarray, "n 3"]) -> tuple[tuple[float, float, float], ...]:
    """Return a centreline as ``Bar.axis_m``."""
    return tuple((x, y, z) for x, y, z in line_m.tolist())


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh, counter-clockwise seen from outside; ``vertices_m`` in a local frame, metres."""

    vertices_m: Float64[ndarray, "v 3"]
    faces: Int32[ndarray, "f 3"]


@dataclass(frozen=True, eq=False)
class Part:
    """Object of a scene: a mesh in the world frame, its bar id (0: not steel) and the name of its material.

    ``plane`` is that of the face towards the steel if the object is a sheet of formwork.
    """

    name: str
    mesh: Mesh
    bar_id: int
    material: str
    plane: FormPlane | None = None


def surface(name: str, mesh: Mesh, material: str, plane: FormPlane | None = None) -> Part:
    """Return a part that is not steel, with the ``plane`` of a sheet of formwork."""
    return Part(name, mesh, NOT_STEEL, material, plane)


@dataclass(frozen=True)
class Note:
    """Remark about a file of the scene that its user should know: the file, a short code and the text."""

    source: str
    code: str
    text: str


@dataclass(frozen=True, eq=False)
class Assembly:
    """Steel of a scene: its bars, one part per bar, notes about its file, and how it was placed.

    ``world_from_source`` takes coordinates in the file's frame and unit to the world frame in metres; it is None
    for a generated assembly.
    """

    bars: tuple[Bar, ...]
    parts: tuple[Part, ...]
    notes: tuple[Note, ...] = ()
    world_from_source: Float64[ndarray, "4 4"] | None = None

    @classmethod
    def from_meshes(
        cls,
        bars_and_meshes: Iterable[tuple[Bar, Mesh]],
        notes: tuple[Note, ...] = (),
        world_from_source: Float64[ndarray, "4 4"] | None = None,
    ) -> Assembly:
        """Return the assembly of bars and their meshes (world frame); a part is named by its bar's role and id."""
        pairs = tuple(bars_and_meshes)
        parts = (Part(f"{bar.role}-{bar.bar_id:03d}", mesh, bar.bar_id, STEEL) for bar, mesh in pairs)
        return cls(tuple(bar for bar, _ in pairs), tuple(parts), notes, world_from_source)

    @property
    def vertices_m(self) -> Float64[ndarray, "v 3"]:
        """Vertices of all parts, world frame, metres."""
        return np.concatenate([part.mesh.vertices_m for part in self.parts])


@dataclass(frozen=True, eq=False)
class WorldMesh(Mesh):
    """All surfaces of a scene as one mesh: the input of the ray caster and the content of ``meshes/*.ply``."""

    face_bar_id: UInt16[ndarray, " f"]
