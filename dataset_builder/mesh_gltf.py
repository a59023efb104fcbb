"""glTF 2.0 of one file (``.glb``, or ``.gltf`` with embedded buffers): triangles of each mesh node.

An own reader, because trimesh's walks nodes in another order than the file's and reads compressed geometry
as zeros where the decoder is not installed.
"""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from dataset_builder.mesh_tools import checked_mesh, joined
from dataset_builder.model import Mesh
from rebar_depth_bench.errors import MeshError

_GLB_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_TRIANGLES, _FIRST_SURFACE_MODE = 4, 4
_INDEX_TYPES: dict[int, np.dtype[Any]] = {5121: np.dtype("<u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4")}
_POSITION_TYPES: dict[int, np.dtype[Any]] = {5126: np.dtype("<f4")}
# Required extensions that leave positions alone; any other may hide or move geometry.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_")
_INSTANCING = "EXT_mesh_gpu_instancing"
# Columns of the turn from y up to z up: (x, y, z) becomes (x, -z, y).
_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

Tree = dict[str, Any]
Matrix = Float64[ndarray, "4 4"]


def read_glb(content: bytes, where: str) -> list[Mesh]:
    """Return the meshes of a binary glTF, as ``read_gltf`` does. Raises ``MeshError``."""
    try:
        magic, version, length = struct.unpack_from("<3I", content)
        if magic != _GLB_MAGIC or version != 2 or length != len(content):
            raise ValueError(
                f"header {content[:4]!r}, version {version}, {length} bytes claimed and {len(content)} there"
            )
        chunks = _chunks(content)
        if not chunks or chunks[0][0] != _JSON_CHUNK:
            raise ValueError("its first chunk is not JSON")
    except (struct.error, ValueError) as error:
        raise MeshError(f"{where}: not a whole binary glTF 2.0: {error}") from error
    binary = next((data for kind, data in chunks[1:] if kind == _BINARY_CHUNK), None)
    return read_gltf(chunks[0][1], where, binary)


def read_gltf(content: bytes, where: str, binary: bytes | None = None) -> list[Mesh]:
    """Return one mesh per node with triangles, in the order of the file's node list, z up, in file units.

    Nodes are those of the default scene, their transforms applied; skins and morphs are left at rest.
    ``binary`` is a GLB's own buffer. Raises ``MeshError`` where the file is malformed, is not whole in
    itself (an external buffer escapes the checksum), or has compressed or instanced geometry.
    """
    try:
        tree = json.loads(content)
        _refuse_unreadable(tree)
        buffers = [_buffer(entry, binary) for entry in tree.get("buffers", [])]
        transforms = sorted(_world_transforms(tree).items())
        meshes = [_node_mesh(tree, buffers, node, matrix, where) for node, matrix in transforms]
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        reason = f"{type(error).__name__} {error}" if isinstance(error, KeyError) else str(error)
        raise MeshError(f"{where}: not a glTF 2.0 that can be read: {reason}") from error
    return [mesh for mesh in meshes if mesh is not None]


def _chunks(content: bytes) -> list[tuple[int, bytes]]:
    """Return a GLB's chunks as (type, data)."""
    found = []
    position = 12
    while position < len(content):
        length, kind = struct.unpack_from("<2I", content, position)
        data = content[position + 8 : position + 8 + length]
        if len(data) != length:
            raise ValueError(f"a chunk of {length} bytes ends after {len(data)}")
        found.append((kind, data))
        position += 8 + length
    return found


def _refuse_unreadable(tree: Tree) -> None:
    """Raise ``ValueError`` for another version, or an extension without which geometry would be wrong."""
    version = str(tree["asset"]["version"])
    if not version.startswith("2."):
        raise ValueError(f"version {version}, expected 2")
    wanted = [name for name in tree.get("extensionsRequired", []) if not name.startswith(_HARMLESS)]
    wanted += [_INSTANCING] if _INSTANCING in tree.get("extensionsUsed", []) else []
    if wanted:
        raise ValueError(f"it needs {', '.join(wanted)}; export it without compression or instancing")


def _buffer(entry: Tree, binary: bytes | None) -> bytes:
    """Return a buffer's bytes: the GLB's own, or those of a ``data:`` URI."""
    uri = entry.get("uri")
    if uri is None:
        if binary is None:
            raise ValueError("a buffer without data, expected a binary chunk")
        return binary
    head, _, payload = uri.partition(",")
    if not head.startswith("data:") or not head.endswith(";base64"):
        raise ValueError(
            f"its geometry is in another file, {uri[:60]!r}, which the checksum would not cover; "
            "save it as .glb"
        )
    return base64.b64decode(payload, validate=True)


