"""User mesh files (STL, PLY, OBJ) as cages.

The module ``mesh_import`` defines what counts as a bar in each format and which id it gets. The centreline and the
diameter of each bar are fitted to its mesh (``scene.assemblies.surface_bar``).
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Sequence
from dataclasses import replace

from dataset_builder.config.file_specs import MeshFileSpec, PlacementSpec, read_assembly_file
from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut, unit_scale
from dataset_builder.scene.assemblies.mesh_import import (
    MAX_FLOAT32_SPACING_M,
    SUFFIXES,
    MeshPart,
    read_parts,
)
from dataset_builder.scene.assemblies.surface_bar import fitted_bar
from dataset_builder.scene.selection import Selection
from rebar_depth_bench.errors import MeshError, escape_text
from rebar_depth_bench.validation import UNITS_M


def mesh_file_spec(
    path: str | os.PathLike[str],
    unit: str | float,
    placement: PlacementSpec | None = None,
    select: tuple[Selection, ...] = (),
) -> MeshFileSpec:
    """Return the spec of a mesh file, which fixes its present content by SHA-256.

    ``unit`` is the length of one file unit: a name from ``UNITS_M``, or a number of metres. The default placement
    keeps the file's coordinates.

    Raises ``MeshError`` if the unit is unknown, the file cannot be read or its suffix is unknown.
    """
    if isinstance(unit, str) and unit not in UNITS_M:
        raise MeshError(f"{path}: unknown unit {unit!r}, expected one of {', '.join(UNITS_M)} or metres")
    unit_m = UNITS_M[unit] if isinstance(unit, str) else float(unit)
    _check_unit(unit_m, str(path))
    digest = hashlib.sha256(read_assembly_file(path, "mesh", SUFFIXES)).hexdigest()
    return MeshFileSpec(os.fspath(path), digest, unit_m, placement or PlacementSpec(), select)


def read_mesh(spec: MeshFileSpec) -> Cage:
    """Return the selected parts of a mesh file as bars, by ascending id (the file's frame, metres).

    A bar's axis and diameter are fitted to its mesh (``fitted_bar``), or null where no tube fits; parts need not
    be watertight. Selected parts are numbered from 1, but those of the dataset's own PLY keep their ids.

    Raises ``MeshError`` if the file cannot be read, does not match ``spec.sha256``, holds no bar, more than
    65,535 bars, a bar without area or a non-finite coordinate, or stores coordinates that are too coarse.
    """
    _check_unit(spec.unit_m, spec.path)
    parts = read_parts(spec.check(read_assembly_file(spec.path, "mesh", SUFFIXES)), spec)
    taken, left_out = _selected(parts, spec)
    _check_spacing(taken, spec)
    bars = [_fitted_bar(part, spec.path) for part in taken]
    return Cage(tuple(bars), tuple(left_out), unit_scale(spec.unit_m))


def _selected(parts: Sequence[MeshPart], spec: MeshFileSpec) -> tuple[list[MeshPart], list[LeftOut]]:
    """Return the parts that any table selects, numbered again, and those left out."""
    if not spec.select:
        return list(parts), []
    taken = [part for part in parts if any(_is_selected(part, table, spec.unit_m) for table in spec.select)]
    if not taken:
        raise MeshError(
            f"{spec.path}: no part is selected, expected [[select]] tables that match at least one of its "
            f"{len(parts)} parts, such as {escape_text(parts[0].name)}"
        )
    kept = {part.bar_id for part in taken}
    left_out = [
        LeftOut(escape_text(part.name), "no [[select]] table matches") for part in parts if part.bar_id not in kept
    ]
    return [replace(part, bar_id=number) for number, part in enumerate(taken, start=1)], left_out


def _is_selected(part: MeshPart, table: Selection, unit_m: float) -> bool:
    return table.matches({"name": (part.name,)}) and table.contains(part.mesh.vertices_m / unit_m)


def _check_spacing(parts: Sequence[MeshPart], spec: MeshFileSpec) -> None:
    """Raise ``MeshError`` if 32-bit coordinates are so large that they cannot tell 0.1 mm apart."""
    spacing_m = max(part.spacing_m for part in parts)
    if spacing_m > MAX_FLOAT32_SPACING_M:
        raise MeshError(
            f"{spec.path}: its 32-bit coordinates are {spacing_m * 1000:.3g} mm apart so far from the file's "
            f"origin, expected {MAX_FLOAT32_SPACING_M * 1000:g} mm or less: is the unit right? Otherwise export "
            "the cage near the origin, or in a format with 64-bit coordinates (OBJ, PLY with double, IFC)"
        )


def _fitted_bar(part: MeshPart, where: str) -> CageBar:
    """Return the bar of a part; raise ``MeshError`` that names the file ``where`` if its mesh has no area."""
    label = f"bar {part.bar_id}, {escape_text(part.name)}"
    try:
        return CageBar(label, fitted_bar(part.bar_id, part.mesh), mesh=part.mesh, source=escape_text(part.name))
    except ValueError as error:
        raise MeshError(
            f"{where}: {label} ({len(part.mesh.faces)} triangles) is not a valid surface: {error}"
        ) from error


def _check_unit(unit_m: float, where: str) -> None:
    """Raise ``MeshError`` unless a file unit is a positive finite length."""
    if not (math.isfinite(unit_m) and unit_m > 0):
        raise MeshError(f"{where}: one file unit is {unit_m} m, expected a positive length")
