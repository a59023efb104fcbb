"""Plain operations on triangle meshes: check, join, cut, weld, orient."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int32, Integer
from numpy import ndarray
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dataset_builder.model import Mesh
from rebar_depth_bench.errors import MeshError

# No length in any unit: beyond it, volumes would leave the range of float64.
_MAX_COORDINATE = 1e30


def checked_mesh(vertices: ArrayLike, faces: ArrayLike, where: str) -> Mesh:
    """Return a ``Mesh`` of what a file holds.

    Raises ``MeshError`` where a coordinate is not finite or a face names a vertex that is not there.
    """
    with np.errstate(invalid="ignore"):  # a signalling NaN warns when it is widened
        points = np.asarray(vertices, np.float64).reshape(-1, 3)
    wild = np.flatnonzero(~(np.abs(points) < _MAX_COORDINATE).all(axis=1))
    if len(wild):
        raise MeshError(
            f"{where}: vertex {wild[0]} (counted from 0) is {points[wild[0]].tolist()}, "
            "expected finite coordinates"
        )
    corners = np.asarray(faces, np.int64).reshape(-1, 3)
    outside = np.flatnonzero(((corners < 0) | (corners >= len(points))).any(axis=1))
    if len(outside):
        row = outside[0]
        raise MeshError(
            f"{where}: triangle {row} names vertices {corners[row].tolist()} (counted from 0), "
            f"expected 0 to {len(points) - 1}"
        )
    return Mesh(points, corners.astype(np.int32))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return all meshes as one, in order."""
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])[:-1]
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]),
    )


def split_by_label(mesh: Mesh, face_label: Integer[ndarray, " n"]) -> dict[int, Mesh]:
    """Return one mesh per label, ascending; vertices and faces keep their order, unused vertices go."""
    order = np.argsort(face_label, kind="stable")
    labels, starts = np.unique(face_label[order], return_index=True)
    groups = np.split(order, starts[1:])
    return {int(label): _used_only(mesh, group) for label, group in zip(labels.tolist(), groups, strict=True)}


def component_labels(mesh: Mesh) -> Int32[ndarray, " n"]:
    """Return each face's component, numbered from 0 in the order of the components' first faces.

    Faces are connected where they share a vertex by index: ``weld`` first where the file repeats positions.
    """
    corner = mesh.faces
    pairs = np.concatenate([corner[:, :2], corner[:, 1:]])
    count = len(mesh.vertices_m)
    graph = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, vertex_label = connected_components(graph, directed=False)
    _, first_face, face_label = np.unique(vertex_label[corner[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(len(first_face), np.int32)
    rank[np.argsort(first_face)] = np.arange(len(first_face), dtype=np.int32)
    return np.asarray(rank[face_label.reshape(-1)], np.int32)


def weld(mesh: Mesh) -> Mesh:
    """Return the mesh with vertices of exactly equal position made one; the first of them keeps its place."""
    positions = mesh.vertices_m + 0.0  # makes -0.0 and 0.0 the same position
    # A stable sort, so that the first of each run of equals is the one that comes first in the file.
    order = np.lexsort(positions.T)
    starts_run = np.ones(len(order), np.bool_)
    starts_run[1:] = (positions[order[1:]] != positions[order[:-1]]).any(axis=1)
    original = np.empty(len(order), np.intp)
    original[order] = order[starts_run][np.cumsum(starts_run) - 1]
    kept: Bool[ndarray, " v"] = original == np.arange(len(original))
    place = (np.cumsum(kept) - 1).astype(np.int32)
    return Mesh(mesh.vertices_m[kept], place[original][mesh.faces])


def is_closed(faces: Integer[ndarray, "n 3"]) -> bool:
    """Tell whether every edge is walked equally often in both directions: closed and consistently wound.

    Faces are compared by vertex index, so that the mesh has to be welded.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    stride = np.int64(edges.max(initial=0) + 1)
    forth = np.sort(edges[:, 0] * stride + edges[:, 1])
    back = np.sort(edges[:, 1] * stride + edges[:, 0])
    return bool(np.array_equal(forth, back))


def enclosed_volume(corners: Float64[ndarray, "n 3 3"]) -> float:
    """Return the volume inside a closed surface, negative where it is wound clockwise from outside."""
    # Tetrahedra about a point near the mesh: a far origin would cancel digits.
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def turned_outward(mesh: Mesh) -> Mesh:
    """Return the mesh with its winding reversed where it is closed and inside out; else as it is."""
    welded = weld(mesh)
    if not is_closed(welded.faces) or enclosed_volume(mesh.vertices_m[mesh.faces]) >= 0:
        return mesh
    return Mesh(mesh.vertices_m, np.ascontiguousarray(mesh.faces[:, ::-1]))


def _used_only(mesh: Mesh, faces_kept: Integer[ndarray, " k"]) -> Mesh:
    faces = mesh.faces[faces_kept]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices_m[used], index.reshape(faces.shape).astype(np.int32))
