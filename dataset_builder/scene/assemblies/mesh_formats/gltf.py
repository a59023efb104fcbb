"""Checks of glTF content, ``.glb`` and ``.gltf``, before trimesh loads it.

Every index and every range of bytes is compared with what it refers to, so that trimesh allocates no more than the
file holds. Content that trimesh would leave out or misread is refused. Images, materials and other files are never
opened; data outside the file is refused, since the digest of the file does not cover it.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from dataset_builder.scene.assemblies.mesh_formats.gltf_schema import (
    COMPONENT_TYPES,
    COMPONENTS,
    TRIANGLES,
    Buffer,
    Primitive,
    Tree,
)
from dataset_builder.scene.assemblies.mesh_formats.parsing import MalformedMeshError
from rebar_depth_bench.errors import escape_text
from rebar_depth_bench.limits import MESH_BYTES
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.validation import validate_table

_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"
_INDEX_TYPES = (5121, 5123, 5125)
_FLOAT = 5126
_STRIP, _FAN = 5, 6
_UNSUPPORTED = re.compile(
    rb'"sparse"\s*:|EXT_mesh_gpu_instancing|KHR_mesh_quantization|KHR_draco_mesh_compression|EXT_meshopt'
)
_APPEARANCE = re.compile(r"(KHR|EXT|MSFT|GOOGLE)_(materials|texture|lights)_\w+|KHR_(xmp|animation)\w*")
"""Extensions that do not affect the surfaces."""


def check_gltf(content: bytes, binary: bool) -> None:
    """Raise ``MalformedMeshError`` unless trimesh can load ``content`` completely; ``binary`` selects ``.glb``."""
    json_text, binary_chunk = _chunks(content) if binary else (content, None)
    if _UNSUPPORTED.search(json_text):
        raise MalformedMeshError(
            "unknown", "", "the file has sparse, instanced, quantised or compressed meshes", "plain meshes"
        )
    tree = _parse_tree(json_text)
    for extension in tree.extensionsRequired:
        if not _APPEARANCE.fullmatch(extension):
            found = f"the extension {escape_text(extension)} is required"
            raise MalformedMeshError("unknown", "extensionsRequired", found, "plain meshes")
    buffers = [_buffer_data(buffer, number, binary_chunk) for number, buffer in enumerate(tree.buffers)]
    _check_ranges(tree, buffers)
    _check_meshes(tree, buffers)
    _check_nodes(tree)


def _chunks(content: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON chunk of a GLB file, and its binary chunk if it has one."""
    if content[:4] != b"glTF" or content[4:8] != b"\2\0\0\0":
        raise MalformedMeshError("syntax", "", f"starts with {content[:8]!r}", "the header of glTF 2")
    length = int.from_bytes(content[8:12], "little")
    if length != len(content):
        found = f"truncated or damaged: {len(content)} bytes"
        raise MalformedMeshError("damaged", "", found, f"{length} as in the header")
    chunks: list[tuple[bytes, bytes]] = []
    start = 12
    while start < length:
        size = int.from_bytes(content[start : start + 4], "little")
        if start + 8 + size > length:
            raise MalformedMeshError("damaged", f"byte {start}", f"a chunk of {size} bytes", "one within the file")
        chunks.append((content[start + 4 : start + 8], content[start + 8 : start + 8 + size]))
        start += 8 + size
    kinds = [kind for kind, _ in chunks if kind in (_JSON_CHUNK, _BINARY_CHUNK)]
    if kinds not in ([_JSON_CHUNK], [_JSON_CHUNK, _BINARY_CHUNK]) or chunks[0][0] != _JSON_CHUNK:
        raise MalformedMeshError("damaged", "", f"the chunks are {kinds}", "JSON, then at most one BIN")
    by_kind = dict(chunks)
    return by_kind[_JSON_CHUNK], by_kind.get(_BINARY_CHUNK)


def _parse_tree(text: bytes) -> Tree:
    values, problems = parse_json(text)
    tree = None if problems else validate_table(Tree, values, problems)
    if tree is None:
        first = problems[0]
        raise MalformedMeshError(first.code, first.where, first.found, first.expected)
    return tree


def _buffer_data(buffer: Buffer, number: int, binary_chunk: bytes | None) -> bytes:
    """Return the data of a buffer, which may be followed by padding."""
    where = f"buffers {number}"
    if buffer.uri is None:
        data = binary_chunk if number == 0 and binary_chunk is not None else b""
    else:
        kind, _, encoded = buffer.uri.partition(";base64,")
        if not kind.startswith("data:"):
            expected = "a single self-contained file such as .glb"
            raise MalformedMeshError("unknown", where, f"the file refers to {escape_text(buffer.uri)}", expected)
        try:
            data = base64.b64decode(encoded, validate=True)
        except (binascii.Error, ValueError) as error:
            raise MalformedMeshError("damaged", where, f"not base64: {error}", "the data of the buffer") from None
    if len(data) < buffer.byteLength:
        found = f"truncated or damaged: {len(data)} bytes"
        raise MalformedMeshError("damaged", where, found, f"{buffer.byteLength} as in byteLength")
    return data


