"""Denoising of rendered passes and conversion to 8-bit colour, in Blender's compositor.

Cycles denoises only what it has just rendered; the compositor's Denoise node runs the same denoiser (Open Image
Denoise) on the sum of several renders.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray
from PIL import Image

from dataset_builder.blender.render import PASS_CHANNELS, rendered_file, set_attributes

SCENE_NAME = "denoise"

EXPOSURE_STOPS = 0.0

_INPUTS = {"Combined": "Image", "Denoising Albedo": "Albedo", "Denoising Normal": "Normal"}
"""Sockets of the Denoise node by render pass."""


def denoised_picture(
    passes: Float32[ndarray, "h w 9"], prefilter: str, scratch_dir: Path
) -> UInt8[ndarray, "h w 3"]:
    """Return the denoised picture of linear ``passes`` (see ``render_passes``), tone-mapped to 8-bit sRGB.

    ``prefilter`` of albedo and normals: ``FAST`` or ``ACCURATE``.
    """
    height, width, _ = passes.shape
    scene = bpy.data.scenes.get(SCENE_NAME) or _denoising_scene()
    scene.render.resolution_x, scene.render.resolution_y = width, height
    scene.node_tree.nodes["Denoise"].prefilter = prefilter
    for n, name in enumerate(PASS_CHANNELS):
        node = scene.node_tree.nodes[name]
        node.image = _with_pixels(node.image, passes[..., 3 * n : 3 * n + 3])
    settings = {"file_format": "PNG", "color_mode": "RGB", "color_depth": "8"}
    with rendered_file(scratch_dir / "colour.png", scene, **settings) as path:
        return np.array(Image.open(path).convert("RGB"), dtype=np.uint8)


def _denoising_scene() -> bpy.types.Scene:
    """Add a scene that renders nothing: its compositor denoises one image, guided by albedo and normals."""
    scene = bpy.data.scenes.new(SCENE_NAME)
    set_attributes(
        scene.render,
        resolution_percentage=100,
        use_compositing=True,
        use_sequencer=False,
        dither_intensity=0.0,
        compositor_device="CPU",
        compositor_precision="FULL",
        compositor_denoise_device="CPU",
        compositor_denoise_final_quality="HIGH",
    )
    set_attributes(scene.view_settings, view_transform="AgX", look="None", exposure=EXPOSURE_STOPS, gamma=1.0)
    scene.use_nodes = True
    tree = scene.node_tree
    tree.nodes.clear()
    denoise = tree.nodes.new("CompositorNodeDenoise")
    set_attributes(denoise, name="Denoise", use_hdr=True, quality="FOLLOW_SCENE")
    for name, socket in _INPUTS.items():
        node = tree.nodes.new("CompositorNodeImage")
        node.name = name
        tree.links.new(node.outputs[0], denoise.inputs[socket])
    composite = tree.nodes.new("CompositorNodeComposite")
    tree.links.new(denoise.outputs[0], composite.inputs[0])
    return scene


def _with_pixels(image: bpy.types.Image | None, values: Float32[ndarray, "h w 3"]) -> bpy.types.Image:
    """Return a float image with ``values``, reusing ``image`` if it has their size."""
    height, width, _ = values.shape
    if image is not None and tuple(image.size) != (width, height):
        bpy.data.images.remove(image)
        image = None
    if image is None:
        image = bpy.data.images.new("pass", width, height, float_buffer=True, is_data=True)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = values[::-1]  # Blender's first row is the lowest.
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    return image
