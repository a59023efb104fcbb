"""Cages from users' files: bars of a scene TOML, an IFC model or a mesh, placed in the world and checked."""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Literal

import numpy as np

from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, estimated_triangles, with_ribs_chosen
from dataset_builder.scene.assemblies.cage import Cage, CageBar, unit_scale
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS, Assembly, Note, axis_of
from dataset_builder.scene.shapes.bending import bent_line_m, mandrel_diameter_m
from dataset_builder.specs.file_specs import (
    CageFileSpec,
    MeshFileSpec,
    PlacementSpec,
    Selection,
    Trust,
)
from dataset_builder.user_files.cage_placement import placed
from dataset_builder.user_files.ifc_file import ifc_cage
from dataset_builder.user_files.mesh_import import SUFFIXES as MESH_SUFFIXES
from dataset_builder.user_files.mesh_import import mesh_cage
from dataset_builder.user_files.scene_schema import TomlBar, read_scene_toml
from rebar_depth_bench.base.errors import InputError, MeshError, Problem
from rebar_depth_bench.base.limits import IFC_BYTES, MESH_BYTES, TOML_BYTES
from rebar_depth_bench.base.reading import read_file
from rebar_depth_bench.base.validation import UNITS_M
from rebar_depth_bench.data.bars import Bar

_Kind = Literal["cage", "mesh"]
_SUFFIXES: Mapping[_Kind, Sequence[str]] = {"cage": (".toml", ".ifc"), "mesh": MESH_SUFFIXES}
_GLTF_CONVERSION = (
    ": convert glTF to OBJ, as with python -c "
    "\"import trimesh; trimesh.load_scene('FILE.glb').export('FILE.obj')\", "
    'and name the OBJ file in a scene TOML with mesh = "FILE.obj", unit = "m" and up = "y"'
)
_LIMITS = {".toml": TOML_BYTES, ".ifc": IFC_BYTES}
"""Limits of the files of an assembly by suffix; those of meshes have ``MESH_BYTES``."""

_MAX_NAMED = 10
"""Largest number of bars that a note names."""

_MAX_REASONS = 5
"""Largest number of reasons for leaving out objects that a note gives."""

MIN_DIAMETER_M, MAX_DIAMETER_M = 0.0005, 0.2
"""Bounds of a bar's diameter: thin binding wire, and far more than the thickest bar made.

Beyond them the unit is wrong.
"""

MIN_EXTENT_M = 0.001
MAX_EXTENT_M = 100.0
"""Exclusive bounds of the largest side of a cage, metres; beyond them its unit is wrong."""

MAX_TRIANGLES = 20_000_000
"""Largest estimated number of triangles of a cage."""

_SAME_AXIS_M = 1e-6
"""Grid spacing to which axes are rounded for the comparison of bars, metres."""


def cage_file_spec(
    path: str | os.PathLike[str],
    placement: PlacementSpec = PlacementSpec(),  # noqa: B008
    select: tuple[Selection, ...] = (),
    trust: Trust = "declared",
) -> CageFileSpec:
    """Return the spec of a TOML or IFC file, which fixes its present content by SHA-256.

    Raises ``MeshError`` if it cannot be read or its suffix is neither ``.toml`` nor ``.ifc``.
    """
    digest = hashlib.sha256(_read_user_file(path, "cage")).hexdigest()
    return CageFileSpec(os.fspath(path), digest, placement, select, trust)


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
    digest = hashlib.sha256(_read_user_file(path, "mesh")).hexdigest()
    return MeshFileSpec(os.fspath(path), digest, unit_m, placement or PlacementSpec(), select)


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
    content = _pinned_content(spec)
    if isinstance(spec, MeshFileSpec):
        source = mesh_cage(content, spec)
    elif Path(spec.path).suffix.lower() == ".ifc":
        source = ifc_cage(content, spec.path, spec.select, spec.trust)
    else:
        source = _toml_cage(content, spec.path)
    check_values(source.bars, spec.path)
    cage = placed(source, spec.placement, spec.path)
    return replace(cage, problems=(*cage.problems, *cage_problems(cage.bars)))


