"""A lens with distortion as Blender's custom camera: an OSL shader that makes Cycles' rays.

So colour is rendered on the distorted grid itself and nothing is resampled. Only Cycles on the CPU knows it.
"""

from __future__ import annotations

import hashlib
import tempfile
from importlib import resources
from pathlib import Path

import _cycles  # type: ignore[import-not-found]
import bpy

from dataset_builder.optics import Camera
from rebar_depth_bench.errors import BuildError

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
