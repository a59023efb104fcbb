"""Cages from users' files: bars of a scene TOML, an IFC model or a mesh, placed in the world and checked."""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, with_ribs_chosen
from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut, unit_scale
from dataset_builder.scene.model import Assembly, Note
from dataset_builder.specs.file_specs import (
    CageFileSpec,
    MeshFileSpec,
    PinnedFile,
    PlacementSpec,
    Selection,
    Trust,
)
from dataset_builder.user_files.cage_checks import cage_problems, check_values, raise_problems
from dataset_builder.user_files.cage_placement import placed
from dataset_builder.user_files.ifc_file import ifc_cage
from dataset_builder.user_files.mesh_import import (
    MAX_FLOAT32_SPACING_M,
    SUFFIXES,
    MeshPart,
    axis_notes,
    fitted_bar,
    read_parts,
)
from dataset_builder.user_files.toml_bars import toml_cage
from rebar_depth_bench.errors import MeshError, Problem, escape_text
from rebar_depth_bench.limits import IFC_BYTES, MESH_BYTES, TOML_BYTES
from rebar_depth_bench.reading import read_file
from rebar_depth_bench.validation import UNITS_M

_SUFFIXES = (".toml", ".ifc")
_GLTF_CONVERSION = (
    ": convert glTF to OBJ, as with python -c "
    "\"import trimesh; trimesh.load_scene('FILE.glb').export('FILE.obj')\", "
    'and name the OBJ file in a scene TOML with mesh = "FILE.obj", unit = "m" and up = "y"'
)
_LIMITS = {".toml": TOML_BYTES, ".ifc": IFC_BYTES}
"""Limits of the files of an assembly by suffix; those of meshes have ``MESH_BYTES``."""


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


def load_cage(spec: CageFileSpec | MeshFileSpec, cage: Cage | None = None) -> Assembly:
    """Return the file's bars, in its order, and a mesh (world, metres) for each of them.

    The file is not read if ``cage`` is what was read from it. Raises as ``read_cage``, and ``MeshError`` if the
    bars are not valid (see ``cage_assembly``).
    """
    return cage_assembly(cage or read_cage(spec), spec.path)


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
    content = _pinned_content(spec, "cage", _SUFFIXES)
    if Path(spec.path).suffix.lower() == ".ifc":
        return ifc_cage(content, spec.path, spec.select, spec.trust)
    return toml_cage(content, spec.path)


_MAX_REASONS = 5
"""Largest number of reasons for leaving out objects that a note gives."""


def _pinned_content(spec: PinnedFile, kind: str, suffixes: Collection[str]) -> bytes:
    """Return the content of the file of a spec.

    Raises as ``read_assembly_file``, and ``MeshError`` if the content is not that of the spec.
    """
    content = read_assembly_file(spec.path, kind, suffixes)
    actual_sha256 = hashlib.sha256(content).hexdigest()
    if actual_sha256 != spec.sha256:
        raise MeshError(
            f"{spec.path}: the file has changed since it was selected: its sha256 is {actual_sha256}, "
            f"expected {spec.sha256}"
        )
    return content


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


def cage_assembly(cage: Cage, where: str) -> Assembly:
    """Return the assembly of a cage's bars, in their order (world frame, metres).

    A bar is ribbed unless its ``ribs`` is false or it would have more than ``MAX_RIBS_PER_ROW`` ribs in a row.
    If the ribbed bars have more than ``MAX_RIBS_PER_CAGE`` ribs altogether, no bar is ribbed.

    Raises ``MeshError`` with all ``problems`` of the cage, or with all bars of which no mesh can be made.
    """
    raise_problems(cage.problems, where)
    meshes, problems = [], []
    for bar in with_ribs_chosen(cage.bars):
        try:
            meshes.append((bar.bar, bar_mesh(bar)))
        except ValueError as error:
            problems.append(Problem("invalid", bar.label, str(error)))
    raise_problems(problems, where)
    without_axis = [bar.label for bar in cage.bars if not bar.bar.has_axis]
    notes = [*cage.notes, *axis_notes(where, without_axis, len(cage.bars))]
    return Assembly.from_meshes(meshes, (*notes, *_left_out_notes(cage, where)), cage.world_from_source)


def _left_out_notes(cage: Cage, where: str) -> tuple[Note, ...]:
    """Return the note that counts the objects of the file that are not in the cage, or none."""
    if not cage.left_out:
        return ()
    reasons = Counter(record.reason for record in cage.left_out).most_common(_MAX_REASONS)
    counted = ", ".join(f"{count} ({reason})" for reason, count in reasons)
    text = f"{len(cage.left_out)} objects are left out, which rebar-build inspect lists: {counted}"
    return (Note(where, "left-out", text),)


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
    if not (math.isfinite(unit_m) and unit_m > 0):
        raise MeshError(f"{path}: one file unit is {unit_m} m, expected a positive length")
    digest = hashlib.sha256(read_assembly_file(path, "mesh", SUFFIXES)).hexdigest()
    return MeshFileSpec(os.fspath(path), digest, unit_m, placement or PlacementSpec(), select)


def read_mesh(spec: MeshFileSpec) -> Cage:
    """Return the selected parts of a mesh file as bars, by ascending id (the file's frame, metres).

    A bar's axis and diameter are fitted to its mesh (``fitted_bar``), or null where no tube fits; parts need not
    be watertight. Selected parts are numbered from 1, but those of the dataset's own PLY keep their ids.

    Raises ``MeshError`` if the file cannot be read, does not match ``spec.sha256``, holds no bar, more than
    65,535 bars, a bar without area or a non-finite coordinate, or stores coordinates that are too coarse.
    """
    parts = read_parts(_pinned_content(spec, "mesh", SUFFIXES), spec)
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
