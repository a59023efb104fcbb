"""Colour images of the open scene: two Cycles renders with different samples, combined and then denoised once.

Steel covers a few percent of a picture and is what the benchmark measures, so the box around it gets more samples
than the rest, which is smooth and denoises well. Both renders take their samples from one sequence: inside the box
they add up to what uniform sampling with ``steel_samples`` gives.
"""

from __future__ import annotations

from pathlib import Path

import bpy
from jaxtyping import Bool, UInt8
from numpy import ndarray

from dataset_builder.blender.camera import place_camera
from dataset_builder.blender.denoise import denoised_picture
from dataset_builder.blender.render import render_passes, set_attributes, use_cycles
from dataset_builder.config.specs import ColourSpec
from dataset_builder.scene.steel_box import steel_box
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.cameras import Camera

BOX_MARGIN_PX = 4
"""Margin of the box around the steel: the light that the denoiser mixes into a steel pixel comes from near it."""


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