def _check_ranges(tree: Tree, buffers: Sequence[bytes]) -> None:
    """Check that views lie in their buffers and accessors in their views, and the total size of both."""
    for number, view in enumerate(tree.bufferViews):
        where = f"bufferViews {number}"
        _check_index(view.buffer, buffers, where)
        _check_end(view.byteOffset + view.byteLength, tree.buffers[view.buffer].byteLength, where)
    for number, accessor in enumerate(tree.accessors):
        where = f"accessors {number}"
        _check_index(accessor.bufferView, tree.bufferViews, where)
        view = tree.bufferViews[accessor.bufferView]
        stride = view.byteStride or accessor.item_bytes
        if accessor.count < 1 or stride < accessor.item_bytes:
            raise MalformedMeshError(
                "invalid", where, f"count {accessor.count}, stride {stride}", "separate values"
            )
        end = accessor.byteOffset + (accessor.count - 1) * stride + accessor.item_bytes
        _check_end(end, view.byteLength, where)
    _check_total(sum(view.byteLength for view in tree.bufferViews), "bufferViews")
    _check_total(sum(accessor.count * accessor.item_bytes for accessor in tree.accessors), "accessors")


def _check_meshes(tree: Tree, buffers: Sequence[bytes]) -> None:
    """Check the accessors and vertex indices of all triangles, and the size of all meshes in total."""
    highest: dict[int, int] = {}
    for number, mesh in enumerate(tree.meshes):
        where = f"meshes {number}"
        for primitive in mesh.primitives:
            for index in (*primitive.attributes.values(), primitive.indices or 0):
                _check_index(index, tree.accessors, where)
            if primitive.mode == _FAN:
                raise MalformedMeshError("unknown", where, "triangle fans", "triangles or strips")
            if primitive.mode in (TRIANGLES, _STRIP):
                _check_triangles(tree, primitive, where)
                if primitive.indices is not None:
                    if primitive.indices not in highest:
                        highest[primitive.indices] = _highest_index(tree, buffers, primitive.indices, where)
                    _check_index(highest[primitive.indices], range(_vertex_count(tree, primitive)), where)
    _check_total(sum(_mesh_bytes(tree, mesh) for mesh in range(len(tree.meshes))), "meshes")


def _check_triangles(tree: Tree, primitive: Primitive, where: str) -> None:
    position = tree.accessors[primitive.attributes["POSITION"]] if "POSITION" in primitive.attributes else None
    if position is None or (position.type, position.componentType) != ("VEC3", _FLOAT):
        raise MalformedMeshError("invalid", where, "no positions", "POSITION with three floats")
    counts = {tree.accessors[index].count for index in primitive.attributes.values()}
    if counts != {position.count}:
        raise MalformedMeshError("conflict", where, f"attributes of {sorted(counts)} vertices", "equal counts")


def _vertex_count(tree: Tree, primitive: Primitive) -> int:
    return tree.accessors[primitive.attributes["POSITION"]].count


def _highest_index(tree: Tree, buffers: Sequence[bytes], index: int, where: str) -> int:
    """Return the highest vertex index in an accessor, whose range of bytes was checked."""
    accessor = tree.accessors[index]
    if accessor.type != "SCALAR" or accessor.componentType not in _INDEX_TYPES:
        raise MalformedMeshError("invalid", where, "the indices are no whole numbers", "vertex indices")
    view = tree.bufferViews[accessor.bufferView]
    dtype = np.dtype(COMPONENT_TYPES[accessor.componentType])
    strides = (view.byteStride or dtype.itemsize,)
    offset = view.byteOffset + accessor.byteOffset
    return int(np.ndarray((accessor.count,), dtype, buffers[view.buffer], offset, strides).max())


def _check_nodes(tree: Tree) -> None:
    """Check that the nodes are trees, whose meshes exist and have a limited size in total."""
    for number, node in enumerate(tree.nodes):
        where = f"nodes {number}"
        for child in node.children:
            _check_index(child, tree.nodes, where)
        if node.mesh is not None:
            _check_index(node.mesh, tree.meshes, where)
        if node.camera is not None and (node.mesh is not None or node.children):
            raise MalformedMeshError("unknown", where, "a camera with a mesh or children", "a camera alone")
    if tree.scenes:
        _check_index(tree.scene, tree.scenes, "scene")
    roots = tree.scenes[tree.scene].nodes if tree.scenes else ()
    for root in roots:
        _check_index(root, tree.nodes, f"scenes {tree.scene}")
    parents = Counter([*roots, *(child for node in tree.nodes for child in node.children)])
    repeated = [number for number, count in parents.items() if count > 1]
    if repeated:
        raise MalformedMeshError("duplicate", f"nodes {repeated[0]}", "several parents", "one parent")
    _check_total(sum(_mesh_bytes(tree, node.mesh) for node in tree.nodes if node.mesh is not None), "nodes")


def _mesh_bytes(tree: Tree, mesh: int) -> int:
    """Return the number of bytes of the positions and indices of a mesh after loading."""
    parts = tree.meshes[mesh].primitives
    used = [
        index for part in parts for index in (part.indices, part.attributes.get("POSITION")) if index is not None
    ]
    return sum(8 * tree.accessors[index].count * COMPONENTS[tree.accessors[index].type] for index in used)


def _check_index(index: int, items: Sequence[Any], where: str) -> None:
    if index >= len(items):
        raise MalformedMeshError("invalid", where, f"refers to item {index}", f"one of {len(items)}")


def _check_end(end: int, size: int, where: str) -> None:
    if end > size:
        raise MalformedMeshError("damaged", where, f"ends at byte {end}", f"at most {size}")


def _check_total(size: int, where: str) -> None:
    if size > MESH_BYTES.value():
        raise MalformedMeshError("size", where, f"{size} bytes in total", MESH_BYTES.allowed())
