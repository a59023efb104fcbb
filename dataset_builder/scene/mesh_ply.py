"""Reader and writer of ground-truth mesh files, ``meshes/<scene>.ply``, in one fixed binary layout.

Binary little-endian PLY: float64 vertices, int32 triangles and a ``ushort`` bar id per triangle (0: not
steel), in the world frame (right-handed, z up, board at z = 0), metres. Equal arrays give equal bytes.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import WorldMesh
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.limits import MESH_BYTES
from rebar_depth_bench.base.reading import read_file
from rebar_depth_bench.base.writing import atomic_replace

COMMENT = (
    "comment rebar-depth-bench mesh: world frame, right-handed, z up, board at z = 0;"
    " unit metre; bar_id 0 is not steel\n"
)
_HEADER = """\
ply
format binary_little_endian 1.0
{comment}element vertex {vertices}
property double x
property double y
property double z
element face {faces}
property list uchar int vertex_indices
property ushort bar_id
end_header
"""
_VERTEX = np.dtype([("xyz", "<f8", (3,))])
_FACE = np.dtype([("corners", "u1"), ("index", "<i4", (3,)), ("bar_id", "<u2")])
_HEADER_LIMIT = 1 << 16
"""Maximum header size in bytes: a file without ``end_header`` is not searched to its end."""
# Ten digits exceed int32, the type of vertex indices; longer counts are rejected without being converted.
_COUNT = r"([0-9]{1,10})"
_HEADER_PATTERN = re.compile(_HEADER.replace(".", r"\.").format(comment="", vertices=_COUNT, faces=_COUNT))
_COMMENTS = re.compile(r"^(?:comment|obj_info)(?: [^\n]*)?\n", re.MULTILINE)


def write_mesh_ply(path: str | os.PathLike[str], mesh: WorldMesh) -> None:
    """Write the mesh of a scene as a PLY file of the dataset, atomically."""
    header = _HEADER.format(comment=COMMENT, vertices=len(mesh.vertices_m), faces=len(mesh.faces))
    vertex_rows = np.empty(len(mesh.vertices_m), _VERTEX)
    vertex_rows["xyz"] = mesh.vertices_m
    face_rows = np.empty(len(mesh.faces), _FACE)
    face_rows["corners"] = 3
    face_rows["index"] = mesh.faces
    face_rows["bar_id"] = mesh.face_bar_id
    with atomic_replace(Path(path)) as temporary, temporary.open("wb") as file:
        file.writelines((header.encode("ascii"), vertex_rows.data, face_rows.data))


def read_mesh_ply(path: str | os.PathLike[str]) -> WorldMesh:
    """Return the mesh of a scene from its file.

    Raises ``DatasetError`` if the file cannot be read or differs from this layout in any way.
    """
    return parse_mesh_ply(read_file(Path(path), MESH_BYTES, "the mesh of a scene", DatasetError), str(path))


def has_mesh_ply_header(content: bytes) -> bool:
    """Return whether ``content`` starts with the header of this layout; comments are ignored."""
    return _match_header(content) is not None


def parse_mesh_ply(content: bytes, where: str) -> WorldMesh:
    """Return the mesh of ``read_mesh_ply`` from the content of a file; ``where`` names the file in errors.

    The size of the content is compared with the counts in the header before arrays are allocated. Raises
    ``DatasetError`` as ``read_mesh_ply`` does.
    """
    header = _match_header(content)
    if header is None:
        raise DatasetError(
            f"{where}: not a mesh of this dataset: found a file that starts with {content[:40]!r}, expected "
            "a binary little-endian PLY with double x y z, int vertex_indices and ushort bar_id"
        )
    vertex_count, face_count, start = header
    faces_start = start + vertex_count * _VERTEX.itemsize
    expected = faces_start + face_count * _FACE.itemsize
    if len(content) != expected:
        raise DatasetError(
            f"{where}: truncated or damaged: {len(content)} bytes found, {expected} expected for the "
            f"{vertex_count} vertices and {face_count} triangles of its header"
        )
    vertices = np.frombuffer(content, _VERTEX, vertex_count, start)["xyz"].astype(np.float64)
    rows = np.frombuffer(content, _FACE, face_count, faces_start)
    _check_rows(vertices, rows, where)
    return WorldMesh(vertices, rows["index"].astype(np.int32), rows["bar_id"].astype(np.uint16))


def _match_header(content: bytes) -> tuple[int, int, int] | None:
    """Return vertex count, face count and header length in bytes, or None if the header has another layout."""
    end_mark = b"\nend_header\n"
    end = content.find(end_mark, 0, _HEADER_LIMIT)
    if not content.startswith(b"ply\n") or end < 0:
        return None
    length = end + len(end_mark)
    # Comments do not affect the layout; they may occur anywhere and in any encoding.
    match = _HEADER_PATTERN.fullmatch(_COMMENTS.sub("", content[:length].decode("latin-1")))
    return (int(match[1]), int(match[2]), length) if match else None


def _check_rows(vertices: Float64[ndarray, "v 3"], rows: ndarray, where: str) -> None:
    """Raise ``DatasetError`` if the body is not a valid triangle mesh."""
    not_triangles = np.flatnonzero(rows["corners"] != 3)
    if len(not_triangles):
        row = not_triangles[0]
        raise DatasetError(f"{where}: face {row} has {rows['corners'][row]} corners, expected 3")
    index = rows["index"]
    outside = np.flatnonzero(((index < 0) | (index >= len(vertices))).any(axis=1))
    if len(outside):
        row = outside[0]
        raise DatasetError(
            f"{where}: face {row} refers to vertices {index[row].tolist()}, expected 0 to {len(vertices) - 1}"
        )
    not_finite = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(not_finite):
        row = not_finite[0]
        raise DatasetError(f"{where}: vertex {row} is {vertices[row].tolist()}, expected finite metres")