def _toml_cage(content: bytes, where: str) -> Cage:
    """Return the bars of a scene TOML file, in its order (the file's frame, metres).

    Raises ``MeshError`` that names the file ``where`` and all bars that cannot be bent.
    """
    try:
        scene = read_scene_toml(content, where)
    except InputError as error:
        raise MeshError.from_problems(where, error.problems) from error
    cage_bars, problems = [], []
    for number, bar in _single_bars(scene.bar):
        label = f"bar {bar.bar_id} ({bar.role}, diameter {bar.diameter_m:g} m)"
        mandrel_m = mandrel_diameter_m(bar.diameter_m) if bar.mandrel_m is None else bar.mandrel_m
        try:
            line_m = bent_line_m(np.array(bar.corners_m), (mandrel_m + bar.diameter_m) / 2)
        except ValueError as error:
            problems.append(Problem("invalid", label, str(error), "a path that is long enough for its bends"))
            continue
        bent = Bar(bar.bar_id, bar.role, bar.diameter_m, axis_of(line_m))
        cage_bars.append(CageBar(label, bent, bar.ribs, source=f"bar {number}"))
    raise_problems(problems, where)
    return Cage(tuple(cage_bars), (), unit_scale(scene.unit_m))


def _single_bars(tables: Sequence[TomlBar]) -> Iterator[tuple[int, TomlBar]]:
    """Yield bars in file order with the numbers of their tables; those without an id get the lowest free ids."""
    used_ids = {table.bar_id + place for table in tables if table.bar_id for place in range(table.count)}
    free_ids = (bar_id for bar_id in count(1) if bar_id not in used_ids)
    for number, table in enumerate(tables, start=1):
        for place in range(table.count):
            bar_id = table.bar_id + place if table.bar_id else next(free_ids)
            moved_m = np.array(table.corners_m) + place * np.array(table.step_m)
            corners_m = axis_of(np.round(moved_m, METRE_DECIMALS))
            yield number, table.model_copy(update={"bar_id": bar_id, "corners_m": corners_m})


def _pinned_content(spec: CageFileSpec | MeshFileSpec) -> bytes:
    """Return the content of the file of a spec.

    Raises as ``_read_user_file``, and ``MeshError`` if the content is not that of the spec.
    """
    content = _read_user_file(spec.path, "mesh" if isinstance(spec, MeshFileSpec) else "cage")
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


def _read_user_file(path: str | os.PathLike[str], kind: _Kind) -> bytes:
    """Return the bytes of a user's file.

    Raises ``MeshError`` if its suffix is not one of its kind, it cannot be read or it is too large.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _SUFFIXES[kind]:
        raise MeshError(unsupported_type(path, kind, ", ".join(_SUFFIXES[kind])))
    return read_file(Path(path), _LIMITS.get(suffix, MESH_BYTES), f"a {kind} file", MeshError)


def check_values(bars: Sequence[CageBar], where: str) -> None:
    """Raise ``MeshError`` for no bar or too many, and for coordinates that are not finite."""
    if not 1 <= len(bars) <= MAX_BARS:
        raise MeshError(f"{where}: {len(bars)} bars found, expected 1 to {MAX_BARS}")
    unbounded = [bar for bar in bars if not np.isfinite(bar.points_m).all()]
    problems = [Problem("invalid", bar.label, "a coordinate is not finite", "finite numbers") for bar in unbounded]
    raise_problems(problems, where)


def cage_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return the reasons to refuse bars in the world frame, whose coordinates are finite.

    They are implausible diameters, bars far from the origin, an implausible size of the whole, bars with the same
    axis, and too many triangles.
    """
    problems = [problem for bar in bars for problem in _bar_problems(bar)]
    if not problems:
        problems = [*_extent_problems(bars), *_duplicate_axis_problems(bars)]
    return problems or _size_problems(bars)


