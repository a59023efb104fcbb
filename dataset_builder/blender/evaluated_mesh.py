"""Reads back what Blender renders: the evaluated scene as one world-space triangle mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.blender.scene import BAR_ID
from dataset_builder.scene.model import NOT_STEEL, Mesh, WorldMesh


@dataclass(frozen=True, eq=False)
class _Placed:
    """One object or instance of it: what to sort by, its mesh in its own frame, where it is, which bar."""

    order: tuple[str, tuple[int, ...]]
    local: Mesh
    world_from_local: Float64[ndarray, "4 4"]
    bar_id: int


def evaluated_world_mesh() -> WorldMesh:
    """Return every surface that a camera of the open scene can see, modifiers and instances applied.

    Vertices are Blender's float32 coordinates times its float32 ``matrix_world``, multiplied in float64.
    Objects come in the order of their names.
    """
    placed = sorted(_placed_meshes(), key=lambda item: item.order)
    vertices = [_in_world_m(item) for item in placed]
    starts = np.cumsum([0, *(len(v) for v in vertices)])
    faces = [item.local.faces + start for item, start in zip(placed, starts, strict=False)]
    ids = [np.full(len(item.local.faces), item.bar_id, dtype=np.uint16) for item in placed]
    return WorldMesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.concatenate(ids))


def _placed_meshes() -> Iterator[_Placed]:
    depsgraph = bpy.context.evaluated_depsgraph_get()
    read: dict[int, Mesh] = {}
    for instance in depsgraph.object_instances:
        evaluated = instance.object
        if evaluated.type != "MESH" or not instance.show_self or _hidden(evaluated.original):
            continue
        # Objects that share mesh data are read once.
        key = evaluated.data.as_pointer()
        if key not in read:
            read[key] = _local_mesh(evaluated.data)
        yield _Placed(
            order=(evaluated.name, tuple(instance.persistent_id) if instance.is_instance else ()),
            local=read[key],
            world_from_local=np.array(instance.matrix_world, dtype=np.float64),
            bar_id=int(evaluated.get(BAR_ID, NOT_STEEL)),
        )


def _hidden(original: bpy.types.Object) -> bool:
    return bool(original.hide_render or not original.visible_camera)


def _local_mesh(data: bpy.types.Mesh) -> Mesh:
    """Return the triangles of Blender mesh data in its own frame."""
    co = np.empty(len(data.vertices) * 3, dtype=np.float32)
    data.vertices.foreach_get("co", co)
    data.calc_loop_triangles()
    corners: Int32[ndarray, " n"] = np.empty(len(data.loop_triangles) * 3, dtype=np.int32)
    data.loop_triangles.foreach_get("vertices", corners)
    return Mesh(co.reshape(-1, 3).astype(np.float64), corners.reshape(-1, 3))


def _in_world_m(item: _Placed) -> Float64[ndarray, "n 3"]:
    matrix = item.world_from_local
    return np.asarray(item.local.vertices_m @ matrix[:3, :3].T + matrix[:3, 3])
