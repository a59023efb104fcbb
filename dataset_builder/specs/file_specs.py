"""Specs of assemblies that are read from a user's file: content, selected objects and placement.

Like all specs, they are written to the manifest: field names and defaults are part of the dataset format.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dataset_builder.specs.selection import Selection

Up = Literal["z", "y"]
Origin = Literal["centre", "keep"]
Trust = Literal["declared", "geometry"]
"""What to believe if the diameters of a bar are far apart: "declared" refuses it, "geometry" only notes it."""


@dataclass(frozen=True)
class PlacementSpec:
    """Placement of a file's bars in the world, in the order of the fields (``user_files.cage_placement``).

    ``up`` is the file's vertical axis. With the ``origin`` "centre" the steel is centred above the world's origin
    and set on the ground, with "keep" the file's origin is the world's. The steel is then turned about the z axis
    by ``rotate_deg`` and moved by ``translate_m``.
    """

    up: Up = "z"
    origin: Origin = "keep"
    rotate_deg: float = 0.0
    translate_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PinnedFile:
    """User's file with the digest of the content that it had when it was chosen."""

    path: str
    sha256: str


@dataclass(frozen=True)
class CageFileSpec(PinnedFile):
    """Assembly read bar by bar from a TOML or IFC file.

    ``select`` are the tables of which one must match an object; without any, all reinforcement of the file is
    taken. ``trust`` decides about declared diameters. Both are for IFC files only.
    """

    placement: PlacementSpec = PlacementSpec()
    select: tuple[Selection, ...] = ()
    trust: Trust = "declared"
    kind: str = "cage-file"


@dataclass(frozen=True)
class MeshFileSpec(PinnedFile):
    """Assembly read from a mesh file; ``unit_m`` is one file unit in metres, ``select`` chooses its parts."""

    unit_m: float
    placement: PlacementSpec = PlacementSpec()
    select: tuple[Selection, ...] = ()
    kind: str = "mesh-file"
