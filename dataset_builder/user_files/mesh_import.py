"""Mesh file import: the parts of a file's content as bars, in the file's frame and in metres.

- The dataset's own PLY layout (``dataset_builder.scene.mesh_ply``) is used unchanged: the faces with one
  ``bar_id`` form a part with that id; faces with id 0 (board, table) are left out.
- Every other file is read by ``mesh_formats``. If it holds several OBJ objects (``o``), each is a part, unless no
  tube fits it and one fits each of its connected components: then these are parts with the object's name and a
  number. Parts are numbered from 1 in the order of their names, with numbers within names compared by value
  ("bar2" before "bar10").
- A file with one object (any STL or PLY) is split into connected components after vertices closer than 10 nm
  are merged. Components are numbered from 1 in the order of their first faces. Bars that share a vertex are
  one part.

Except in the dataset's own PLY, a closed part that is wound inside out is reversed.

trimesh takes more than half a second to import, which builds of the standard scenes do not need, so functions
import it on use.
"""

from __future__ import annotations

import logging
import re
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Integer
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut, unit_scale
from dataset_builder.scene.mesh_ply import has_mesh_ply_header, parse_mesh_ply
from dataset_builder.scene.model import ESTIMATED_ROLE, MAX_BARS, NOT_STEEL, Mesh, axis_of
from dataset_builder.specs.file_specs import MeshFileSpec, nearest_names
from dataset_builder.user_files.mesh_formats.parsing import MalformedMeshError, Surface, first_true
from dataset_builder.user_files.mesh_formats.ply import read_ply
from dataset_builder.user_files.mesh_formats.stl_obj import read_obj, read_stl
from dataset_builder.user_files.tubes.tube_fit import Tube, fit_tube
from dataset_builder.user_files.tubes.tube_surface import component_labels
from rebar_depth_bench.base.errors import DatasetError, MeshError, escape_text
from rebar_depth_bench.base.limits import MESH_SECONDS
from rebar_depth_bench.data.bars import Bar

if TYPE_CHECKING:
    import trimesh

_READERS: Mapping[str, Callable[[bytes], Mapping[str, Surface]]] = {
    ".obj": read_obj,
    ".ply": read_ply,
    ".stl": read_stl,
}
SUFFIXES = tuple(_READERS)
"""Supported suffixes of mesh files, in lower case."""

_MAX_FLOAT32_SPACING_M = 1e-4
"""Largest distance of neighbouring 32-bit coordinates that is accepted, metres."""

