"""The door for users' own assemblies: a mesh file becomes bars and parts in world metres, as it stands.

Nothing is moved: the file's frame is the world, z up, with the board at z = 0. What counts as a bar in each
format, and which id it gets, is told in ``mesh_parts``.

What a bar's mesh tells of the bar: its straight centreline and its diameter.
"""

from __future__ import annotations

import hashlib
import math
import os
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.scene_schema import UNITS_M
from dataset_builder.config.specs import MeshFileSpec
from dataset_builder.scene.assemblies.mesh_import import SUFFIXES, read_parts
from dataset_builder.scene.model import ESTIMATED, STEEL, Assembly, Bar, Mesh, Part
from rebar_depth_bench.errors import MeshError

# Of a surface's area to the power 3/2: a closed sheet of no thickness stays below, any wire far above.
_NO_VOLUME = 1e-9


def estimate_bar(bar_id: int, mesh: Mesh) -> Bar:
    """Return the bar that ``mesh`` (world metres) looks like, with role ``imported``.

    The axis is the straight line through the centroid along the principal direction, as long as the mesh
    is along it, and runs towards the positive side of its dominant world axis. The diameter is that of the
    cylinder of equal length and volume where the mesh is closed, else twice the surface's mean distance
    from the axis. A bent bar is described no better than by such a line.

    Raises ``ValueError`` where every triangle has zero area.
    """
    # About a point near the mesh: a far origin would cancel digits.
    origin = mesh.vertices_m.mean(axis=0)
    body = trimesh.Trimesh(mesh.vertices_m - origin, mesh.faces)
    if not body.area > 0:
        raise ValueError("every triangle has zero area")
    direction = _principal_direction(body)
    closed = body.is_watertight and body.is_winding_consistent
    volume = abs(body.volume) if closed else 0.0
    solid = volume > _NO_VOLUME * body.area**1.5
    centroid = body.center_mass if solid else body.centroid
    offset = body.triangles - centroid
    along = offset @ direction
    low, high = float(along.min()), float(along.max())
    if solid:
        diameter = math.sqrt(4 * volume / (math.pi * (high - low)))
    else:
        distance = np.linalg.norm(offset - along[..., None] * direction, axis=-1).mean(axis=1)
        diameter = 2 * float(np.average(distance, weights=body.area_faces))
    ends = (_point(origin + centroid + low * direction), _point(origin + centroid + high * direction))
    return Bar(bar_id, ESTIMATED, diameter, ends)


def _principal_direction(body: trimesh.Trimesh) -> Float64[ndarray, " 3"]:
    """Return the unit direction of largest surface spread; tessellation does not weigh in."""
    offset = body.triangles - body.centroid
    total = offset.sum(axis=1)
    # The integral of x x^T over a triangle is area/12 (sum of v v^T over its corners + s s^T), s their sum.
    spread = np.einsum("n,nki,nkj->ij", body.area_faces, offset, offset)
    spread += np.einsum("n,ni,nj->ij", body.area_faces, total, total)
    direction: Float64[ndarray, " 3"] = np.linalg.eigh(spread)[1][:, -1]
    return direction if direction[np.argmax(np.abs(direction))] > 0 else -direction


def _point(value: Float64[ndarray, " 3"]) -> tuple[float, float, float]:
    x, y, z = value.tolist()
    return x, y, z


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
