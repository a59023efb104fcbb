"""Scene in Blender's open file, its lights, and its evaluated mesh. World frame, metres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import radians
from pathlib import Path

import bpy
import numpy as np
from jaxtyping import Float64, Int32
from mathutils import Vector
from numpy import ndarray

from dataset_builder.blender.materials import (
    GLOW_PROPERTY,
    LAMP,
    material,
    paper,
    steel_material_name,
    surface_variation,
)
from dataset_builder.blender.shader_nodes import NodeTreeBuilder, Socket, WorldBuilder
from dataset_builder.scene.board_texture import board_texture
from dataset_builder.scene.environments.laboratory import SHEET_THICKNESS_M
from dataset_builder.scene.environments.light_rigs import LightRig, Panel, Sky, Spot, Sun
from dataset_builder.scene.environments.surroundings import SURROUNDINGS, floor_offset_m
from dataset_builder.scene.model import NOT_STEEL, Assembly, Mesh, Part, WorldMesh, surface
from dataset_builder.scene.shapes.solids import box, transformed, world_mesh
from dataset_builder.scene.variants.props import make_props
from dataset_builder.scene.variants.registry import (
    LIGHT_SLOT,
    STEEL_SLOT,
    ImageLight,
    exclusive_variant,
    image_light,
)
from dataset_builder.specs.config_specs import SceneSpec
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.geometry.aruco_board import BoardSpec

BAR_ID = "bar_id"
"""Name of the custom property with an object's bar id."""

BOARD_PX_PER_M = 6000.0
"""Resolution of the board texture."""

SHARP_EDGE_DEG = 50.0
"""Angle between faces from which an edge is shaded sharp."""

SHAPE_TOLERANCE_M = 1e-9
"""Largest difference of coordinates between parts that share mesh data."""


def build_scene(assembly: Assembly, spec: SceneSpec, *, colour: bool = True) -> None:
    """Replace Blender's open file with the scene: one object per steel part, environment, props, board and lights.

    Without ``colour``, the scene has the same meshes but neither materials nor lights. The appearance variants
    must have passed ``check_variants`` and ``check_suitable``.
    """
    variants = spec.appearance.variants
    bpy.ops.wm.read_factory_settings(use_empty=True)
    steel_material = steel_material_name(exclusive_variant(variants, STEEL_SLOT)) if colour else None
    for part, mesh, origin_m in _with_shared_meshes(assembly.parts, steel_material):
        steel = add_object(part, mesh, origin_m)
        for name, value in surface_variation(spec.seed, part.bar_id).items():
            steel[name] = value
    surroundings = SURROUNDINGS[spec.environment]
    offset_z_m = floor_offset_m(spec)
    panorama = image_light(spec)
    rig = None if panorama is not None else surroundings.light[exclusive_variant(variants, LIGHT_SLOT)]
    opened = surroundings.roof if panorama is None else (*surroundings.enclosure, *surroundings.roof)
    for part in surroundings.parts():
        added = _add_surface(part, offset_z_m, colour)
        if part.name.partition("-")[0] in opened:
            let_light_through(added)
        if part.material == LAMP:
            added[GLOW_PROPERTY] = 0.0 if rig is None else rig.glow
    for part in make_props(assembly, spec):
        _add_surface(part, 0.0, colour)
    if spec.board is not None:
        _add_board(spec.board, colour)
    if colour and panorama is not None:
        add_panorama(panorama)
    elif colour and rig is not None:
        add_light(rig)
    bpy.context.view_layer.update()


def _with_shared_meshes(
    parts: tuple[Part, ...], material_name: str | None
) -> Iterator[tuple[Part, bpy.types.Mesh, Float64[ndarray, " 3"]]]:
    """Yield each part with its mesh data and origin; parts that differ only by a translation share mesh data."""
    shapes: list[tuple[Mesh, bpy.types.Mesh]] = []
    for part in parts:
        origin_m = part.mesh.vertices_m.min(axis=0)
        local = Mesh(part.mesh.vertices_m - origin_m, part.mesh.faces)
        data = next((data for mesh, data in shapes if _same_shape(mesh, local)), None)
        if data is None:
            data = mesh_data(part.name, local, material_name)
            shapes.append((local, data))
        yield part, data, origin_m


