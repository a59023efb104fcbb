"""User mesh files (STL, PLY, OBJ, glTF) as assemblies: bars and parts in world metres.

Nothing is moved: the file's frame is the world frame, z up, with the board at z = 0. The module
``mesh_import`` defines what counts as a bar in each format and which id it gets. The centreline and the diameter
of each bar are fitted to its mesh (``scene.assemblies.surface_bar``).
"""

from __future__ import annotations

import hashlib
import math
import os

from dataset_builder.config.scene_schema import UNITS_M
from dataset_builder.config.specs import MeshFileSpec, read_assembly_file
from dataset_builder.scene.assemblies.mesh_import import SUFFIXES, read_parts
from dataset_builder.scene.assemblies.surface_bar import axis_notes, fitted_bar
from dataset_builder.scene.model import STEEL, Assembly, Mesh, Part
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import MeshError


def mesh_file_spec(path: str | os.PathLike[str], unit: str | float) -> MeshFileSpec:
    """Return the spec of a mesh file, which fixes its present content by SHA-256.

    ``unit`` is the length of one file unit: a name from ``UNITS_M``, or a number of metres. glTF is in metres
    by its specification, so ``"m"`` is right for it unless its exporter deviates.

    Raises ``MeshError`` if the unit is unknown, the file cannot be read or its suffix is unknown.
    """
    if isinstance(unit, str) and unit not in UNITS_M:
        raise MeshError(f"{path}: unknown unit {unit!r}, expected one of {', '.join(UNITS_M)} or metres")
    unit_m = UNITS_M[unit] if isinstance(unit, str) else float(unit)
    _check_unit(unit_m, str(path))
    return MeshFileSpec(
        os.fspath(path), hashlib.sha256(read_assembly_file(path, "mesh", SUFFIXES)).hexdigest(), unit_m
    )


def load_assembly(spec: MeshFileSpec) -> Assembly:
    """Return the file's bars, by ascending id, and one part (world, metres) for each of them.

    A bar's axis and diameter are fitted to its mesh (``fitted_bar``), or null where no tube fits, which a note
    says; parts need not be watertight.

    Raises ``MeshError`` if the file cannot be read, does not match ``spec.sha256``, holds no bar, more than
    65,535 bars, a bar without area or a non-finite coordinate, or if its extent is implausible for the unit.
    """
    _check_unit(spec.unit_m, spec.path)
    meshes = read_parts(spec.check(read_assembly_file(spec.path, "mesh", SUFFIXES)), spec)
    bars = tuple(_fitted_bar(bar_id, mesh, spec.path) for bar_id, mesh in meshes.items())
    return Assembly(
        bars=bars,
        parts=tuple(Part(f"bar-{bar_id:03d}", mesh, bar_id, STEEL) for bar_id, mesh in meshes.items()),
        notes=axis_notes(spec.path, [f"bar {bar.bar_id}" for bar in bars if not bar.has_axis], len(bars)),
    )


def _fitted_bar(bar_id: int, mesh: Mesh, where: str) -> Bar:
    """Return ``fitted_bar``; raise ``MeshError`` that names the file ``where`` if the mesh has no area."""
    try:
        return fitted_bar(bar_id, mesh)
    except ValueError as error:
        raise MeshError(
            f"{where}: bar {bar_id} ({len(mesh.faces)} triangles) is not a valid surface: {error}"
        ) from error


def _check_unit(unit_m: float, where: str) -> None:
    """Raise ``MeshError`` unless a file unit is a positive finite length."""
    if not (math.isfinite(unit_m) and unit_m > 0):
        raise MeshError(f"{where}: one file unit is {unit_m} m, expected a positive length")
