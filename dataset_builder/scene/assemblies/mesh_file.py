"""User mesh files (STL, PLY, OBJ, glTF) as assemblies: bars and parts in world metres.

Nothing is moved: the file's frame is the world frame, z up, with the board at z = 0. The module
``mesh_import`` defines what counts as a bar in each format and which id it gets. The straight centreline and
the diameter of each bar are estimated from its mesh.
"""

from __future__ import annotations

import hashlib
import math
import os
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.scene_schema import UNITS_M
from dataset_builder.config.specs import MeshFileSpec, read_assembly_file
from dataset_builder.scene.assemblies.mesh_import import SUFFIXES, read_parts
from dataset_builder.scene.model import ESTIMATED_ROLE, STEEL, Assembly, Mesh, Part, axis_of
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import MeshError

if TYPE_CHECKING:
    import trimesh

_MIN_RELATIVE_VOLUME = 1e-9
"""Least volume of a solid, relative to its surface area to the power 3/2.

A closed sheet without thickness lies below it, any wire far above.
"""


def estimate_bar(bar_id: int, mesh: Mesh) -> Bar:
    """Return the bar that approximates ``mesh`` (world, metres), with role ``imported``.

    The axis is the straight line through the centroid along the principal direction. Its length is the mesh's
    extent along that direction, and it points towards the positive side of its dominant world axis. The
    diameter is that of the cylinder of equal length and volume if the mesh is closed, else twice the
    surface's mean distance from the axis. A bent bar is approximated by such a straight line too.

    Raises ``ValueError`` if every triangle has zero area.
    """
    import trimesh

    # Coordinates relative to a point near the mesh, since a far origin would cost digits by cancellation.
    origin = mesh.vertices_m.mean(axis=0)
    body = trimesh.Trimesh(mesh.vertices_m - origin, mesh.faces)
    if not body.area > 0:
        raise ValueError("every triangle has zero area")
    direction = _principal_direction(body)
    closed = body.is_watertight and body.is_winding_consistent
    volume = abs(body.volume) if closed else 0.0
    solid = volume > _MIN_RELATIVE_VOLUME * body.area**1.5
    centroid = body.center_mass if solid else body.centroid
    offset = body.triangles - centroid
    along = offset @ direction
    low, high = float(along.min()), float(along.max())
    if solid:
        diameter = math.sqrt(4 * volume / (math.pi * (high - low)))
    else:
        distance = np.linalg.norm(offset - along[..., None] * direction, axis=-1).mean(axis=1)
        diameter = 2 * float(np.average(distance, weights=body.area_faces))
    ends = np.stack([origin + centroid + low * direction, origin + centroid + high * direction])
    return Bar(bar_id, ESTIMATED_ROLE, diameter, axis_of(ends))


def _principal_direction(body: trimesh.Trimesh) -> Float64[ndarray, " 3"]:
    """Return the unit direction of largest second moment of the surface, independent of its tessellation."""
    offset = body.triangles - body.centroid
    total = offset.sum(axis=1)
    # The integral of x x^T over a triangle is area/12 (sum of v v^T over its corners + s s^T), with s their sum.
    second_moment = np.einsum("n,nki,nkj->ij", body.area_faces, offset, offset)
    second_moment += np.einsum("n,ni,nj->ij", body.area_faces, total, total)
    direction: Float64[ndarray, " 3"] = np.linalg.eigh(second_moment)[1][:, -1]
    return direction if direction[np.argmax(np.abs(direction))] > 0 else -direction


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

    A bar's axis and diameter are estimated from its mesh (``estimate_bar``); parts need not be watertight.

    Raises ``MeshError`` if the file cannot be read, does not match ``spec.sha256``, holds no bar, more than
    65,535 bars, a bar without area or a non-finite coordinate, or if its extent is implausible for the unit.
    """
    _check_unit(spec.unit_m, spec.path)
    meshes = read_parts(spec.check(read_assembly_file(spec.path, "mesh", SUFFIXES)), spec)
    return Assembly(
        bars=tuple(_estimated_bar(bar_id, mesh, spec.path) for bar_id, mesh in meshes.items()),
        parts=tuple(Part(f"bar-{bar_id:03d}", mesh, bar_id, STEEL) for bar_id, mesh in meshes.items()),
    )


def _estimated_bar(bar_id: int, mesh: Mesh, where: str) -> Bar:
    """Return ``estimate_bar``; raise ``MeshError`` that names the file ``where`` if the mesh has no area."""
    try:
        return estimate_bar(bar_id, mesh)
    except ValueError as error:
        raise MeshError(
            f"{where}: bar {bar_id} ({len(mesh.faces)} triangles) is not a valid surface: {error}"
        ) from error


def _check_unit(unit_m: float, where: str) -> None:
    """Raise ``MeshError`` unless a file unit is a positive finite length."""
    if not (math.isfinite(unit_m) and unit_m > 0):
        raise MeshError(f"{where}: one file unit is {unit_m} m, expected a positive length")
