"""Mesh files as parts: from a file's content to one mesh per bar id, in world metres, z up.

- The dataset's own PLY (``dataset_builder.scene.mesh_ply``) is taken as it stands: the faces of one ``bar_id``
  are a part, which keeps that id; id 0 (board, table) is left out.
- Every other file is read by trimesh. Where it holds several glTF nodes or OBJ objects (``o``), each is a
  part. Parts are numbered from 1 by name, numbers within names by value ("bar2" before "bar10"); a nameless
  node is called by its index, and trimesh appends "_1", "_2", ... to a repeated node name.
- A file of one object (any STL or PLY) is split into connected components after vertices closer than 10 nm
  are made one: numbered from 1 in the order of their first faces. Bars that share a vertex are one part.

STL, PLY and OBJ coordinates are taken as they stand and should be z up; glTF is y up by its specification
and is turned: (x, y, z) becomes (x, -z, y). Outside the own PLY, a closed part that is wound inside out is
turned outward.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import shorten

import numpy as np
import trimesh
from jaxtyping import Integer
from numpy import ndarray
from numpy.typing import ArrayLike

from dataset_builder.config.specs import MeshFileSpec
from dataset_builder.scene.mesh_ply import has_mesh_ply_header, parse_mesh_ply
from dataset_builder.scene.model import MAX_BARS, NOT_STEEL, Mesh
from rebar_depth_bench.errors import DatasetError, MeshError

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
"""The suffixes of the mesh files that are read, in lower case."""
MIN_EXTENT_M = 0.001
MAX_EXTENT_M = 100.0
"""An assembly's largest side lies strictly between these, or its unit is wrong."""

_PLAIN_GLTF = (
    rb'"sparse"\s*:|EXT_mesh_gpu_instancing|KHR_mesh_quantization|KHR_draco_mesh_compression|EXT_meshopt',
    "it has sparse, instanced, quantised or compressed meshes, expected plain ones",
)
# What trimesh would read wrong without a word: what is searched for, and the words of the refusal.
_UNREAD = {
    ".glb": _PLAIN_GLTF,
    ".gltf": _PLAIN_GLTF,
    ".obj": (rb"(?m)^f[ \t][^\n#]*-", "it has relative (negative) vertex indices, expected absolute ones"),
    ".ply": (
        rb"(?m)\Aply\r?\n(?:(?!end_header)[^\n]*\n)*property \w+ bar_id\s*$",
        "it has bar_id, but not this dataset's own PLY layout: without that property, connected components "
        "are numbered",
    ),
}

# With a handler of its own, what the loader logs (tracebacks among it) does not go to stderr.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_parts(content: bytes, spec: MeshFileSpec) -> dict[int, Mesh]:
    """Return one mesh in metres per bar id, ascending, of a file's ``content``; ``spec.path`` tells its kind.

    Raises ``MeshError`` where the content cannot be read, holds no triangle, only id 0, more than
    ``MAX_BARS`` parts or a coordinate that is not finite, or where its extent is absurd for the unit.
    """
    with _errors_in_words(spec.path):
        if Path(spec.path).suffix.lower() == ".ply" and has_mesh_ply_header(content):
            return _own_parts(content, spec)
        objects = _objects(content, spec)
        _check_extent(objects, spec)
        parts = objects if len(objects) > 1 else _components(objects[0])
        if len(parts) > MAX_BARS:
            raise MeshError(f"{spec.path}: {len(parts)} separate parts found, expected at most {MAX_BARS} bars")
        return {bar_id: _outward(part) for bar_id, part in enumerate(parts, start=1)}


def _own_parts(content: bytes, spec: MeshFileSpec) -> dict[int, Mesh]:
    """Return the parts of the dataset's own PLY; where the unit is the metre, to the bit."""
    vertices, faces, bar_id = parse_mesh_ply(content, spec.path)
    whole = Mesh(vertices * spec.unit_m, faces)
    parts = {int(bar_id[group[0]]): _cut(whole, group) for group in _groups(bar_id)}
    if parts.pop(NOT_STEEL, None) is not None and not parts:
        raise MeshError(f"{spec.path}: every face has bar_id 0 (not steel), expected at least one bar")
    _check_extent(parts.values(), spec)
    return parts


def _objects(content: bytes, spec: MeshFileSpec) -> list[Mesh]:
    """Return the objects of any other file in metres, by name; those without triangles are left out."""
    suffix = Path(spec.path).suffix.lower()
    if suffix == ".stl":
        return [_mesh(*_triangles_of_stl(content), spec)]
    pattern, words = _UNREAD[suffix]
    if re.search(pattern, content):
        raise MeshError(f"{spec.path}: {words}")
    scene = trimesh.load_scene(
        io.BytesIO(content),
        file_type=suffix[1:],
        resolver=_NoNeighbours(),
        process=False,
        skip_materials=True,
        group_material=False,
        split_objects=True,
    )
    bodies = defaultdict(list)
    for body in scene.dump():
        if isinstance(body, trimesh.Trimesh) and len(body.faces):
            bodies[_object_name(scene, body)].append((body.vertices, body.faces))
    # Primitives of one object become one mesh.
    joined = [trimesh.util.append_faces(*zip(*bodies[name], strict=True)) for name in sorted(bodies, key=_natural)]
    return [_mesh(vertices, faces, spec) for vertices, faces in joined]