def _world_transforms(tree: Tree) -> dict[int, Matrix]:
    """Return the world transform, y up, of every node of the default scene, by node index."""
    nodes = tree.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [index for index in range(len(nodes)) if index not in children]
    if "scenes" in tree:
        roots = _entry(tree, "scenes", tree.get("scene", 0)).get("nodes", [])
    found: dict[int, Matrix] = {}
    waiting = [(index, np.eye(4)) for index in roots]
    while waiting:
        index, parent = waiting.pop()
        node = _entry(tree, "nodes", index)
        if index in found:
            raise ValueError(f"node {index} is reached twice, expected a tree of nodes")
        found[index] = parent @ _local_transform(node)
        if not np.isfinite(found[index]).all():
            raise ValueError(f"node {index} has a transform that is not finite")
        waiting.extend((child, found[index]) for child in node.get("children", []))
    return found


def _local_transform(node: Tree) -> Matrix:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    rotation = Rotation.from_quat(np.array(node.get("rotation", [0, 0, 0, 1]), np.float64))
    matrix[:3, :3] = rotation.as_matrix() * np.array(node.get("scale", [1, 1, 1]), np.float64)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _node_mesh(tree: Tree, buffers: list[bytes], index: int, matrix: Matrix, where: str) -> Mesh | None:
    """Return a node's triangles in the world, z up; None for a node without any."""
    node = tree["nodes"][index]
    if "mesh" not in node:
        return None
    primitives = _entry(tree, "meshes", node["mesh"])["primitives"]
    surfaces = [p for p in primitives if p.get("mode", _TRIANGLES) >= _FIRST_SURFACE_MODE]
    if not surfaces:
        return None
    place = f"{where}, node {index} ({str(node.get('name', 'no name'))[:40]!r})"
    mesh = joined([_primitive(tree, buffers, primitive, place) for primitive in surfaces])
    linear = _Z_UP @ matrix[:3, :3]
    vertices = mesh.vertices_m @ linear.T + _Z_UP @ matrix[:3, 3]
    # By the specification a mirroring transform turns the winding round.
    faces = mesh.faces[:, ::-1] if np.linalg.det(linear) < 0 else mesh.faces
    return Mesh(vertices, np.ascontiguousarray(faces))


def _primitive(tree: Tree, buffers: list[bytes], primitive: Tree, place: str) -> Mesh:
    if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
        raise ValueError(f"{place} is made of strips or fans (mode {primitive['mode']}), expected triangles")
    positions = _accessor(tree, buffers, primitive["attributes"]["POSITION"], "VEC3", _POSITION_TYPES)
    if "indices" in primitive:
        corners = _accessor(tree, buffers, primitive["indices"], "SCALAR", _INDEX_TYPES)
    else:
        corners = np.arange(len(positions))
    if corners.size % 3:
        raise ValueError(f"{place} has {corners.size} corners, expected a multiple of 3")
    return checked_mesh(positions, corners, place)


def _accessor(
    tree: Tree, buffers: list[bytes], index: int, kind: str, types: dict[int, np.dtype[Any]]
) -> ndarray:
    """Return a view (count x columns) of a buffer; bounds are checked before anything is touched."""
    accessor = _entry(tree, "accessors", index)
    if accessor["type"] != kind or accessor["componentType"] not in types or "sparse" in accessor:
        raise ValueError(
            f"accessor {index} holds {accessor['type']} of component type {accessor['componentType']}"
            f"{', sparse' if 'sparse' in accessor else ''}; expected plain {kind} of type {sorted(types)}"
        )
    view = _entry(tree, "bufferViews", accessor["bufferView"])
    dtype, columns = types[accessor["componentType"]], 3 if kind == "VEC3" else 1
    stride = view.get("byteStride", dtype.itemsize * columns)
    begin, length = view.get("byteOffset", 0), view["byteLength"]
    data = buffers[view["buffer"]][begin : begin + length]
    count, offset = accessor["count"], accessor.get("byteOffset", 0)
    end = offset + (count - 1) * stride + dtype.itemsize * columns
    if min(begin, offset, count - 1) < 0 or stride < dtype.itemsize * columns or end > len(data):
        raise ValueError(f"accessor {index} reads {count} items up to byte {end} of {len(data)}")
    return np.ndarray((count, columns), dtype, data, offset, (stride, dtype.itemsize))


def _entry(tree: Tree, key: str, index: int) -> Any:
    """Return ``tree[key][index]``; an index from the end is a defect here, not Python's courtesy."""
    entries = tree.get(key, [])
    if not 0 <= index < len(entries):
        raise ValueError(f"{key} {index} is named, but there are {len(entries)}")
    return entries[index]