def raise_problems(problems: Sequence[Problem], where: str) -> None:
    """Raise ``MeshError`` with all ``problems`` of the file ``where``, if there are any."""
    if problems:
        raise MeshError.from_problems(where, problems)


def _bar_problems(bar: CageBar) -> list[Problem]:
    """Return what is wrong with one bar: its diameter, or points too far away."""
    diameter_m, farthest_m = bar.bar.diameter_m, float(np.abs(bar.points_m).max())
    problems = []
    if bar.bar.has_axis and not MIN_DIAMETER_M <= diameter_m <= MAX_DIAMETER_M:  # Also catches NaN.
        expected = f"{MIN_DIAMETER_M:g} to {MAX_DIAMETER_M:g} m: is the unit right?"
        problems.append(Problem("invalid", bar.label, f"the diameter is {diameter_m:.6g} m", expected))
    if farthest_m > MAX_EXTENT_M:
        found = f"extends {farthest_m:.6g} m from the world's origin"
        expected = f"at most {MAX_EXTENT_M:g} m: is the unit right, and is the cage at the origin?"
        problems.append(Problem("invalid", bar.label, found, expected))
    return problems


def _extent_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return a problem if the largest side of the cage is implausible, else an empty list."""
    points_m = np.concatenate([bar.points_m for bar in bars])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if MIN_EXTENT_M < extent_m < MAX_EXTENT_M:
        return []
    expected = f"{MIN_EXTENT_M:g} to {MAX_EXTENT_M:g} m: is the unit right?"
    return [Problem("invalid", "", f"the cage is {extent_m:.6g} m long", expected)]


def _size_problems(bars: Sequence[CageBar]) -> list[Problem]:
    triangles = sum(map(estimated_triangles, with_ribs_chosen(bars)))
    if triangles <= MAX_TRIANGLES:
        return []
    expected = f"at most {MAX_TRIANGLES}: choose a part of the model with [[select]] tables in a scene TOML file"
    return [Problem("invalid", "", f"the bars make {triangles} triangles", expected)]


def _duplicate_axis_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return a problem for each bar whose axis equals an earlier one, in either direction, to the micrometre.

    The pixels of such bars would be ambiguous.
    """
    first_label: dict[bytes, str] = {}
    problems = []
    for bar in bars:
        if not bar.bar.has_axis:
            continue
        steps = np.round(np.array(bar.bar.axis_m) / _SAME_AXIS_M).astype(np.int64)
        key = min(steps.tobytes(), steps[::-1].tobytes())
        if key in first_label:
            found = f"has the same axis as {first_label[key]}"
            problems.append(Problem("duplicate", bar.label, found, "distinct axes"))
        first_label.setdefault(key, bar.label)
    return problems


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
    return Assembly.from_meshes(meshes, (*cage.notes, *_file_notes(cage, where)), cage.world_from_source)


def _file_notes(cage: Cage, where: str) -> Iterator[Note]:
    """Yield the note that names the bars without an axis, and that which counts the objects that are left out."""
    labels = [bar.label for bar in cage.bars if not bar.bar.has_axis]
    if labels:
        named = ", ".join(labels[:_MAX_NAMED])
        more = f" and {len(labels) - _MAX_NAMED} more" if len(labels) > _MAX_NAMED else ""
        text = (
            f"{len(labels)} of {len(cage.bars)} bars are not the surface of one round bar and have neither axis "
            f"nor diameter; measures of bars leave them out: {named}{more}"
        )
        yield Note(where, "axis", text)
    if cage.left_out:
        reasons = Counter(record.reason for record in cage.left_out).most_common(_MAX_REASONS)
        counted = ", ".join(f"{count} ({reason})" for reason, count in reasons)
        text = f"{len(cage.left_out)} objects are left out, which rebar-build inspect lists: {counted}"
        yield Note(where, "left-out", text)
