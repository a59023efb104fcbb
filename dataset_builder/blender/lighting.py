"""Lights a scene: a sky, the sun, panels and spots. None of them is a surface, so none has depth.

What a place's light is made of, as it is and in each variant, is told in ``light_rigs``.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import bpy
from mathutils import Vector

from dataset_builder.blender.nodes import Colour, Socket, Tree

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Sky:
    """What rays meet that meet nothing: ``horizon`` fades to ``zenith``; one colour where they are the same."""

    horizon: Colour
    zenith: Colour
    strength: float
    clouds: bool = False


@dataclass(frozen=True)
class Panel:
    """A rectangular light of ``size_m`` at ``at_m``, facing ``towards_m`` (world, metres)."""

    name: str
    at_m: Point
    towards_m: Point
    size_m: tuple[float, float]
    power_w: float
    colour: Colour


@dataclass(frozen=True)
class Sun:
    """A light as from infinity: the direction it comes from, its soft edge and its strength (W / m2)."""

    from_direction: Point
    angle_deg: float
    strength: float
    colour: Colour


@dataclass(frozen=True)
class Spot:
    """A lamp that throws a cone, of ``radius_m``, at ``at_m``, facing ``towards_m`` (world, metres)."""

    at_m: Point
    towards_m: Point
    radius_m: float
    cone_deg: float
    power_w: float
    colour: Colour


@dataclass(frozen=True)
class LightRig:
    """All the light of a scene."""

    sky: Sky
    lamps: tuple[Panel | Sun | Spot, ...]


def add_light(rig: LightRig) -> None:
    """Light the open scene, which has no light yet."""
    _add_sky(rig.sky)
    for number, lamp in enumerate(rig.lamps):
        if isinstance(lamp, Panel):
            _add_panel(lamp)
        elif isinstance(lamp, Sun):
            _add_sun(lamp, f"sun-{number}")
        else:
            _add_spot(lamp, f"spot-{number}")


def _add_sky(sky: Sky) -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*sky.horizon, 1.0)
    background.inputs["Strength"].default_value = sky.strength
    if sky.zenith != sky.horizon:
        tree = Tree(world.node_tree)
        world.node_tree.links.new(_gradient(tree, sky), background.inputs["Color"])
    # So smooth a sky is found well enough by chance; lamps get all the shadow rays.
    world.cycles.sampling_method = "NONE"
    bpy.context.scene.world = world


def _gradient(tree: Tree, sky: Sky) -> Socket:
    """Return the sky's colour along a direction: most of the change lies low, as in clear air."""
    direction = tree.direction()
    height = tree.node("ShaderNodeSeparateXYZ", {0: direction}).outputs["Z"]
    colour = tree.mix(
        tree.remap(tree.power(tree.remap(height, 0, 1, 0, 1), 0.55), 0, 1, 0, 1), sky.horizon, sky.zenith
    )
    if sky.clouds:
        veil = tree.step(tree.noise(tree.stretched(direction, (1.0, 1.0, 3.5)), 2.6, 3.0), 0.50, 0.80)
        colour = tree.mix(tree.product(veil, tree.step(height, 0.02, 0.25)), colour, (0.86, 0.89, 0.93))
    return colour


def _add_panel(panel: Panel) -> None:
    light = bpy.data.lights.new(panel.name, "AREA")
    light.shape = "RECTANGLE"
    light.size, light.size_y = panel.size_m
    light.energy = panel.power_w
    light.color = panel.colour
    _hang(light, panel.at_m, Vector(panel.towards_m) - Vector(panel.at_m))


def _add_sun(sun: Sun, name: str) -> None:
    light = bpy.data.lights.new(name, "SUN")
    light.angle = radians(sun.angle_deg)
    light.energy = sun.strength
    light.color = sun.colour
    _hang(light, (0.0, 0.0, 0.0), -Vector(sun.from_direction))


def _add_spot(spot: Spot, name: str) -> None:
    light = bpy.data.lights.new(name, "SPOT")
    light.shadow_soft_size = spot.radius_m
    light.spot_size = radians(spot.cone_deg)
    light.spot_blend = 0.35
    light.energy = spot.power_w
    light.color = spot.colour
    _hang(light, spot.at_m, Vector(spot.towards_m) - Vector(spot.at_m))


def _hang(light: bpy.types.Light, at_m: Point, direction: Vector) -> None:
    added = bpy.data.objects.new(light.name, light)
    added.location = at_m
    # A light shines along its -z axis.
    added.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()
    added.visible_camera = False
    bpy.context.scene.collection.objects.link(added)
