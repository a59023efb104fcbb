"""Panorama light: the world of the open scene shows and sheds the light of an image of the bpy wheel."""

from __future__ import annotations

from math import radians
from pathlib import Path

import bpy

from dataset_builder.blender.shader_nodes import NodeTreeBuilder
from dataset_builder.scene.variants.registry import ImageLight
from rebar_depth_bench.data.digests import file_sha256
from rebar_depth_bench.errors import BuildError

FOLDER = Path("datafiles", "studiolights", "world")
"""Folder of the panoramas, below the local resources of Blender."""


def add_panorama(light: ImageLight) -> None:
    """Make the panorama the background of the open scene, which must have no light yet.

    Raises ``BuildError`` if the wheel has no such image or another one.
    """
    path = Path(bpy.utils.resource_path("LOCAL")) / FOLDER / f"{light.image}.exr"
    found = file_sha256(path) if path.is_file() else "missing"
    if found != light.sha256:
        raise BuildError(f"{path}: the panorama has sha256 {found}, expected {light.sha256} as in bpy 4.5")
    world = bpy.data.worlds.new("panorama")
    world.use_nodes = True
    tree = NodeTreeBuilder(world.node_tree)
    # The image turns against the direction at which it is looked up.
    turned = tree.turned(tree.direction(), -radians(light.turn_deg))
    image = bpy.data.images.load(str(path))
    colour = tree.node("ShaderNodeTexEnvironment", {"Vector": turned}, image=image).outputs["Color"]
    background = world.node_tree.nodes["Background"]
    world.node_tree.links.new(colour, background.inputs["Color"])
    background.inputs["Strength"].default_value = light.strength
    # Importance sampling at the resolution of the image, because suns and lamps are a few of its pixels.
    world.cycles.sampling_method = "AUTOMATIC"
    bpy.context.scene.world = world


def let_light_through(surface: bpy.types.Object) -> None:
    """Make an object transparent for light and reflections; cameras still see it, and it is still lit."""
    surface.visible_diffuse = surface.visible_glossy = surface.visible_transmission = False
    surface.visible_shadow = surface.visible_volume_scatter = False
