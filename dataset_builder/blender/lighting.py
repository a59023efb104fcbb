"""The light of the room: a soft sky through its open top, a ceiling panel, a window's worth from one side.

Lights are no surfaces: cameras do not see them, and they have no depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
from mathutils import Vector

SKY_COLOUR = (0.86, 0.93, 1.0)
SKY_STRENGTH = 0.38


@dataclass(frozen=True)
class Panel:
    """A rectangular light of ``size_m`` at ``at_m``, facing ``towards_m`` (world, metres)."""

    name: str
    at_m: tuple[float, float, float]
    towards_m: tuple[float, float, float]
    size_m: tuple[float, float]
    power_w: float
    colour: tuple[float, float, float]


PANELS = (
    Panel("ceiling-panel", (-0.35, 0.45, 1.9), (0.0, 0.05, 0.0), (0.9, 0.45), 62.0, (1.0, 0.93, 0.85)),
    Panel("window", (-1.9, -0.9, 1.5), (0.0, 0.0, 0.0), (1.1, 0.9), 40.0, (0.82, 0.91, 1.0)),
)


def add_laboratory_lights() -> None:
    """Light the open scene as a room."""
    _add_sky()
    for panel in PANELS:
        _add_panel(panel)


def _add_sky() -> None:
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    background = world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*SKY_COLOUR, 1.0)
    background.inputs["Strength"].default_value = SKY_STRENGTH
    # A sky of one brightness is found well enough by chance; lamps get all the shadow rays.
    world.cycles.sampling_method = "NONE"
    bpy.context.scene.world = world


def _add_panel(panel: Panel) -> None:
    light = bpy.data.lights.new(panel.name, "AREA")
    light.shape = "RECTANGLE"
    light.size, light.size_y = panel.size_m
    light.energy = panel.power_w
    light.color = panel.colour
    added = bpy.data.objects.new(panel.name, light)
    added.location = panel.at_m
    # A light shines along its -z axis.
    direction = Vector(panel.towards_m) - Vector(panel.at_m)
    added.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()
    added.visible_camera = False
    bpy.context.scene.collection.objects.link(added)
