"""Renders the open scene with Cycles on the CPU: colour pictures, and planar depth for the audit."""

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
from dataset_builder.config.rigs import Camera
from dataset_builder.config.specs import ColourSpec
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.cameras import pixel_rays

DEPTH_CHANNEL = "ViewLayer.Depth.Z"
NOTHING_HIT_M = 1e9
"""Cycles writes 1e10 where a ray meets no surface."""

EXPOSURE_STOPS = 0.0


def configure_colour(spec: ColourSpec, threads: int) -> None:
    """Set the open scene up for ``render_colour``; needed once after ``build_scene``.

    The same picture comes out, byte for byte, for any number of ``threads``.
    """
    scene = bpy.context.scene
    _use_cycles(scene, threads)
    _apply(
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
        # One lamp or two need no tree to choose between them; without it a frame takes a fifth less time.
        use_light_tree=False,
        sample_clamp_indirect=4.0,
        caustics_reflective=False,
        caustics_refractive=False,
    )
    _apply(scene.view_settings, view_transform="AgX", look="None")
    _apply(scene.view_settings, exposure=EXPOSURE_STOPS, gamma=1.0)


def render_colour(camera: Camera, seed: int, scratch_dir: Path) -> UInt8[ndarray, "h w 3"]:
    """Render one colour picture; ``seed`` fixes its noise. Raises ``BuildError`` before ``configure_colour``."""
    scene = bpy.context.scene
    if scene.render.engine != "CYCLES":
        raise BuildError("the scene is not set up for colour: call configure_colour after build_scene")
    place_camera(camera)
    scene.cycles.seed = seed
    with _written(scratch_dir / "colour.png", file_format="PNG", color_mode="RGB", color_depth="8") as path:
        return np.array(Image.open(path).convert("RGB"), dtype=np.uint8)


def render_depth(camera: Camera, scratch_dir: Path) -> Float32[ndarray, "h w"]:
    """Render planar depth through pixel centres, metres, 0.0 where nothing is; leaves all settings as found.

    Cycles takes depth from its first sample, which a filter of vanishing width keeps on the pixel centre. Behind
    a lens with distortion it gives the distance along the ray instead, which is divided by the length of the ray
    ``(x, y, 1)``.
    """
    scene, layer = bpy.context.scene, bpy.context.view_layer
    place_camera(camera)
    with (
        _overridden(scene.render, engine="CYCLES"),
        _overridden(scene.cycles, device="CPU", samples=1, use_adaptive_sampling=False, use_denoising=False),
        _overridden(scene.cycles, pixel_filter_type="BLACKMAN_HARRIS", filter_width=0.01, max_bounces=0),
        _overridden(layer, use_pass_z=True),
        _written(scratch_dir / "depth.exr", file_format="OPEN_EXR_MULTILAYER", color_depth="32") as path,
    ):
        depth_m = _read_depth_m(path)
    return depth_m / _range_over_depth(camera) if camera.distortion.any() else depth_m


def _range_over_depth(camera: Camera) -> Float32[ndarray, "h w"]:
    """Return how many times as far as its planar depth a point on each pixel's ray is."""
    rays_cam = pixel_rays(camera.K, camera.width, camera.height, camera.distortion)
    return np.asarray(np.linalg.norm(rays_cam, axis=-1), dtype=np.float32)


def _read_depth_m(path: Path) -> Float32[ndarray, "h w"]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        if DEPTH_CHANNEL not in channels:
            raise BuildError(f"{path} has no channel {DEPTH_CHANNEL}, only {sorted(channels)}")
        depth_m = np.array(channels[DEPTH_CHANNEL].pixels, dtype=np.float32)
    depth_m[depth_m > NOTHING_HIT_M] = 0.0
    return depth_m


def _use_cycles(scene: bpy.types.Scene, threads: int) -> None:
    scene.render.engine = "CYCLES"
    _apply(scene.cycles, device="CPU", use_adaptive_sampling=False, use_animated_seed=False)
    _apply(
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
def _written(path: Path, **image_settings: Any) -> Iterator[Path]:
    """Render the scene to ``path`` in the given image format, and remove the file afterwards."""
    render = bpy.context.scene.render
    with (
        _overridden(render.image_settings, **image_settings),
        _overridden(render, filepath=str(path), use_file_extension=False),
    ):
        bpy.ops.render.render(write_still=True)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def _overridden(owner: Any, **values: Any) -> Iterator[None]:
    """Give settings of ``owner`` other values for a while."""
    before = {name: getattr(owner, name) for name in values}
    _apply(owner, **values)
    try:
        yield
    finally:
        _apply(owner, **before)


def _apply(owner: Any, **values: Any) -> None:
    for name, value in values.items():
        setattr(owner, name, value)
