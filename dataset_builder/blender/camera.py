"""Puts Blender's camera where an OpenCV camera stands.

A lens with distortion as Blender's custom camera: an OSL shader that makes Cycles' rays.

So colour is rendered on the distorted grid itself and nothing is resampled. Only Cycles on the CPU knows it.
"""

from __future__ import annotations

import hashlib
import tempfile
from importlib import resources
from pathlib import Path

import _cycles  # type: ignore[import-not-found]
import bpy
import numpy as np
from jaxtyping import Float64
from mathutils import Matrix
from numpy import ndarray

from dataset_builder.config.rigs import Camera
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.cameras import inverse_rigid

SHADER = "brown_conrady.osl"
_LENS_TERMS = ("k1", "k2", "p1", "p2", "k3")


def set_distorted_optics(optics: bpy.types.Camera, asked: Camera) -> None:
    """Make ``optics`` a camera with the asked ``K`` and distortion; the scene's grid is the caller's.

    Raises ``BuildError`` where Blender cannot compile the shader.
    """
    optics.type = "CUSTOM"
    optics.custom_mode = "INTERNAL"
    optics.shift_x = optics.shift_y = 0.0  # they would move the raster position that the shader gets
    if not optics.custom_bytecode:
        bytecode = _compiled()
        optics.custom_bytecode = bytecode
        optics.custom_bytecode_hash = hashlib.md5(bytecode.encode(), usedforsecurity=False).hexdigest()
    for name, value in _parameters(asked).items():
        optics.cycles_custom[name] = value
    optics.update_tag()


def _parameters(asked: Camera) -> dict[str, float]:
    """Return the shader's parameters by name, pixels; one that is missing would keep its default unseen."""
    K = asked.K
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    lens = dict(zip(_LENS_TERMS, asked.distortion, strict=True))
    grid = {"width": asked.width, "height": asked.height}
    return {name: float(value) for name, value in (grid | pinhole | lens).items()}


def _compiled() -> str:
    source = resources.files(__package__).joinpath(SHADER).read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as scratch:
        written, compiled = Path(scratch, SHADER), Path(scratch, "camera.oso")
        written.write_text(source, encoding="utf-8")
        if not _cycles.osl_compile(str(written), str(compiled)):
            raise BuildError(f"Blender cannot compile its camera shader {SHADER}; its log has the reason")
        return compiled.read_text(encoding="utf-8")


SENSOR_MM = 36.0
CLIP_M = (0.001, 1000.0)
MAX_DEVIATION = 1e-5
NAME = "camera"

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def place_camera(asked: Camera) -> float:
    """Make the scene's camera the one asked for (pixel centres at integers): a pinhole, or a lens with distortion.

    Returns the largest deviation between the asked 4 x 4 pose and the one Blender holds (it rounds to
    float32) and raises ``BuildError`` where that exceeds ``MAX_DEVIATION``. Raises ``ValueError`` for a
    skewed ``K``, or a pinhole's focal lengths whose ratio Blender's pixel aspect cannot hold.
    """
    if asked.K[0, 1] != 0.0 or asked.K[1, 0] != 0.0:
        raise ValueError(f"Blender's camera has no skew, K has:\n{asked.K}")
    camera = _scene_camera()
    distorted = asked.distortion.any()
    _set_grid(asked.width, asked.height, aspect=1.0 if distorted else asked.K[1, 1] / asked.K[0, 0])
    # The lens needs none of it, but what an earlier camera left would show in a few pixels' last bit.
    _set_pinhole_optics(camera.data, asked.K, asked.width, asked.height)
    if distorted:
        set_distorted_optics(camera.data, asked)
    wanted = inverse_rigid(asked.cam_from_world) @ _OPENGL_FROM_OPENCV
    camera.matrix_world = Matrix(wanted.tolist())
    bpy.context.view_layer.update()
    deviation = float(np.abs(placed_cam_from_world() - asked.cam_from_world).max())
    if deviation > MAX_DEVIATION:
        raise BuildError(
            f"Blender holds a camera pose {deviation:.2e} off the one asked for:\n{asked.cam_from_world}"
        )
    return deviation


def placed_cam_from_world() -> Float64[ndarray, "4 4"]:
    """Return the pose that Blender holds, in OpenCV axes: its ``matrix_world``, a float32 matrix, inverted."""
    world_from_gl = np.array(_scene_camera().matrix_world, dtype=np.float64)
    return np.asarray(np.linalg.inv(world_from_gl @ _OPENGL_FROM_OPENCV))


def _scene_camera() -> bpy.types.Object:
    scene = bpy.context.scene
    if scene.camera is None:
        scene.camera = bpy.data.objects.new(NAME, bpy.data.cameras.new(NAME))
        scene.collection.objects.link(scene.camera)
    return scene.camera


def _set_grid(width: int, height: int, aspect: float) -> None:
    """Set the image size and the pixel aspect: fy / fx, which Blender takes as two numbers from 1 upwards."""
    if not 1 / 200 <= aspect <= 200:
        raise ValueError(f"fy / fx is {aspect}, Blender's pixel aspect reaches from 1/200 to 200")
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x = max(aspect, 1.0)
    render.pixel_aspect_y = max(1 / aspect, 1.0)


def _set_pinhole_optics(optics: bpy.types.Camera, K: Float64[ndarray, "3 3"], width: int, height: int) -> None:
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    optics.type = "PERSP"
    optics.sensor_fit = "HORIZONTAL"
    optics.sensor_width = SENSOR_MM
    optics.lens_unit = "MILLIMETERS"
    optics.lens = fx * SENSOR_MM / width
    optics.shift_x = ((width - 1) / 2 - cx) / width
    # Both shifts are shares of the sensor's width; a pixel is fx / fy as high as it is wide.
    optics.shift_y = (cy - (height - 1) / 2) * (fx / fy) / width
    optics.clip_start, optics.clip_end = CLIP_M
    optics.dof.use_dof = False
