"""Colour images of the open scene: two Cycles renders with different samples, combined and then denoised once.

Steel covers a few percent of a picture and is what the benchmark measures, so the box around it gets more samples
than the rest, which is smooth and denoises well. Both renders take their samples from one sequence: inside the box
they add up to what uniform sampling with ``steel_samples`` gives.

Cycles denoises only what it has just rendered; the compositor's Denoise node runs the same denoiser (Open Image
Denoise) on the sum of several renders.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray
from PIL import Image

from dataset_builder.blender.camera import place_camera
from dataset_builder.blender.render import (
    PASS_CHANNELS,
    render_passes,
    rendered_file,
    set_attributes,
    set_pixels,
    use_cycles,
)
from dataset_builder.scene.raycast import steel_box
from dataset_builder.specs.config_specs import ColourSpec
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.geometry.cameras import Camera

BOX_MARGIN_PX = 4
"""Margin of the box around the steel: the light that the denoiser mixes into a steel pixel comes from near it."""

SCENE_NAME = "denoise"

EXPOSURE_STOPS = 0.0

_INPUTS = {"Combined": "Image", "Denoising Albedo": "Albedo", "Denoising Normal": "Normal"}
"""Sockets of the Denoise node by render pass."""


def configure_colour(threads: int) -> None:
    """Configure the open scene for ``render_colour``; required once after ``build_scene``.

    Images are identical, byte for byte, for any number of ``threads``.
    """
    scene = bpy.context.scene
    use_cycles(scene, threads)
    set_attributes(
        scene.cycles,
        use_denoising=False,  # ``denoised_picture`` denoises the sum of both renders.
        # With blue noise, the default, the samples of a pixel depend on their number and on earlier renders.
        sampling_pattern="TABULATED_SOBOL",
        max_bounces=3,
        diffuse_bounces=2,
        glossy_bounces=3,
        # With one or two lamps a light tree has no benefit; without it a frame takes a fifth less time.
        use_light_tree=False,
        sample_clamp_indirect=4.0,
        caustics_reflective=False,
        caustics_refractive=False,
    )


def render_colour(
    camera: Camera, steel: Bool[ndarray, "h w"], spec: ColourSpec, seed: int, scratch_dir: Path
) -> UInt8[ndarray, "h w 3"]:
    """Render one colour image; ``steel`` is the mask of its steel pixels, and ``seed`` determines its noise.

    Raises ``BuildError`` if ``configure_colour`` has not been called.
    """
    scene = bpy.context.scene
    if scene.render.engine != "CYCLES":
        raise BuildError("the scene is not set up for colour: call configure_colour after build_scene")
    place_camera(camera)
    set_attributes(scene.cycles, seed=seed, samples=spec.steel_samples)
    box = steel_box(steel, BOX_MARGIN_PX) if spec.steel_samples > spec.samples else None
    passes = render_passes(range(spec.samples), None, scratch_dir)
    if box is not None:
        further = render_passes(range(spec.samples, spec.steel_samples), box, scratch_dir)
        share = spec.samples / spec.steel_samples
        passes[box.slices] = share * passes[box.slices] + (1 - share) * further
    return denoised_picture(passes, spec.prefilter, scratch_dir)


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
    set_pixels(image, values)
    return image