# A handler on trimesh's logger keeps its messages, including tracebacks, off stderr.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Part of a file: id, name and mesh (the file's frame, metres).

    ``object_name`` is the name of the object that it is a piece of; ``tube`` what was fitted to the piece.
    """

    bar_id: int
    name: str
    mesh: Mesh
    object_name: str = ""
    tube: Tube | None = None


def mesh_cage(content: bytes, spec: MeshFileSpec) -> Cage:
    """Return the selected parts of a mesh file as bars, by ascending id (the file's frame, metres).

    A bar's axis and diameter are fitted to its mesh (``fitted_bar``), or null where no tube fits; parts need not
    be watertight. Selected parts are numbered from 1, but without a selection those of the dataset's own PLY keep
    their ids.

    Raises ``MeshError`` as ``read_parts``, if no part is selected, for a part without area, and after
    ``MESH_SECONDS`` of processor time.
    """
    deadline_s = time.process_time() + MESH_SECONDS.value()
    taken, left_out = _selected(read_parts(content, spec, deadline_s), spec)
    bars = []
    for part in taken:
        _check_time(deadline_s, spec.path)
        label = f"bar {part.bar_id}, {escape_text(part.name)}"
        try:
            bar = fitted_bar(part.bar_id, part.mesh, part.tube)
        except ValueError as error:
            found = f"{label} ({len(part.mesh.faces)} triangles) is not a valid surface"
            raise MeshError(f"{spec.path}: {found}: {error}") from error
        bars.append(CageBar(label, bar, mesh=part.mesh, source=escape_text(part.name)))
    return Cage(tuple(bars), tuple(left_out), unit_scale(spec.unit_m))


def _check_time(deadline_s: float, where: str) -> None:
    """Raise ``MeshError`` that names the file ``where`` if this processor time is over."""
    if time.process_time() > deadline_s:
        found = f"finding the bars takes more than {MESH_SECONDS.value()} s of processor time"
        raise MeshError(f"{where}: {found}, expected {MESH_SECONDS.allowed('s')}")


def _selected(parts: list[MeshPart], spec: MeshFileSpec) -> tuple[list[MeshPart], list[LeftOut]]:
    """Return the parts that any table selects, numbered again, and those left out."""
    if not spec.select:
        return parts, []
    taken, left_out = list[MeshPart](), list[LeftOut]()
    for part in parts:
        points = part.mesh.vertices_m / spec.unit_m
        if any(
            table.matches({"name": (part.name, part.object_name)}) and table.contains(points)
            for table in spec.select
        ):
            taken.append(replace(part, bar_id=len(taken) + 1))
        else:
            left_out.append(LeftOut(escape_text(part.name), "no [[select]] table matches"))
    if not taken:
        names = [name for part in parts for name in (part.object_name, part.name) if name]
        raise MeshError(
            f"{spec.path}: no part is selected, expected [[select]] tables that match at least one of its "
            f"{len(parts)} parts{nearest_names(spec.select, {'name': names})}"
        )
    return taken, left_out


def read_parts(content: bytes, spec: MeshFileSpec, deadline_s: float) -> list[MeshPart]:
    """Return the parts of a file's ``content``, by ascending id; the suffix of ``spec.path`` selects the format.

    Raises ``MeshError`` if the content cannot be read, holds no triangle, only id 0, more than ``MAX_BARS`` parts
    or a non-finite coordinate, stores coordinates that are too coarse, or takes longer than to the processor time
    ``deadline_s``. Any exception that a damaged or hostile file causes becomes one of one line.
    """
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            if Path(spec.path).suffix.lower() == ".ply" and has_mesh_ply_header(content):
                return _dataset_ply_parts(content, spec)
            return _numbered_parts(_read_objects(content, spec), spec, deadline_s)
    except MeshError:
        raise
    except MalformedMeshError as error:
        rejected = MeshError(f"{spec.path}: {error.problem}")
        rejected.problems = (error.problem,)
        raise rejected from None
    except DatasetError as error:
        raise MeshError(str(error)) from error
    except Exception as error:
        reason = shorten(f"{type(error).__name__}: {error}", 200)
        raise MeshError(f"{spec.path}: not a readable mesh file of its type ({reason})") from error


def _dataset_ply_parts(content: bytes, spec: MeshFileSpec) -> list[MeshPart]:
    """Return the parts of a PLY in the dataset's own layout, bit by bit if the unit is the metre."""
    scene = parse_mesh_ply(content, spec.path)
    whole, ids = Mesh(scene.vertices_m * spec.unit_m, scene.faces), scene.face_bar_id
    meshes = {int(ids[group[0]]): _submesh(whole, group) for group in _indices_by_label(ids)}
    if meshes.pop(NOT_STEEL, None) is not None and not meshes:
        raise MeshError(f"{spec.path}: every face has bar_id 0 (not steel), expected at least one bar")
    return [MeshPart(bar_id, f"bar {bar_id}", mesh) for bar_id, mesh in meshes.items()]


def _numbered_parts(objects: Mapping[str, Mesh], spec: MeshFileSpec, deadline_s: float) -> list[MeshPart]:
    """Return the parts of objects that are ordered; a single one is split, and others if their pieces are bars."""
    parts: list[MeshPart] = []
    for name, mesh in objects.items():
        whole = _mesh_of(_merged_close_vertices(mesh))
        pieces = connected_components(whole)
        if len(objects) == 1:
            parts += [MeshPart(0, f"part {number}", piece, name) for number, piece in enumerate(pieces, start=1)]
            continue
        tubes: list[Tube] = []
        if len(pieces) > 1 and fit_tube(whole.vertices_m, whole.faces) is None:
            for piece in pieces:
                _check_time(deadline_s, spec.path)
                tube = fit_tube(piece.vertices_m, piece.faces)
                if tube is None:
                    break
                tubes.append(tube)
        if len(tubes) == len(pieces):
            numbered = enumerate(zip(pieces, tubes, strict=True), start=1)
            parts += [MeshPart(0, f"{name} {number}", piece, name, tube) for number, (piece, tube) in numbered]
        else:
            parts.append(MeshPart(0, name, whole, name))
    if len(parts) > MAX_BARS:
        raise MeshError(f"{spec.path}: {len(parts)} separate parts found, expected at most {MAX_BARS} bars")
    return [
        replace(part, bar_id=bar_id, mesh=_oriented_outward(part.mesh))
        for bar_id, part in enumerate(parts, start=1)
    ]


def _read_objects(content: bytes, spec: MeshFileSpec) -> dict[str, Mesh]:
    """Return the objects of a file of any program, ordered by name, without empty ones."""
    surfaces = _READERS[Path(spec.path).suffix.lower()](content)
    for vertices, faces in surfaces.values():
        row = first_true(~np.isfinite(vertices).all(axis=1))
        if row is not None:
            found = f"it is {vertices[row].tolist()}"
            raise MalformedMeshError("invalid", f"vertex {row + 1}", found, "finite coordinates")
        row = first_true(((faces < 0) | (faces >= len(vertices))).any(axis=1))
        if row is not None:
            found = f"the corners are the vertices {faces[row].tolist()}"
            raise MalformedMeshError("invalid", f"triangle {row + 1}", found, f"0 to {len(vertices) - 1}")
    objects = {
        name: Mesh(vertices.astype(np.float64) * spec.unit_m, faces.astype(np.int32))
        for name, (vertices, faces) in sorted(surfaces.items(), key=lambda item: _natural_sort_key(item[0]))
        if len(faces)
    }
    if not objects:
        raise MeshError(f"{spec.path}: no triangle found, expected the surface of at least one bar")
    for vertices, _ in surfaces.values():
        _check_spacing(vertices, spec)
    return objects


def _check_spacing(vertices: Float[ndarray, "v 3"], spec: MeshFileSpec) -> None:
    """Raise ``MeshError`` if 32-bit coordinates are so large that they cannot tell 0.1 mm apart."""
    spacing_m = spec.unit_m * float(np.spacing(np.abs(vertices).max())) if vertices.dtype == np.float32 else 0.0
    if spacing_m > _MAX_FLOAT32_SPACING_M:
        raise MeshError(
            f"{spec.path}: its 32-bit coordinates are {spacing_m * 1000:.3g} mm apart so far from the file's "
            f"origin, expected {_MAX_FLOAT32_SPACING_M * 1000:g} mm or less: is the unit right? Otherwise export "
            "the cage near the origin, or in a format with 64-bit coordinates (OBJ, PLY with double, IFC)"
        )


def _natural_sort_key(name: str) -> tuple[list[str | int], str]:
    """Return a sort key that compares numbers within names by value."""
    return [int(text) if index % 2 else text for index, text in enumerate(re.split(r"(\d+)", name))], name


def connected_components(mesh: Mesh) -> list[Mesh]:
    """Return the connected components, ordered by their first faces; faces and vertices keep their order."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    vertex_label = component_labels(edges, len(mesh.vertices_m))
    groups = _indices_by_label(vertex_label[mesh.faces[:, 0]])
    return [_submesh(mesh, group) for group in sorted(groups, key=lambda group: int(group[0]))]


def _indices_by_label(label: Integer[ndarray, " n"]) -> list[Integer[ndarray, " k"]]:
    """Return the ascending indices at which each label occurs, ordered by label."""
    order = np.argsort(label, kind="stable")
    return [group for group in np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if len(group)]


def _submesh(mesh: Mesh, faces_kept: Integer[ndarray, " k"]) -> Mesh:
    """Return the faces ``faces_kept`` with the vertices they use; vertices and faces keep their order."""
    faces = mesh.faces[faces_kept]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices_m[used], index.reshape(faces.shape).astype(np.int32))


def _merged_close_vertices(mesh: Mesh) -> trimesh.Trimesh:
    """Return the mesh with vertices closer than 10 nm merged."""
    import trimesh

    return trimesh.Trimesh(mesh.vertices_m, mesh.faces)


def _mesh_of(body: trimesh.Trimesh) -> Mesh:
    return Mesh(np.array(body.vertices), np.array(body.faces, np.int32))


def _oriented_outward(mesh: Mesh) -> Mesh:
    """Return the mesh with close vertices merged, reversed if it is closed and wound inside out."""
    body = _merged_close_vertices(mesh)
    if body.is_watertight and body.is_winding_consistent and body.volume < 0:
        body.invert()
    return _mesh_of(body)


def fitted_bar(bar_id: int, mesh: Mesh, tube: Tube | None = None) -> Bar:
    """Return the bar of a surface (world, metres), with role ``imported``; without axis if no tube fits.

    ``tube`` is what was fitted to the surface before. Raises ``ValueError`` if every triangle has zero area.
    """
    a_m, b_m, c_m = mesh.vertices_m[mesh.faces].transpose(1, 0, 2)
    with np.errstate(all="ignore"):  # Products of huge lengths overflow; such bars are refused by their extent.
        if not np.cross(b_m - a_m, c_m - a_m).any():
            raise ValueError("every triangle has zero area")
        tube = tube or fit_tube(mesh.vertices_m, mesh.faces)
    if tube is None:
        return Bar.without_axis(bar_id, ESTIMATED_ROLE)
    return Bar(bar_id, ESTIMATED_ROLE, tube.diameter_m, axis_of(tube.axis_m))
