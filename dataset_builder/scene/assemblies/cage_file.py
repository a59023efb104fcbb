"""Cages from users' files: bars of a scene TOML, an IFC model or a mesh, placed in the world and checked."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path

from dataset_builder.config.file_specs import (
    CageFileSpec,
    MeshFileSpec,
    PlacementSpec,
    Trust,
    read_assembly_file,
)
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.scene.assemblies.cage_assembly import cage_assembly
from dataset_builder.scene.assemblies.cage_checks import cage_problems, check_values
from dataset_builder.scene.assemblies.ifc_file import ifc_cage
from dataset_builder.scene.assemblies.mesh_file import read_mesh
from dataset_builder.scene.assemblies.placement import placed
from dataset_builder.scene.assemblies.toml_bars import toml_cage
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.selection import Selection

_SUFFIXES = (".toml", ".ifc")


def cage_file_spec(
    path: str | os.PathLike[str],
    placement: PlacementSpec = PlacementSpec(),  # noqa: B008
    select: tuple[Selection, ...] = (),
    trust: Trust = "declared",
) -> CageFileSpec:
    """Return the spec of a TOML or IFC file, which fixes its present content by SHA-256.

    Raises ``MeshError`` if it cannot be read or its suffix is neither ``.toml`` nor ``.ifc``.
    """
    digest = hashlib.sha256(read_assembly_file(path, "cage", _SUFFIXES)).hexdigest()
    return CageFileSpec(os.fspath(path), digest, placement, select, trust)


def load_cage(spec: CageFileSpec | MeshFileSpec) -> Assembly:
    """Return the file's bars, in its order, and a mesh (world, metres) for each of them.

    Raises as ``read_cage``, and ``MeshError`` if the bars are not valid (see ``cage_assembly``).
    """
    return cage_assembly(read_cage(spec), spec.path)


def read_cage(spec: CageFileSpec | MeshFileSpec) -> Cage:
    """Return the bars of a file in the world frame, with the reasons for which a build refuses them.

    Raises ``MeshError`` if the file cannot be read, does not match ``spec.sha256``, violates its format, or has no
    bar or a coordinate that is not finite; ``InputError`` if it is an IFC file and ifcopenshell is not installed.
    """
    source = read_mesh(spec) if isinstance(spec, MeshFileSpec) else _read_bars(spec)
    check_values(source.bars, spec.path)
    cage = placed(source, spec.placement)
    return replace(cage, problems=(*cage.problems, *cage_problems(cage.bars)))


def _read_bars(spec: CageFileSpec) -> Cage:
    """Return the bars of a TOML or IFC file (the file's frame, metres)."""
    content = spec.check(read_assembly_file(spec.path, "cage", _SUFFIXES))
    if Path(spec.path).suffix.lower() == ".ifc":
        return ifc_cage(content, spec.path, spec.select, spec.trust)
    return toml_cage(content, spec.path)
