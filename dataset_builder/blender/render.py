"""Cycles rendering of the open scene on the CPU: colour images, and planar depth for the audit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import OpenEXR
from jaxtyping import Float32, UInt8
from numpy import ndarray
from PIL import Image

from dataset_builder.blender.camera import place_camera
from dataset_builder.config.specs import ColourSpec
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.cameras import Camera

DEPTH_CHANNEL = "ViewLayer.Depth.Z"
NO_SURFACE_M = 1e9
"""Depth above which a pixel has no surface; Cycles writes 1e10 there."""

EXPOSURE_STOPS = 0.0


def configure_colour(spec: ColourSpec, threads: int) -> None:
    """Configure the open scene for ``render_colour``; required once after ``build_scene``.

    Images are identical, byte for byte, for any number of ``threads``.
    """
    scene = bpy.context.scene
    _use_cycles(scene, threads)
    _set_attributes(
        scene.cycles,
        samples=spec.samples,
        use_denoising=spec.denoise,
        denoiser="OPENIMAGEDENOISE",
        denoising_quality="HIGH",
        denoising_prefilter=spec.prefilter,
        denoising_input_passes="RGB_ALBEDO_NORMAL",
        max_bounces=3,
        diffuse_bounces=2,
        glossy_bounces=3,
        # With one or two lamps a light tree has no benefit; without it a frame takes a fifth less time.
        use_light_tree=False,
        sample_clamp_indirect=4.0,
        caustics_reflective=False,
        caustics_refractive=False,
    )
    _set_attributes(scene.view_settings, view_transform="AgX", look="None")
    _set_attributes(scene.view_settings, exposure=EXPOSURE_STOPS, gamma=1.0)


def render_colour(camera: Camera, seed: int, scratch_dir: Path) -> UInt8[ndarray, "h w 3"]:
    """Render one colour image; ``seed`` determines its noise.

    Raises ``BuildError`` if ``configure_colour`` has not been called.
    """
    scene = bpy.context.scene
    if scene.render.engine != "CYCLES":
        raise BuildError("the scene is not set up for colour: call configure_colour after build_scene")
    place_camera(camera)
    scene.cycles.seed = seed
    with _rendered_file(scratch_dir / "colour.png", file_format="PNG", color_mode="RGB", color_depth="8") as path:
        return np.array(Image.open(path).convert("RGB"), dtype=np.uint8)


def render_depth(camera: Camera, scratch_dir: Path) -> Float32[ndarray, "h w"]:
    """Render planar depth through pixel centres, metres, 0.0 where there is no surface; restores all settings.

    Cycles takes depth from its first sample; a filter of almost zero width keeps that sample on the pixel centre.
    For a lens with distortion Cycles gives the distance along the ray instead, which is divided by the length of
    the ray ``(x, y, 1)``.
    """
    scene, layer = bpy.context.scene, bpy.context.view_layer
    place_camera(camera)
    with (
        _temporary_settings(scene.render, engine="CYCLES"),
        _temporary_settings(
            scene.cycles, device="CPU", samples=1, use_adaptive_sampling=False, use_denoising=False
        ),
        _temporary_settings(scene.cycles, pixel_filter_type="BLACKMAN_HARRIS", filter_width=0.01, max_bounces=0),
        _temporary_settings(layer, use_pass_z=True),
        _rendered_file(scratch_dir / "depth.exr", file_format="OPEN_EXR_MULTILAYER", color_depth="32") as path,
    ):
        depth_m = _read_depth_m(path)
    return depth_m / _range_per_depth(camera) if camera.distortion.any() else depth_m


def _range_per_depth(camera: Camera) -> Float32[ndarray, "h w"]:
    """Return the ratio of the distance along each pixel's ray to planar depth."""
    return np.asarray(np.linalg.norm(camera.rays(), axis=-1), dtype=np.float32)


def _read_depth_m(path: Path) -> Float32[ndarray, "h w"]:
    """Return the depth channel of an EXR file; raise ``BuildError`` if it is missing."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        if DEPTH_CHANNEL not in channels:
            raise BuildError(f"{path} has no channel {DEPTH_CHANNEL}, only {sorted(channels)}")
        depth_m = np.array(channels[DEPTH_CHANNEL].pixels, dtype=np.float32)
    depth_m[depth_m > NO_SURFACE_M] = 0.0
    return depth_m


def _use_cycles(scene: bpy.types.Scene, threads: int) -> None:
    """Select Cycles on the CPU, with settings that make renders reproducible."""
    scene.render.engine = "CYCLES"
    _set_attributes(scene.cycles, device="CPU", use_adaptive_sampling=False, use_animated_seed=False)
    _set_attributes(
        scene.render,
        threads_mode="FIXED",
        threads=threads,
        use_persistent_data=True,
        dither_intensity=0.0,
        use_stamp=False,
        use_compositing=False,
        use_sequencer=False,
        film_transparent=False,
    )


@contextmanager
def _rendered_file(path: Path, **image_settings: Any) -> Iterator[Path]:
    """Render the scene to ``path`` with the given image settings, and remove the file on exit."""
    render = bpy.context.scene.render
    with (
        _temporary_settings(render.image_settings, **image_settings),
        _temporary_settings(render, filepath=str(path), use_file_extension=False),
    ):
        bpy.ops.render.render(write_still=True)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _temporary_settings(owner: Any, **values: Any) -> Iterator[None]:
    """Set attributes of ``owner`` to other values for the duration of the context."""
    before = {name: getattr(owner, name) for name in values}
    _set_attributes(owner, **values)
    try:
        yield
    finally:
        _set_attributes(owner, **before)


def _set_attributes(owner: Any, **values: Any) -> None:
    for name, value in values.items():
        setattr(owner, name, value)
