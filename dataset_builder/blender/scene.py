"""Builds the scene in Blender's open file: steel, board, room. World frame, metres.

What a scene stands in: the surfaces round the steel, and the light on them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import bpy
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.blender.laboratory import BENCH_TOP_M, SHEET_THICKNESS_M, laboratory
from dataset_builder.blender.lights import LABORATORY_LIGHT, OUTDOOR_LIGHT, LightRig, add_light
from dataset_builder.blender.materials import STEEL_LOOKS, material, paper, surface_variation
from dataset_builder.blender.outdoors import outdoors
from dataset_builder.config.specs import SceneSpec
from dataset_builder.scene.board_texture import board_texture
from dataset_builder.scene.model import NOT_STEEL, Assembly, Mesh, Part
from dataset_builder.scene.shapes.solids import box
from dataset_builder.scene.variants import LIGHT, STEEL, check_variants, one_of_slot
from dataset_builder.scene.variants.props import occluders
from rebar_depth_bench.geometry.aruco_board import BoardSpec


@dataclass(frozen=True)
class Environment:
    """A place: its surfaces (world frame, none of them steel), and its light by light variant (None: as it is)."""

    parts: Callable[[], tuple[Part, ...]]
    light: Mapping[str | None, LightRig]
    floor_m: float
    """Height of the surface that a board lies on."""


ENVIRONMENTS: Mapping[str, Environment] = {
    "laboratory": Environment(laboratory, LABORATORY_LIGHT, BENCH_TOP_M),
    "outdoors": Environment(outdoors, OUTDOOR_LIGHT, 0.0),
}


BAR_ID = "bar_id"
"""The custom property that carries an object's bar id."""

BOARD_PX_PER_M = 6000.0
SHARP_EDGE_DEG = 50.0
SAME_SHAPE_M = 1e-9


def build_scene(assembly: Assembly, spec: SceneSpec) -> None:
    """Replace Blender's open file with the scene: one object per bar, what it stands on and in, its appearance.

    Raises ``InputError`` where the appearance's variants do not pass ``check_variants``.
    """
    variants = spec.appearance.variants
    check_variants(variants)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    for part, mesh, origin_m in _with_shared_meshes(_looking(assembly.parts, one_of_slot(variants, STEEL))):
        steel = add_object(part, mesh, origin_m)
        for name, value in surface_variation(spec.seed, part.bar_id).items():
            steel[name] = value
    environment = ENVIRONMENTS[spec.environment]
    # A floor that steel may stand on would lie in one plane with the sheet: under a board it sinks.
    sunk_m = 0.0 if spec.board is None else min(0.0, BENCH_TOP_M - environment.floor_m)
    for part in environment.parts():
        add_object(part, mesh_data(part.name, part.mesh, part.material), np.array([0.0, 0.0, sunk_m]))
    for part in occluders(assembly, spec):
        add_object(part, mesh_data(part.name, part.mesh, part.material), np.zeros(3))
    if spec.board is not None:
        _add_board(spec.board)
    add_light(environment.light[one_of_slot(variants, LIGHT)])
    bpy.context.view_layer.update()


def _looking(parts: tuple[Part, ...], look: str | None) -> tuple[Part, ...]:
    """Return the steel's parts in the material of a steel variant, or as they are."""
    return parts if look is None else tuple(replace(part, material=STEEL_LOOKS[look]) for part in parts)


def _with_shared_meshes(
    parts: tuple[Part, ...],
) -> Iterator[tuple[Part, bpy.types.Mesh, Float64[ndarray, " 3"]]]:
    """Yield each part with its mesh data and origin; parts that differ by a shift alone share their data."""
    shapes: list[tuple[Mesh, str, bpy.types.Mesh]] = []
    for part in parts:
        origin_m = part.mesh.vertices_m.min(axis=0)
        local = Mesh(part.mesh.vertices_m - origin_m, part.mesh.faces)
        data = next((data for mesh, name, data in shapes if name == part.material and _same(mesh, local)), None)
        if data is None:
            data = mesh_data(part.name, local, part.material)
            shapes.append((local, part.material, data))
        yield part, data, origin_m


def _same(a: Mesh, b: Mesh) -> bool:
    return (
        a.vertices_m.shape == b.vertices_m.shape
        and np.array_equal(a.faces, b.faces)
        and bool(np.abs(a.vertices_m - b.vertices_m).max() < SAME_SHAPE_M)
    )


def add_object(part: Part, data: bpy.types.Mesh, origin_m: Float64[ndarray, " 3"]) -> bpy.types.Object:
    """Put ``data`` into the open scene at ``origin_m`` (world, metres), marked with the part's bar id."""
    added = bpy.data.objects.new(part.name, data)
    added.location = origin_m
    added[BAR_ID] = part.bar_id
    bpy.context.scene.collection.objects.link(added)
    return added


def mesh_data(name: str, mesh: Mesh, material_name: str) -> bpy.types.Mesh:
    """Return Blender mesh data of the very triangles of ``mesh``, round edges smooth, sharp ones sharp."""
    data = bpy.data.meshes.new(name)
    data.vertices.add(len(mesh.vertices_m))
    data.vertices.foreach_set("co", mesh.vertices_m.astype(np.float32).ravel())
    data.loops.add(mesh.faces.size)
    data.loops.foreach_set("vertex_index", mesh.faces.ravel())
    data.polygons.add(len(mesh.faces))
    data.polygons.foreach_set("loop_start", np.arange(0, mesh.faces.size, 3, dtype=np.int32))
    data.update(calc_edges=True)
    data.shade_smooth()
    data.set_sharp_from_angle(angle=float(np.deg2rad(SHARP_EDGE_DEG)))
    data.materials.append(material(material_name))
    return data


def _add_board(spec: BoardSpec) -> None:
    """Add the sheet: its top at z = 0 bears the print, the rest is plain paper."""
    half_x, half_y = spec.width_m / 2, spec.height_m / 2
    sheet = box((-half_x, -half_y, -SHEET_THICKNESS_M), (half_x, half_y, 0.0))
    data = mesh_data("board", sheet, "sheet edge")
    data.materials.append(paper(board_texture(spec, BOARD_PX_PER_M)))
    on_top = (sheet.vertices_m[sheet.faces][:, :, 2] == 0.0).all(axis=1)
    data.polygons.foreach_set("material_index", on_top.astype(np.int32))
    # The picture's left edge is at -x and its top edge at +y.
    uv = sheet.vertices_m[:, :2] / np.array([spec.width_m, spec.height_m]) + 0.5
    layer = data.uv_layers.new(name="print")
    layer.data.foreach_set("uv", uv[sheet.faces.ravel()].astype(np.float32).ravel())
    add_object(Part("board", sheet, NOT_STEEL, "paper"), data, np.zeros(3))
