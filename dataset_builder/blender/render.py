"""Cycles rendering of the open scene on the CPU: linear passes for colour, and planar depth for the audit."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import OpenEXR
from jaxtyping import Float32
from numpy import ndarray

from dataset_builder.blender.camera import place_camera
from dataset_builder.scene.raycast import PixelBox
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.base.writing import named_write_errors
from rebar_depth_bench.geometry.cameras import Camera

DEPTH_CHANNEL = "ViewLayer.Depth.Z"
NO_SURFACE_M = 1e9
"""Depth above which a pixel has no surface; Cycles writes 1e10 there."""

PASS_CHANNELS = {"Combined": "RGB", "Denoising Albedo": "RGB", "Denoising Normal": "XYZ"}
"""Channels of the render passes that ``render_passes`` returns: linear colour, and what guides the denoiser."""

_INTO_PIXEL = 0.25
"""Part of a pixel added to borders, which Blender rounds down: a rounding error must not lose a row."""

_MAX_BYTES_PER_PIXEL = 64
"""Largest size of a rendered file: sixteen float32 channels, uncompressed."""


def render_passes(samples: range, box: PixelBox | None, scratch_dir: Path) -> Float32[ndarray, "h w 9"]:
    """Render the passes of ``PASS_CHANNELS`` with the scene's camera; return the means of samples of each pixel.

    ``samples`` are indices into the pixel's sequence of samples, whose length and seed are settings of the scene:
    the means of two adjacent ranges, weighted by their lengths, give the mean of both. With a ``box`` only its
    pixels are rendered and returned.
    """
    scene, layer = bpy.context.scene, bpy.context.view_layer
    subset = {
        "use_sample_subset": True,
        "sample_offset": samples.start,
        "sample_subset_length": len(samples),
    }
    image_settings = {"file_format": "OPEN_EXR_MULTILAYER", "color_depth": "32", "exr_codec": "NONE"}
    with (
        temporary_settings(scene.cycles, **subset),
        temporary_settings(layer.cycles, denoising_store_passes=True),
        temporary_settings(scene.render, **_border(scene.render, box)),
        rendered_file(scratch_dir / "passes.exr", scene, **image_settings) as path,
    ):
        return _read_channels(
            path, [f"ViewLayer.{name}.{axis}" for name, axes in PASS_CHANNELS.items() for axis in axes]
        )


def _border(render: bpy.types.RenderSettings, box: PixelBox | None) -> dict[str, Any]:
    """Return the settings that restrict a render to ``box``: fractions of the image from its lower left."""
    if box is None:
        return {"use_border": False}
    width, height = render.resolution_x, render.resolution_y
    return {
        "use_border": True,
        "use_crop_to_border": True,
        "border_min_x": (box.left + _INTO_PIXEL) / width,
        "border_max_x": (box.right + _INTO_PIXEL) / width,
        "border_min_y": (height - box.bottom + _INTO_PIXEL) / height,
        "border_max_y": (height - box.top + _INTO_PIXEL) / height,
    }


def render_depth(camera: Camera, scratch_dir: Path) -> Float32[ndarray, "h w"]:
    """Render planar depth through pixel centres, metres, 0.0 where there is no surface; restores all settings.

    Cycles takes depth from its first sample; a filter of almost zero width keeps that sample on the pixel centre.
    For a lens with distortion Cycles gives the distance along the ray instead, which is divided by the length of
    the ray ``(x, y, 1)``.
    """
    scene, layer = bpy.context.scene, bpy.context.view_layer
    place_camera(camera)
    with (
        temporary_settings(scene.render, engine="CYCLES"),
        temporary_settings(
            scene.cycles, device="CPU", samples=1, use_adaptive_sampling=False, use_denoising=False
        ),
        temporary_settings(scene.cycles, pixel_filter_type="BLACKMAN_HARRIS", filter_width=0.01, max_bounces=0),
        temporary_settings(layer, use_pass_z=True),
        rendered_file(
            scratch_dir / "depth.exr", scene, file_format="OPEN_EXR_MULTILAYER", color_depth="32"
        ) as path,
    ):
        depth_m = _read_channels(path, [DEPTH_CHANNEL])[..., 0]
    depth_m[depth_m > NO_SURFACE_M] = 0.0
    if camera.distortion.any():
        depth_m /= np.linalg.norm(camera.rays(), axis=-1).astype(np.float32)
    return depth_m


def _read_channels(path: Path, names: Sequence[str]) -> Float32[ndarray, "h w c"]:
    """Return the named channels of an EXR file; raise ``BuildError`` if one is missing."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        missing = [name for name in names if name not in channels]
        if missing:
            raise BuildError(f"{path} has no channel {', '.join(missing)}, only {', '.join(sorted(channels))}")
        return np.stack([channels[name].pixels for name in names], axis=-1, dtype=np.float32)


def use_cycles(scene: bpy.types.Scene, threads: int) -> None:
    """Select Cycles on the CPU, with settings that make renders reproducible."""
    scene.render.engine = "CYCLES"
    set_attributes(scene.cycles, device="CPU", use_adaptive_sampling=False, use_animated_seed=False)
    set_attributes(
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
def rendered_file(path: Path, scene: bpy.types.Scene, **image_settings: Any) -> Iterator[Path]:
    """Render ``scene`` to ``path`` with the given image settings, and remove the file on exit.

    Raises ``OutputError`` if the file cannot be read in the block because the disk has no space for it: Blender
    reports a picture that it could not write as finished.
    """
    render = scene.render
    with (
        temporary_settings(render.image_settings, **image_settings),
        temporary_settings(render, filepath=str(path), use_file_extension=False),
    ):
        bpy.ops.render.render(write_still=True, scene=scene.name)
    try:
        yield path
    except (OSError, RuntimeError, ValueError):
        size = render.resolution_x * render.resolution_y * _MAX_BYTES_PER_PIXEL
        with named_write_errors(path), path.open("wb") as file:  # An ``OutputError`` if there is no space.
            os.posix_fallocate(file.fileno(), 0, size)
        raise
    finally:
        path.unlink(missing_ok=True)


@contextmanager
def temporary_settings(owner: Any, **values: Any) -> Iterator[None]:
    """Set attributes of ``owner`` to other values for the duration of the context."""
    before = {name: getattr(owner, name) for name in values}
    set_attributes(owner, **values)
    try:
        yield
    finally:
        set_attributes(owner, **before)


def set_attributes(owner: Any, **values: Any) -> None:
    """Set several attributes of ``owner``."""
    for name, value in values.items():
        setattr(owner, name, value)


def set_pixels(image: bpy.types.Image, values: Float32[ndarray, "h w c"]) -> None:
    """Set the opaque colours of an image of the same size; row 0 is at the top, and one channel is a grey."""
    rgba = np.ones((*values.shape[:2], 4), np.float32)
    rgba[..., :3] = values[::-1]  # Blender's first row is the lowest.
    image.pixels.foreach_set(rgba.ravel())
    image.update()
