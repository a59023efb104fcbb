"""What the scene's surfaces look like. Bumps are shading only: no material moves a surface."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from dataset_builder.blender.nodes import Colour, Shader

RUST, PATTERN, TONE = "rust_amount", "pattern_shift_m", "scale_tone"
"""Custom properties of a steel object that its material reads."""


def surface_variation(seed: int, bar_id: int) -> dict[str, float]:
    """Return one bar's share of rust (0 to 1), shift of pattern and tone of scale, drawn from both numbers."""
    random = np.random.default_rng([seed, bar_id])
    return {
        RUST: float(random.beta(1.6, 2.2)),
        PATTERN: float(random.uniform(0.0, 10.0)),
        TONE: float(random.uniform(0.0, 1.0)),
    }


def material(name: str) -> bpy.types.Material:
    """Return the material ``name`` of the open file, made on first use."""
    found = bpy.data.materials.get(name)
    if found is None:
        found = _plain(name) if name in _PLAIN else _MAKERS[name](name)
    return found


def paper(texture: UInt8[ndarray, "h w"]) -> bpy.types.Material:
    """Return matt paper with ``texture`` (row 0 on top) printed on it."""
    shader = Shader("paper")
    image = _image("board", texture)
    printed = shader.node("ShaderNodeTexImage", {"Vector": shader.uv()}, image=image, extension="EXTEND")
    # Ink is no black hole and paper no mirror: keep both inside what a printer delivers.
    colour = shader.mix(printed.outputs["Color"], (0.018, 0.018, 0.02), (0.74, 0.735, 0.71))
    return shader.surface(Base_Color=colour, Roughness=0.75, Specular_IOR_Level=0.3)


def _image(name: str, texture: UInt8[ndarray, "h w"]) -> bpy.types.Image:
    height, width = texture.shape
    image = bpy.data.images.new(name, width, height)
    # Values are mixing shares, not light: no transfer curve.
    image.colorspace_settings.name = "Non-Color"
    # Blender's row 0 is at the bottom.
    grey = np.flipud(texture).astype(np.float32)[..., None] / np.float32(255)
    rgba = np.concatenate([grey, grey, grey, np.ones_like(grey)], axis=2)
    image.pixels.foreach_set(np.ascontiguousarray(rgba).ravel())
    image.update()
    image.pack()
    return image


def _steel(name: str) -> bpy.types.Material:
    """Blue-grey mill scale with patches of rust; amount, pattern and tone come from each bar's properties."""
    shader = Shader(name)
    at = shader.shifted(shader.position(), shader.object_value(PATTERN))
    patches, grain = shader.noise(at, 70.0, 3.0), shader.noise(at, 900.0, 1.0)
    dark = shader.mix(shader.object_value(TONE), (0.050, 0.057, 0.068), (0.105, 0.112, 0.125))
    scale = shader.mix(shader.step(grain, 0.35, 0.75), dark, (0.20, 0.205, 0.215))
    rust = shader.mix(shader.step(grain, 0.35, 0.65), (0.060, 0.024, 0.012), (0.235, 0.088, 0.032))
    threshold = shader.add(patches, shader.remap(shader.object_value(RUST), 0.0, 1.0, -0.14, 0.14))
    rusty = shader.step(shader.add(threshold, shader.remap(grain, 0.0, 1.0, -0.06, 0.06)), 0.48, 0.60)
    return shader.surface(
        Base_Color=shader.mix(rusty, scale, rust),
        Metallic=shader.remap(rusty, 0.0, 1.0, 0.75, 0.05),
        Roughness=shader.add(shader.remap(rusty, 0.0, 1.0, 0.38, 0.78), shader.remap(grain, 0, 1, -0.08, 0.1)),
        Normal=shader.bump(grain, 0.25, 0.0002),
    )


def _wood(name: str) -> bpy.types.Material:
    """Oiled beech: grain along x."""
    shader = Shader(name)
    at = shader.position()
    figure = shader.noise(shader.stretched(at, (1.2, 14.0, 14.0)), 3.0)
    pores = shader.noise(shader.stretched(at, (10.0, 240.0, 240.0)), 2.0, 0.0)
    base = shader.mix(shader.step(figure, 0.3, 0.7), (0.30, 0.185, 0.100), (0.42, 0.28, 0.165))
    colour = shader.mix(shader.step(pores, 0.56, 0.75), base, (0.22, 0.13, 0.07))
    return shader.surface(Base_Color=colour, Roughness=0.48, Specular_IOR_Level=0.4)


def _concrete(name: str) -> bpy.types.Material:
    shader = Shader(name)
    at = shader.position()
    colour = shader.mix(shader.noise(at, 45.0, 3.0), (0.24, 0.235, 0.225), (0.46, 0.455, 0.44))
    return shader.surface(
        Base_Color=colour, Roughness=0.9, Normal=shader.bump(shader.noise(at, 400.0), 0.3, 0.0005)
    )


def _speckled(
    light: Colour, dark: Colour, per_metre: float, roughness: float
) -> Callable[[str], bpy.types.Material]:
    """Return a maker of two-tone speckled matter."""

    def make(name: str) -> bpy.types.Material:
        shader = Shader(name)
        share = shader.step(shader.noise(shader.position(), per_metre), 0.35, 0.65)
        return shader.surface(Base_Color=shader.mix(share, dark, light), Roughness=roughness)

    return make


def _plain(name: str) -> bpy.types.Material:
    colour, roughness = _PLAIN[name]
    return Shader(name).surface(Base_Color=colour, Roughness=roughness)


_PLAIN: dict[str, tuple[Colour, float]] = {
    "painted metal": ((0.42, 0.44, 0.45), 0.4),
    "cabinet": ((0.50, 0.52, 0.53), 0.45),
    "dark laminate": ((0.045, 0.047, 0.052), 0.4),
    "door": ((0.26, 0.31, 0.34), 0.5),
    "red paint": ((0.36, 0.035, 0.025), 0.35),
    "blue plastic": ((0.04, 0.10, 0.26), 0.45),
    "grey plastic": ((0.20, 0.21, 0.22), 0.5),
    "white glaze": ((0.66, 0.66, 0.64), 0.15),
    "sheet edge": ((0.70, 0.70, 0.68), 0.8),
}

_MAKERS: dict[str, Callable[[str], bpy.types.Material]] = {
    "steel": _steel,
    "wood": _wood,
    "concrete": _concrete,
    "plaster": _speckled((0.62, 0.61, 0.58), (0.56, 0.55, 0.53), 6.0, 0.95),
    "floor": _speckled((0.25, 0.26, 0.27), (0.17, 0.18, 0.19), 60.0, 0.5),
    "cork": _speckled((0.36, 0.22, 0.11), (0.20, 0.115, 0.055), 120.0, 0.9),
    "cardboard": _speckled((0.40, 0.27, 0.155), (0.34, 0.225, 0.125), 25.0, 0.85),
}