def _triangles_of_stl(content: bytes) -> tuple[ndarray, ndarray]:
    """Return the corners of all solids, in order, and faces that name them in threes."""
    # Not through load_scene, which mends several solids: corners that are not finite would vanish.
    found = trimesh.exchange.stl.load_stl(io.BytesIO(content))
    solids = found["geometry"].values() if "geometry" in found else [found]
    corners = np.concatenate([np.empty((0, 3)), *(solid["vertices"] for solid in solids)])
    return corners, np.arange(len(corners)).reshape(-1, 3)


def _object_name(scene: trimesh.Scene, body: trimesh.Trimesh) -> str:
    """Return the name of the node that ``body`` belongs to."""
    node = str(body.metadata["node"])
    parent = str(scene.graph.transforms.parents.get(node))
    # trimesh hangs the primitives of a glTF node below it, as "<node>_<six random letters>".
    is_primitive = body.metadata.get("from_gltf_primitive") and node[:-7] == parent
    return parent if is_primitive else node


def _natural(name: str) -> tuple[list[str | int], str]:
    """Return a key that sorts numbers within names by value."""
    return [int(text) if at % 2 else text for at, text in enumerate(re.split(r"(\d+)", name))], name


def _mesh(vertices: ArrayLike, faces: ArrayLike, spec: MeshFileSpec) -> Mesh:
    """Return what a file holds in metres, z up; raise ``MeshError`` where it is no mesh."""
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    corners = np.asarray(faces, np.int64).reshape(-1, 3)
    wild = points[~np.isfinite(points).all(axis=1)]
    if len(wild):
        raise MeshError(f"{spec.path}: a vertex is {wild[0].tolist()}, expected finite coordinates")
    if corners.size and not (corners.min() >= 0 and corners.max() < len(points)):
        raise MeshError(
            f"{spec.path}: triangles name vertices {corners.min()} to {corners.max()}, expected 0 to "
            f"{len(points) - 1}"
        )
    if Path(spec.path).suffix.lower() in {".glb", ".gltf"}:
        points = points[:, [0, 2, 1]] * [1, -1, 1]
    return Mesh(points * spec.unit_m, corners.astype(np.int32))


def _components(mesh: Mesh) -> list[Mesh]:
    """Return the connected components by their first faces; faces keep their order."""
    body = trimesh.Trimesh(mesh.vertices_m, mesh.faces)
    vertex_label = trimesh.graph.connected_component_labels(body.edges, len(body.vertices))
    groups = _groups(vertex_label[body.faces[:, 0]])
    whole = Mesh(np.array(body.vertices), np.array(body.faces, np.int32))
    return [_cut(whole, group) for group in sorted(groups, key=lambda group: int(group[0]))]


def _groups(label: Integer[ndarray, " n"]) -> list[Integer[ndarray, " k"]]:
    """Return the ascending indices of each value, by ascending values."""
    return [np.sort(group) for group in trimesh.grouping.group(label) if len(group)]


def _cut(mesh: Mesh, faces_kept: Integer[ndarray, " k"]) -> Mesh:
    """Return some faces as a mesh of their own; vertices and faces keep their order."""
    faces = mesh.faces[faces_kept]
    used, index = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices_m[used], index.reshape(faces.shape).astype(np.int32))


def _outward(mesh: Mesh) -> Mesh:
    """Return the mesh with close vertices made one, reversed where it is closed and wound inside out."""
    body = trimesh.Trimesh(mesh.vertices_m, mesh.faces)
    if body.is_watertight and body.is_winding_consistent and body.volume < 0:
        body.invert()
    return Mesh(np.array(body.vertices), np.array(body.faces, np.int32))


def _check_extent(meshes: Iterable[Mesh], spec: MeshFileSpec) -> None:
    """Raise ``MeshError`` where nothing is there, or of a size that no assembly of reinforcement has."""
    corners = np.concatenate([np.empty((0, 3)), *(mesh.vertices_m[mesh.faces.ravel()] for mesh in meshes)])
    if not len(corners):
        raise MeshError(f"{spec.path}: no triangle found, expected the surface of at least one bar")
    extent = float(np.ptp(corners, axis=0).max())
    if not MIN_EXTENT_M < extent < MAX_EXTENT_M:
        raise MeshError(
            f"{spec.path}: the assembly is {extent:.6g} m long, expected {MIN_EXTENT_M:g} to "
            f"{MAX_EXTENT_M:g} m: is the unit right? One file unit was taken as {spec.unit_m:g} m"
        )


class _NoNeighbours(dict[str, bytes]):
    """The files beside a mesh file, none of which is read: ``sha256`` does not cover them."""

    def __missing__(self, name: str) -> bytes:
        raise FileNotFoundError(f"{name!r} would be looked for beside it: save all in one .glb")


@contextmanager
def _errors_in_words(where: str) -> Iterator[None]:
    """Raise whatever a damaged or hostile file makes of the loader as one sentence."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            # What NumPy says of text that it reads only to the first garbled number.
            warnings.filterwarnings("error", "string or file could not be read to its end")
            yield
    except MeshError:
        raise
    except DatasetError as error:
        raise MeshError(str(error)) from error
    except Exception as error:
        reason = shorten(f"{type(error).__name__}: {error}", 200)
        raise MeshError(f"{where}: not a mesh file of its kind that can be read ({reason})") from error
