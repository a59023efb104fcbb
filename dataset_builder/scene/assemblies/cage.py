"""Cage: the bars that a user's file holds, before meshes are made of them.

The reader of a file returns them in the file's frame, in metres, and ``placement`` moves them to the world frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh, Note
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import Problem


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
    ``problems`` are the reasons for which a build refuses the cage.
    """

    bars: tuple[CageBar, ...]
    left_out: tuple[LeftOut, ...] = ()
    world_from_source: Float64[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    problems: tuple[Problem, ...] = ()

    @property
    def notes(self) -> tuple[Note, ...]:
        """Notes of the bars, each once; those on lengths last, of which some files have one for every bar."""
        notes = dict.fromkeys(note for bar in self.bars for note in bar.notes)
        return tuple(sorted(notes, key=lambda note: note.code == "length"))


def unit_scale(unit_m: float) -> Float64[ndarray, "4 4"]:
    """Return the matrix that takes coordinates in a file's unit to metres."""
    return np.diag([unit_m, unit_m, unit_m, 1.0])
