"""Specs of assemblies that are read from a user's file: content, selected objects and placement.

Like all specs, they are written to the manifest: field names and defaults are part of the dataset format.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dataset_builder.scene.selection import Selection
from rebar_depth_bench.errors import MeshError
from rebar_depth_bench.limits import IFC_BYTES, MESH_BYTES, TOML_BYTES
from rebar_depth_bench.reading import read_file

Up = Literal["z", "y"]
Origin = Literal["centre", "keep"]
Trust = Literal["declared", "geometry"]
"""What to believe if the diameters of a bar are far apart: "declared" refuses it, "geometry" only notes it."""


@dataclass(frozen=True)
class PlacementSpec:
    """Placement of a file's bars in the world, in the order of the fields (``scene.assemblies.placement``).

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

    def check(self, content: bytes) -> bytes:
        """Return ``content``; raise ``MeshError`` if its digest is not ``sha256``."""
        actual_sha256 = hashlib.sha256(content).hexdigest()
        if actual_sha256 != self.sha256:
            raise MeshError(
                f"{self.path}: the file has changed since it was selected: its sha256 is {actual_sha256}, "
                f"expected {self.sha256}"
            )
        return content


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


_GLTF_CONVERSION = (
    ": convert glTF to OBJ, as with python -c "
    "\"import trimesh; trimesh.load_scene('FILE.glb').export('FILE.obj')\", "
    'and name the OBJ file in a scene TOML with mesh = "FILE.obj", unit = "m" and up = "y"'
)
_LIMITS = {".toml": TOML_BYTES, ".ifc": IFC_BYTES}
"""Limits of the files of an assembly by suffix; those of meshes have ``MESH_BYTES``."""


def unsupported_type(path: str | os.PathLike[str], kind: str, expected: str) -> str:
    """Return the message about a file of a type that is not read; for glTF it names the conversion."""
    suffix = Path(path).suffix.lower()
    conversion = _GLTF_CONVERSION if suffix in (".glb", ".gltf") else ""
    return f"{path}: unsupported {kind} file type {suffix!r}, expected {expected}{conversion}"


def read_assembly_file(path: str | os.PathLike[str], kind: str, suffixes: Collection[str]) -> bytes:
    """Return the bytes of a user's file; ``kind`` is ``mesh`` or ``cage``.

    Raises ``MeshError`` if its suffix is not one of ``suffixes``, it cannot be read or it is too large.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        raise MeshError(unsupported_type(path, kind, ", ".join(suffixes)))
    return read_file(Path(path), _LIMITS.get(suffix, MESH_BYTES), f"a {kind} file", MeshError)
