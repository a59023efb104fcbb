"""Evaluated scene as one world-space triangle mesh, read back from Blender as it is rendered."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import bpy
import numpy as np
from jaxtyping import Int32
from numpy import ndarray

from dataset_builder.blender.scene import BAR_ID
from dataset_builder.scene.model import NOT_STEEL, Mesh, WorldMesh
from dataset_builder.scene.shapes.solids import merge_meshes, transformed


@dataclass(frozen=True, eq=False)
class _MeshInstance:
    """An object or an instance of it: sort key, mesh in the world frame and bar id."""

    order: tuple[str, tuple[int, ...]]
    mesh: Mesh
    bar_id: int


def evaluated_world_mesh() -> WorldMesh:
    """Return all surfaces of the open scene that are visible to cameras, with modifiers and instances applied.

    Vertices are Blender's float32 coordinates times its float32 ``matrix_world``, multiplied in float64.
    Objects are ordered by name.
    """
    placed_meshes = sorted(_mesh_instances(), key=lambda item: item.order)
    mesh = merge_meshes([item.mesh for item in placed_meshes])
    ids = [np.full(len(item.mesh.faces), item.bar_id, dtype=np.uint16) for item in placed_meshes]
    return WorldMesh(mesh.vertices_m, mesh.faces, np.concatenate(ids))


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
        world_from_local = np.array(instance.matrix_world, dtype=np.float64)
        yield _MeshInstance(
            order=(evaluated.name, tuple(instance.persistent_id) if instance.is_instance else ()),
            mesh=transformed(local_meshes[key], world_from_local[:3, :3], world_from_local[:3, 3]),
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
