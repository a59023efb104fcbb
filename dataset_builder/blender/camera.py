"""Blender camera from an OpenCV camera: pose, image size, intrinsics and lens distortion.

A lens with distortion is a custom camera of Blender: an OSL shader that generates Cycles' rays. Colour is
therefore rendered on the distorted grid itself, without resampling. Only Cycles on the CPU supports it.
"""

from __future__ import annotations

import hashlib
from importlib import resources

import bpy
import numpy as np
from jaxtyping import Float64
from mathutils import Matrix
from numpy import ndarray

from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.base.writing import scratch_folder
from rebar_depth_bench.captures.fields import LENS_TERMS
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, swap_camera_axes

SHADER = "brown_conrady.osl"
"""File name of the OSL camera shader in this package."""


def set_distorted_optics(optics: bpy.types.Camera, camera: Camera) -> None:
    """Set the ``K`` and distortion of ``camera`` on Blender's ``optics``; the caller sets the image size.

    Raises ``BuildError`` if Blender cannot compile the shader.
    """
    optics.type = "CUSTOM"
    optics.custom_mode = "INTERNAL"
    optics.shift_x = optics.shift_y = 0.0  # Shifts would change the raster position that the shader gets.
    if not optics.custom_bytecode:
        bytecode = _compiled_shader()
        optics.custom_bytecode = bytecode
        optics.custom_bytecode_hash = hashlib.md5(bytecode.encode(), usedforsecurity=False).hexdigest()
    for name, value in _shader_parameters(camera).items():
        optics.cycles_custom[name] = value
    optics.update_tag()


def _shader_parameters(camera: Camera) -> dict[str, float]:
    """Return all parameters of the shader by name; lengths in pixels, lens terms without unit.

    A missing parameter would silently keep its default.
    """
    K = camera.K
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    lens = dict(zip(LENS_TERMS, camera.distortion, strict=True))
    grid = {"width": camera.width, "height": camera.height}
    return {name: float(value) for name, value in (grid | pinhole | lens).items()}


def _compiled_shader() -> str:
    """Return the shader's OSL bytecode; raise ``BuildError`` if Blender cannot compile it."""
    import _cycles  # type: ignore[import-not-found]  # can be found only after bpy has been imported

    source = resources.files(__package__).joinpath(SHADER).read_text(encoding="utf-8")
    with scratch_folder("rebar-camera-") as scratch:
        source_file, oso_file = scratch / SHADER, scratch / "camera.oso"
        source_file.write_text(source, encoding="utf-8")
        if not _cycles.osl_compile(str(source_file), str(oso_file)):
            raise BuildError(f"Blender cannot compile its camera shader {SHADER}; see its log for the reason")
        return oso_file.read_text(encoding="utf-8")


SENSOR_MM = 36.0
"""Width of Blender's sensor; it fixes the scale of the focal length and nothing else."""

CLIP_M = (0.001, 1000.0)
"""Near and far clipping distance."""

MAX_POSE_DEVIATION = 1e-5
"""Largest deviation of an entry of the 4 x 4 pose that Blender stores (metres for the translation)."""

CAMERA_NAME = "camera"


def place_camera(camera: Camera) -> float:
    """Set the scene's camera to ``camera`` (pixel centres at integers), a pinhole or a lens with distortion.

    Returns the largest absolute difference between the entries of ``camera.cam_from_world`` and of the pose that
    Blender stores (rounded to float32), and raises ``BuildError`` if it exceeds ``MAX_POSE_DEVIATION``. Raises
    ``ValueError`` for a skewed ``K``, or for a pinhole whose ratio of focal lengths exceeds the range of Blender's
    pixel aspect.
    """
    if camera.K[0, 1] != 0.0 or camera.K[1, 0] != 0.0:
        raise ValueError(f"Blender cameras cannot have skew, but K is:\n{camera.K}")
    blender_camera = _scene_camera()
    distorted = camera.distortion.any()
    _set_resolution(camera.width, camera.height, aspect=1.0 if distorted else camera.K[1, 1] / camera.K[0, 0])
    # A lens with distortion does not use these settings, but values left by an earlier camera would change the
    # last bit of a few pixels.
    _set_pinhole_optics(blender_camera.data, camera.K, camera.width, camera.height)
    if distorted:
        set_distorted_optics(blender_camera.data, camera)
    world_from_gl = inverse_rigid(swap_camera_axes(camera.cam_from_world))
    blender_camera.matrix_world = Matrix(world_from_gl.tolist())
    bpy.context.view_layer.update()
    deviation = float(np.abs(blender_cam_from_world() - camera.cam_from_world).max())
    if deviation > MAX_POSE_DEVIATION:
        raise BuildError(
            f"Blender's camera pose differs by {deviation:.2e} from the requested pose:\n{camera.cam_from_world}"
        )
    return deviation


def blender_cam_from_world() -> Float64[ndarray, "4 4"]:
    """Return the pose that Blender stores, in OpenCV axes: the inverse of its float32 ``matrix_world``."""
    world_from_gl = np.array(_scene_camera().matrix_world, dtype=np.float64)
    return swap_camera_axes(np.linalg.inv(world_from_gl))


def _scene_camera() -> bpy.types.Object:
    """Return the scene's camera object, created on first use."""
    scene = bpy.context.scene
    if scene.camera is None:
        scene.camera = bpy.data.objects.new(CAMERA_NAME, bpy.data.cameras.new(CAMERA_NAME))
        scene.collection.objects.link(scene.camera)
    return scene.camera


def _set_resolution(width: int, height: int, aspect: float) -> None:
    """Set the image size and the pixel aspect fy / fx, which Blender stores as two numbers of at least 1.

    Raises ``ValueError`` if the aspect is outside Blender's range.
    """
    if not 1 / 200 <= aspect <= 200:
        raise ValueError(f"fy / fx is {aspect}, expected 1/200 to 200 (Blender's range of pixel aspects)")
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x = max(aspect, 1.0)
    render.pixel_aspect_y = max(1 / aspect, 1.0)


def _set_pinhole_optics(optics: bpy.types.Camera, K: Float64[ndarray, "3 3"], width: int, height: int) -> None:
    """Set Blender's perspective camera to the intrinsics ``K`` (pixels)."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    optics.type = "PERSP"
    optics.sensor_fit = "HORIZONTAL"
    optics.sensor_width = SENSOR_MM
    optics.lens_unit = "MILLIMETERS"
    optics.lens = fx * SENSOR_MM / width
    optics.shift_x = ((width - 1) / 2 - cx) / width
    # Both shifts are fractions of the sensor width; a pixel's height is fx / fy times its width.
    optics.shift_y = (cy - (height - 1) / 2) * (fx / fy) / width
    optics.clip_start, optics.clip_end = CLIP_M
    optics.dof.use_dof = False
