"""The door for users' own assemblies: a mesh file becomes bars and parts in world metres, as it stands.

Nothing is moved: the file's frame is the world, z up, with the board at z = 0. What counts as a bar in each
format, and which id it gets, is told in ``mesh_parts``.
"""

from __future__ import annotations

import hashlib
import math
import os
from pathlib import Path

from dataset_builder.assemblies.bar_estimate import estimate_bar
from dataset_builder.assemblies.mesh_parts import SUFFIXES, read_parts
from dataset_builder.length_units import UNITS_M
from dataset_builder.model import STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.specs import MeshFileSpec
from rebar_depth_bench.errors import MeshError


def mesh_file_spec(path: str | os.PathLike[str], unit: str | float) -> MeshFileSpec:
    """Return the spec that pins a mesh file's present content.

    ``unit`` is one file unit: a name out of ``UNITS_M``, or metres. glTF is in metres by its specification,
    so that ``"m"`` is right unless its exporter did otherwise.

    Raises ``MeshError`` where the unit is unknown or the file cannot be read or has an unknown suffix.
    """
    if isinstance(unit, str) and unit not in UNITS_M:
        raise MeshError(f"{path}: unknown unit {unit!r}, expected one of {', '.join(UNITS_M)} or metres")
    unit_m = UNITS_M[unit] if isinstance(unit, str) else float(unit)
    _check_unit(unit_m, str(path))
    return MeshFileSpec(os.fspath(path), hashlib.sha256(_content(path)).hexdigest(), unit_m)


def load_assembly(spec: MeshFileSpec) -> Assembly:
    """Return the file's bars, by ascending id, and a part in world metres for each of them.

    A bar's axis and diameter are estimated from its mesh (``estimate_bar``); parts need not be watertight.

    Raises ``MeshError`` where the file cannot be read, is not the one that ``spec.sha256`` pins, holds no
    bar, more than 65,535 bars, a bar without area or a coordinate that is not finite, or where its extent
    is absurd for the unit.
    """
    _check_unit(spec.unit_m, spec.path)
    content = _content(spec.path)
    found = hashlib.sha256(content).hexdigest()
    if found != spec.sha256:
        raise MeshError(f"{spec.path}: changed since it was chosen: sha256 {found} found, {spec.sha256} expected")
    meshes = read_parts(content, spec)
    return Assembly(
        bars=tuple(_bar(bar_id, mesh, spec.path) for bar_id, mesh in meshes.items()),
        parts=tuple(Part(f"bar-{bar_id:03d}", mesh, bar_id, STEEL) for bar_id, mesh in meshes.items()),
    )


def _bar(bar_id: int, mesh: Mesh, where: str) -> Bar:
    try:
        return estimate_bar(bar_id, mesh)
    except ValueError as error:
        raise MeshError(f"{where}: bar {bar_id} ({len(mesh.faces)} triangles) is no surface: {error}") from error


def _check_unit(unit_m: float, where: str) -> None:
    if not (math.isfinite(unit_m) and unit_m > 0):
        raise MeshError(f"{where}: one file unit is {unit_m} m, expected a positive length")


def _content(path: str | os.PathLike[str]) -> bytes:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(f"{path}: mesh files of kind {suffix!r} are not read, expected {', '.join(SUFFIXES)}")
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: the mesh file cannot be read: {error.strerror or error}") from error
