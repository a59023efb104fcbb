"""Scene lights in Blender: sky, sun, panels, spots and panoramas.

Lights are not surfaces and have no depth.
"""

from __future__ import annotations

from math import radians
from pathlib import Path

import bpy
from mathutils import Vector

from dataset_builder.blender.shader_nodes import NodeTreeBuilder, Socket, WorldBuilder
from dataset_builder.scene.environments.light_rigs import LightRig, Panel, Sky, Spot, Sun
from dataset_builder.scene.variants.registry import ImageLight
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.data.files import file_sha256

PANORAMAS = Path("datafiles", "studiolights", "world")
"""Folder of the panoramas, below the local resources of Blender."""


def add_light(rig: LightRig) -> None:
    """Add the sky and the lamp of ``rig`` to the open scene, which must have no light yet."""
    _add_sky(rig.sky)
    _add_lamp(rig.lamp)


def _add_sky(sky: Sky) -> None:
    """Set the sky as the background of the open scene."""
    # The sky is smooth enough for unguided sampling, so that lamps get all the shadow rays.
    tree = WorldBuilder("sky", "NONE")
    tree.background(sky.horizon if sky.zenith == sky.horizon else _sky_gradient(tree, sky), sky.strength)


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