def _same_shape(a: Mesh, b: Mesh) -> bool:
    """Return whether two meshes have the same faces, and vertices within ``SHAPE_TOLERANCE_M``."""
    return (
        a.vertices_m.shape == b.vertices_m.shape
        and np.array_equal(a.faces, b.faces)
        and bool(np.abs(a.vertices_m - b.vertices_m).max() < SHAPE_TOLERANCE_M)
    )


def add_object(part: Part, data: bpy.types.Mesh, origin_m: Float64[ndarray, " 3"]) -> bpy.types.Object:
    """Add ``data`` to the open scene at ``origin_m`` (world, metres), with the part's bar id as ``BAR_ID``."""
    added = bpy.data.objects.new(part.name, data)
    added.location = origin_m
    added[BAR_ID] = part.bar_id
    bpy.context.scene.collection.objects.link(added)
    return added


def _add_surface(part: Part, height_m: float, colour: bool) -> bpy.types.Object:
    """Add a part to the open scene, ``height_m`` above its place, with its material if ``colour`` is True."""
    data = mesh_data(part.name, part.mesh, part.material if colour else None)
    return add_object(part, data, np.array([0.0, 0.0, height_m]))


def mesh_data(name: str, mesh: Mesh, material_name: str | None) -> bpy.types.Mesh:
    """Return Blender mesh data with the triangles of ``mesh``, shaded smooth below ``SHARP_EDGE_DEG``.

    It has no material if ``material_name`` is None.
    """
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
    if material_name is not None:
        data.materials.append(material(material_name))
    return data


def _add_board(spec: BoardSpec, colour: bool) -> None:
    """Add the sheet with its top at z = 0; with ``colour``, the top is printed and the other faces are plain."""
    half_x, half_y = spec.width_m / 2, spec.height_m / 2
    sheet = box((-half_x, -half_y, -SHEET_THICKNESS_M), (half_x, half_y, 0.0))
    data = mesh_data("board", sheet, "sheet edge" if colour else None)
    if colour:
        _print_board(data, sheet, spec)
    add_object(surface("board", sheet, "paper"), data, np.zeros(3))


def _print_board(data: bpy.types.Mesh, sheet: Mesh, spec: BoardSpec) -> None:
    """Print the board's texture on the faces of its mesh data at z = 0."""
    data.materials.append(paper(board_texture(spec, BOARD_PX_PER_M)))
    on_top = (sheet.vertices_m[sheet.faces][:, :, 2] == 0.0).all(axis=1)
    data.polygons.foreach_set("material_index", on_top.astype(np.int32))
    # The left edge of the texture is at -x and its top edge at +y.
    uv = sheet.vertices_m[:, :2] / np.array([spec.width_m, spec.height_m]) + 0.5
    layer = data.uv_layers.new(name="print")
    layer.data.foreach_set("uv", uv[sheet.faces.ravel()].astype(np.float32).ravel())


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
    return world_mesh([item.mesh for item in placed_meshes], [item.bar_id for item in placed_meshes])


