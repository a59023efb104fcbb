"""Mesh files as bars: one reader per suffix, from a file's bytes to one mesh per bar id, in file units, z up.

What counts as a bar, and which id it gets:

- PLY with a face property ``bar_id``: the faces of one id, which it keeps; id 0 (board, table) is left out.
- OBJ with several objects (``o``; without any, groups ``g``): one object; ids 1, 2, ... in file order.
- glTF with several mesh nodes: one node, its transform applied; ids 1, 2, ... in the order of its node list.
- Anything else: one connected component, after vertices of exactly equal position are made one; ids
  1, 2, ... in the order of the components' first faces. Bars that share a vertex are one component.

STL, PLY and OBJ coordinates are taken as they stand and should be z up; glTF is y up by its specification
and is turned: (x, y, z) becomes (x, -z, y). A closed part that is wound inside out is turned outward, except
where ``bar_id`` tells that the file is a finished scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Integer
from numpy import ndarray

from dataset_builder.mesh_gltf import read_glb, read_gltf
from dataset_builder.mesh_obj import read_obj
from dataset_builder.mesh_ply import read_ply
from dataset_builder.mesh_stl import read_stl
from dataset_builder.mesh_tools import (
    component_labels,
    split_by_label,
    turned_outward,
    weld,
)
from dataset_builder.model import NOT_STEEL, Mesh
from rebar_depth_bench.errors import DatasetError, MeshError
from rebar_depth_bench.ply import has_mesh_ply_header, parse_mesh_ply

MAX_BARS = int(np.iinfo(np.uint16).max)
"""Bar ids are 16-bit, and 0 is taken."""

Reader = Callable[[bytes, str], dict[int, Mesh]]
"""From a file's bytes and its name in errors to one mesh per bar id; raises ``MeshError``."""


def read_ply_bars(content: bytes, where: str) -> dict[int, Mesh]:
    """Read a PLY of any kind; the dataset's own layout survives bit by bit."""
    if has_mesh_ply_header(content):
        try:
            vertices, faces, bar_id = parse_mesh_ply(content, where)
        except DatasetError as error:
            raise MeshError(str(error)) from error
        return _bars_by_id(Mesh(vertices, faces), bar_id, where)
    found = read_ply(content, where)
    if found is None:
        return {}
    mesh, face_bar_id = found
    if face_bar_id is None:
        return _bars_by_object([mesh], where)
    wrong = np.flatnonzero((face_bar_id < 0) | (face_bar_id > MAX_BARS))
    if len(wrong):
        raise MeshError(
            f"{where}: triangle {wrong[0]} has bar_id {face_bar_id[wrong[0]]}, expected 0 to {MAX_BARS}"
        )
    return _bars_by_id(mesh, face_bar_id, where)


def read_stl_bars(content: bytes, where: str) -> dict[int, Mesh]:
    """Read a binary or text STL; the solids of a text STL are taken together."""
    return _bars_by_object([read_stl(content, where)], where)


def read_obj_bars(content: bytes, where: str) -> dict[int, Mesh]:
    """Read a Wavefront OBJ."""
    return _bars_by_object(read_obj(content, where), where)


def read_gltf_bars(content: bytes, where: str) -> dict[int, Mesh]:
    """Read a glTF 2.0 of one file."""
    return _bars_by_object(read_gltf(content, where), where)


def read_glb_bars(content: bytes, where: str) -> dict[int, Mesh]:
    """Read a binary glTF 2.0."""
    return _bars_by_object(read_glb(content, where), where)


READERS: dict[str, Reader] = {
    ".glb": read_glb_bars,
    ".gltf": read_gltf_bars,
    ".obj": read_obj_bars,
    ".ply": read_ply_bars,
    ".stl": read_stl_bars,
}
"""The reader of each suffix, in lower case."""


def _bars_by_id(mesh: Mesh, face_bar_id: Integer[ndarray, " n"], where: str) -> dict[int, Mesh]:
    """Return the parts of each id but 0, as they stand."""
    parts = split_by_label(mesh, face_bar_id)
    board = parts.pop(NOT_STEEL, None)
    if board is not None and not parts:
        raise MeshError(f"{where}: every face has bar_id 0 (not steel), expected at least one bar")
    return parts


def _bars_by_object(objects: Sequence[Mesh], where: str) -> dict[int, Mesh]:
    """Number several objects as they come; number the components of a single one."""
    objects = [mesh for mesh in objects if len(mesh.faces)]
    if len(objects) == 1:
        mesh = weld(objects[0])
        label = component_labels(mesh)
        _refuse_too_many(int(label.max(initial=-1)) + 1, "connected components", where)
        objects = list(split_by_label(mesh, label).values())
    _refuse_too_many(len(objects), "objects", where)
    return {bar_id: turned_outward(mesh) for bar_id, mesh in enumerate(objects, start=1)}


def _refuse_too_many(count: int, what: str, where: str) -> None:
    if count > MAX_BARS:
        raise MeshError(f"{where}: {count} {what} found, expected at most {MAX_BARS} bars")
