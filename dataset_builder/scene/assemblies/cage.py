"""Cage: the bars that a user's file holds, before meshes are made of them.

The reader of a file returns them in the file's frame, in metres, and ``placement`` moves them to the world frame.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh, Note, axis_of
from dataset_builder.specs.config_specs import FormSpec
from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.data.bars import Bar

_NO_MESH = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
"""What is packed for a bar whose mesh is swept along its axis."""


@dataclass(frozen=True, eq=False)
class CageBar:
    """Bar of a user's file with its name in error messages.

    ``mesh`` is set only if the file has no axis for the bar; only then the bar may be without one.
    ``source`` is what the file calls its object: the GlobalId of an IFC object, the name of a node or part of a
    mesh file, or the number of a ``[[bar]]`` table. ``host`` is the name of the element that the bar reinforces,
    ``storey`` that of its storey; both are None where the file has none. ``notes`` are remarks of the reader.
    """

    label: str
    bar: Bar
    ribs: bool = True
    mesh: Mesh | None = None
    source: str | None = None
    host: str | None = None
    storey: str | None = None
    notes: tuple[Note, ...] = ()

    @cached_property
    def points_m(self) -> Float64[ndarray, "n 3"]:
        """Points of the axis and the vertices of the mesh, as far as the bar has them."""
        axis_m = np.array(self.bar.axis_m, dtype=np.float64).reshape(-1, 3)
        return axis_m if self.mesh is None else np.concatenate([axis_m, self.mesh.vertices_m])

    @property
    def axis_kind(self) -> Literal["exact", "fitted"] | None:
        """Where the centreline is from: the file (exact), a fit to a surface, or nowhere (None)."""
        if not self.bar.has_axis:
            return None
        return "exact" if self.mesh is None else "fitted"


@dataclass(frozen=True)
class LeftOut:
    """Object of a file that is not in the cage: its name, and the reason in words."""

    source: str
    reason: str


@dataclass(frozen=True, eq=False)
class Cage:
    """Bars of a user's file, what the file holds beside them, and how they were placed.

    ``world_from_source`` takes coordinates in the file's frame and unit to the world frame in metres.
    ``problems`` are the reasons for which a build refuses the cage; ``placement_notes`` say how it was moved, and
    ``forms`` are those of its scene file.
    """

    bars: tuple[CageBar, ...]
    left_out: tuple[LeftOut, ...] = ()
    world_from_source: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    problems: tuple[Problem, ...] = ()
    placement_notes: tuple[Note, ...] = ()
    forms: tuple[FormSpec, ...] = ()

    @property
    def notes(self) -> tuple[Note, ...]:
        """Notes on cage and bars, each once; those on lengths last, of which some files have one for every bar."""
        notes = dict.fromkeys((*self.placement_notes, *(note for bar in self.bars for note in bar.notes)))
        return tuple(sorted(notes, key=lambda note: note.code == "length"))


def unit_scale(unit_m: float) -> Float64[ndarray, "4 4"]:
    """Return the matrix that takes coordinates in a file's unit to metres."""
    return np.diag([unit_m, unit_m, unit_m, 1.0])


def packed_cage(cage: Cage) -> bytes:
    """Return the bars of a cage as an ``.npz`` file: all that their meshes depend on. Equal bars give equal bytes.

    Nominal axes, which bars of a file do not have, are left out, and so is what describes their source.
    """
    bars = [bar.bar for bar in cage.bars]
    meshes = [bar.mesh or _NO_MESH for bar in cage.bars]
    content = io.BytesIO()
    np.savez(
        content,
        bar_id=np.array([bar.bar_id for bar in bars], np.uint16),
        roles_json=np.frombuffer(json.dumps([bar.role for bar in bars]).encode(), np.uint8),
        diameter_m=np.array([bar.diameter_m for bar in bars], np.float64),
        ribs=np.array([bar.ribs for bar in cage.bars], np.bool_),
        axis_points=np.array([len(bar.axis_m) for bar in bars]),
        axis_m=np.array([point for bar in bars for point in bar.axis_m], np.float64).reshape(-1, 3),
        vertices=np.array([len(mesh.vertices_m) for mesh in meshes]),
        vertices_m=np.concatenate([mesh.vertices_m for mesh in meshes]),
        triangles=np.array([len(mesh.faces) for mesh in meshes]),
        faces=np.concatenate([mesh.faces for mesh in meshes]),
    )
    return content.getvalue()


def unpacked_cage(content: bytes) -> Cage:
    """Return the cage of bars that ``packed_cage`` has packed."""
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        ids, diameters_m, ribs = (arrays[name].tolist() for name in ("bar_id", "diameter_m", "ribs"))
        roles = json.loads(arrays["roles_json"].tobytes())
        axes_m = _split(arrays["axis_m"], arrays["axis_points"])
        meshes = map(
            Mesh, _split(arrays["vertices_m"], arrays["vertices"]), _split(arrays["faces"], arrays["triangles"])
        )
    bars = map(Bar, ids, roles, diameters_m, map(axis_of, axes_m))
    return Cage(
        tuple(
            CageBar(f"bar {bar.bar_id}", bar, has_ribs, mesh if len(mesh.faces) else None)
            for bar, has_ribs, mesh in zip(bars, ribs, meshes, strict=True)
        )
    )


def _split(rows: ndarray, counts: ndarray) -> list[ndarray]:
    """Return the rows of each bar, of which there are ``counts``."""
    return np.split(rows, np.cumsum(counts)[:-1])
