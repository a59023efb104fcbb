"""Evaluated scene as one world-space triangle mesh, read back from Blender as it is rendered."""

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
class _MeshInstance:
    """An object or an instance of it: sort key, mesh in its own frame, pose and bar id."""

    order: tuple[str, tuple[int, ...]]
    local: Mesh
    world_from_local: Float64[ndarray, "4 4"]
    bar_id: int


def evaluated_world_mesh() -> WorldMesh:
    """Return all surfaces of the open scene that are visible to cameras, with modifiers and instances applied.

    Vertices are Blender's float32 coordinates times its float32 ``matrix_world``, multiplied in float64.
    Objects are ordered by name.
    """
    placed_meshes = sorted(_mesh_instances(), key=lambda item: item.order)
    vertices = [_world_vertices_m(item) for item in placed_meshes]
    starts = np.cumsum([0, *(len(v) for v in vertices)])
    faces = [item.local.faces + start for item, start in zip(placed_meshes, starts, strict=False)]
    ids = [np.full(len(item.local.faces), item.bar_id, dtype=np.uint16) for item in placed_meshes]
    return WorldMesh(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.concatenate(ids))


def _mesh_instances() -> Iterator[_MeshInstance]:
    """Yield the visible mesh objects and instances in the order of the dependency graph."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    local_meshes: dict[int, Mesh] = {}
    for instance in depsgraph.object_instances:
        evaluated = instance.object
        if evaluated.type != "MESH" or not instance.show_self or _hidden(evaluated.original):
            continue
        # Mesh data that several objects share is read once.
        key = evaluated.data.as_pointer()
        if key not in local_meshes:
            local_meshes[key] = _local_mesh(evaluated.data)
        yield _MeshInstance(
            order=(evaluated.name, tuple(instance.persistent_id) if instance.is_instance else ()),
            local=local_meshes[key],
            world_from_local=np.array(instance.matrix_world, dtype=np.float64),
            bar_id=int(evaluated.get(BAR_ID, NOT_STEEL)),
        )


def _hidden(original: bpy.types.Object) -> bool:
    """Return whether an object is not rendered or not visible to cameras."""
    return bool(original.hide_render or not original.visible_camera)


def _local_mesh(data: bpy.types.Mesh) -> Mesh:
    """Return the triangles of Blender mesh data in its own frame."""
    co = np.empty(len(data.vertices) * 3, dtype=np.float32)
    data.vertices.foreach_get("co", co)
    data.calc_loop_triangles()
    corners: Int32[ndarray, " n"] = np.empty(len(data.loop_triangles) * 3, dtype=np.int32)
    data.loop_triangles.foreach_get("vertices", corners)
    return Mesh(co.reshape(-1, 3).astype(np.float64), corners.reshape(-1, 3))


def _world_vertices_m(item: _MeshInstance) -> Float64[ndarray, "n 3"]:
    """Return an instance's vertices in the world frame, metres."""
    matrix = item.world_from_local
    return np.asarray(item.local.vertices_m @ matrix[:3, :3].T + matrix[:3, 3])