def _mesh_instances() -> Iterator[_MeshInstance]:
    """Yield the visible mesh objects and instances in the order of the dependency graph."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    local_meshes: dict[int, Mesh] = {}
    for instance in depsgraph.object_instances:
        evaluated, original = instance.object, instance.object.original
        is_visible = instance.show_self and original.visible_camera and not original.hide_render
        if evaluated.type != "MESH" or not is_visible:
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


def _local_mesh(data: bpy.types.Mesh) -> Mesh:
    """Return the triangles of Blender mesh data in its own frame."""
    co = np.empty(len(data.vertices) * 3, dtype=np.float32)
    data.vertices.foreach_get("co", co)
    data.calc_loop_triangles()
    corners: Int32[ndarray, " n"] = np.empty(len(data.loop_triangles) * 3, dtype=np.int32)
    data.loop_triangles.foreach_get("vertices", corners)
    return Mesh(co.reshape(-1, 3).astype(np.float64), corners.reshape(-1, 3))


# Lights: sky, sun, panels, spots and panoramas. They are not surfaces and have no depth.

PANORAMAS = Path("datafiles", "studiolights", "world")
"""Folder of the panoramas, below the local resources of Blender."""


def add_light(rig: LightRig) -> None:
    """Add the sky and the lamp of ``rig`` to the open scene, which must have no light yet."""
    # The sky is smooth enough for unguided sampling, so that lamps get all the shadow rays.
    sky, tree = rig.sky, WorldBuilder("sky", "NONE")
    tree.background(sky.horizon if sky.zenith == sky.horizon else _sky_gradient(tree, sky), sky.strength)
    _add_lamp(rig.lamp)


def _sky_gradient(tree: NodeTreeBuilder, sky: Sky) -> Socket:
    """Return the sky's colour by direction; most of the change is near the horizon, as in clear air."""
    direction = tree.direction()
    height = tree.node("ShaderNodeSeparateXYZ", {0: direction}).outputs["Z"]
    colour = tree.mix(
        tree.remap(tree.power(tree.remap(height, 0, 1, 0, 1), 0.55), 0, 1, 0, 1), sky.horizon, sky.zenith
    )
    if sky.clouds:
        veil = tree.step(tree.noise(tree.stretched(direction, (1.0, 1.0, 3.5)), 2.6, 3.0), 0.50, 0.80)
        colour = tree.mix(tree.product(veil, tree.step(height, 0.02, 0.25)), colour, (0.86, 0.89, 0.93))
    return colour


def _add_lamp(lamp: Panel | Sun | Spot) -> None:
    """Add a lamp to the open scene, invisible to cameras."""
    kind = {Panel: "AREA", Sun: "SUN", Spot: "SPOT"}[type(lamp)]
    light = bpy.data.lights.new("lamp", kind)
    light.energy, light.color = lamp.energy, lamp.colour
    added = bpy.data.objects.new(light.name, light)
    if isinstance(lamp, Sun):
        light.angle = radians(lamp.angle_deg)
        direction = -Vector(lamp.from_direction)
    else:
        added.location = lamp.at_m
        direction = Vector(lamp.towards_m) - Vector(lamp.at_m)
    if isinstance(lamp, Panel):
        light.shape = "RECTANGLE"
        light.size, light.size_y = lamp.size_m
    elif isinstance(lamp, Spot):
        light.shadow_soft_size = lamp.radius_m
        light.spot_size = radians(lamp.cone_deg)
        light.spot_blend = 0.35
    # Lights in Blender shine along their -z axis.
    added.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()
    added.visible_camera = False
    bpy.context.scene.collection.objects.link(added)


def add_panorama(light: ImageLight) -> None:
    """Make the panorama the background of the open scene, which must have no light yet.

    Raises ``BuildError`` if the wheel has no such image or another one.
    """
    path = Path(bpy.utils.resource_path("LOCAL")) / PANORAMAS / f"{light.image}.exr"
    found = file_sha256(path) if path.is_file() else "missing"
    if found != light.sha256:
        raise BuildError(f"{path}: the panorama has sha256 {found}, expected {light.sha256} as in bpy 4.5")
    # Importance sampling at the resolution of the image, because suns and lamps are a few of its pixels.
    tree = WorldBuilder("panorama", "AUTOMATIC")
    # The image turns against the direction at which it is looked up.
    turned = tree.turned(tree.direction(), -radians(light.turn_deg))
    image = bpy.data.images.load(str(path))
    colour = tree.node("ShaderNodeTexEnvironment", {"Vector": turned}, image=image).outputs["Color"]
    tree.background(colour, light.strength)


def let_light_through(surface: bpy.types.Object) -> None:
    """Make an object transparent for light and reflections; cameras still see it, and it is still lit."""
    surface.visible_diffuse = surface.visible_glossy = surface.visible_transmission = False
    surface.visible_shadow = surface.visible_volume_scatter = False
