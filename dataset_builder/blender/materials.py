"""Materials of the scene's surfaces: colour and gloss only, without displacement or bump mapping."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import bpy
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from dataset_builder.blender.render import set_pixels
from dataset_builder.blender.shader_nodes import MaterialBuilder
from dataset_builder.scene.model import STEEL, Colour

RUST_PROPERTY, PATTERN_PROPERTY, TONE_PROPERTY = "rust_amount", "pattern_shift_m", "scale_tone"
"""Names of the custom properties of a steel object that its material reads."""

GLOW_PROPERTY = "glow"
"""Name of the custom property of an object with the material ``LAMP``: 1 if it is lit, 0 if not."""
LAMP = "lamp"
"""Name of the material of lamps, which are lit or not."""


def steel_material_name(variant: str | None) -> str:
    """Return the name of the material of steel with a steel variant, or without one."""
    return STEEL if variant is None else f"{STEEL}, {variant}"


def surface_variation(seed: int, bar_id: int) -> dict[str, float]:
    """Return random values of a bar's custom properties, determined by ``seed`` and ``bar_id``.

    They are the amount of rust (0 to 1), the shift of the pattern (0 to 10 m) and the tone of the mill scale
    (0 to 1).
    """
    random = np.random.default_rng([seed, bar_id])
    return {
        RUST_PROPERTY: float(random.beta(1.6, 2.2)),
        PATTERN_PROPERTY: float(random.uniform(0.0, 10.0)),
        TONE_PROPERTY: float(random.uniform(0.0, 1.0)),
    }


def material(name: str) -> bpy.types.Material:
    """Return the material ``name`` of the open file, created on first use."""
    blender_material = bpy.data.materials.get(name)
    if blender_material is None:
        blender_material = _MATERIAL_BUILDERS[name](MaterialBuilder(name))
    return blender_material


def paper(texture: UInt8[ndarray, "h w"]) -> bpy.types.Material:
    """Return matt paper printed with ``texture`` (row 0 at the top, 0 is black)."""
    shader = MaterialBuilder("paper")
    image = _image("board", texture)
    printed = shader.node("ShaderNodeTexImage", {"Vector": shader.uv()}, image=image, extension="EXTEND")
    # The reflectances of ink and paper are those of a realistic print.
    colour = shader.mix(printed.outputs["Color"], (0.018, 0.018, 0.02), (0.74, 0.735, 0.71))
    return shader.matt(colour)


def _image(name: str, texture: UInt8[ndarray, "h w"]) -> bpy.types.Image:
    """Return a grey texture as a packed Blender image."""
    height, width = texture.shape
    image = bpy.data.images.new(name, width, height)
    # The values are mixing factors and not light, so no transfer curve applies.
    image.colorspace_settings.name = "Non-Color"
    set_pixels(image, texture[..., None].astype(np.float32) / np.float32(255))
    image.pack()
    return image


def _steel(
    shader: MaterialBuilder,
    *,
    rust_shift: tuple[float, float] = (-0.15, 0.12),
    tint: float = 1.0,
    metallic: float = 0.40,
    roughness: tuple[float, float] = (0.50, 0.74),
) -> bpy.types.Material:
    """Return blue-grey mill scale with patches of rust.

    Amount, pattern and tone are read from each bar's custom properties. ``rust_shift`` are the offsets of the rust
    threshold for the amounts 0 and 1, ``roughness`` the values for scale and rust; ``tint`` multiplies both
    colours.
    """

    def tinted(red: float, green: float, blue: float) -> Colour:
        return red * tint, green * tint, blue * tint

    pattern_point = shader.shifted(shader.position(), shader.object_value(PATTERN_PROPERTY))
    patches, grain = shader.noise(pattern_point, 70.0, 3.0), shader.noise(pattern_point, 700.0, 1.0)
    dark = shader.mix(shader.object_value(TONE_PROPERTY), tinted(0.105, 0.118, 0.140), tinted(0.190, 0.200, 0.218))
    scale = shader.mix(shader.step(grain, 0.25, 0.85), dark, tinted(0.255, 0.262, 0.275))
    rust = shader.mix(shader.step(grain, 0.3, 0.7), tinted(0.095, 0.042, 0.022), tinted(0.250, 0.105, 0.045))
    threshold = shader.add(patches, shader.remap(shader.object_value(RUST_PROPERTY), 0.0, 1.0, *rust_shift))
    rusty = shader.step(shader.add(threshold, shader.remap(grain, 0.0, 1.0, -0.05, 0.05)), 0.46, 0.62)
    gloss = shader.add(shader.remap(rusty, 0.0, 1.0, *roughness), shader.remap(grain, 0, 1, -0.06, 0.08))
    return shader.surface(
        Base_Color=shader.mix(rusty, scale, rust),
        Metallic=shader.remap(rusty, 0.0, 1.0, metallic, 0.05),
        Roughness=gloss,
    )


def _wood(shader: MaterialBuilder) -> bpy.types.Material:
    """Return oiled beech with the grain along x."""
    pattern_point = shader.position()
    figure = shader.noise(shader.stretched(pattern_point, (1.0, 12.0, 12.0)), 4.0)
    pores = shader.noise(shader.stretched(pattern_point, (22.0, 330.0, 330.0)), 2.0, 0.0)
    base = shader.mix(shader.step(figure, 0.3, 0.7), (0.31, 0.195, 0.108), (0.40, 0.265, 0.155))
    return shader.matt(shader.mix(shader.step(pores, 0.55, 0.85), base, (0.25, 0.15, 0.083)))


def _speckled(light: Colour, dark: Colour, per_metre: float, shader: MaterialBuilder) -> bpy.types.Material:
    """Return a matt, speckled material of two colours."""
    share = shader.step(shader.noise(shader.position(), per_metre), 0.35, 0.65)
    return shader.matt(shader.mix(share, dark, light))


def _mottled(
    light: Colour,
    dark: Colour,
    per_metre: float,
    stains_per_metre: float,
    stain: Colour,
    shader: MaterialBuilder,
) -> bpy.types.Material:
    """Return a matt ground material: grain of two colours under large stains."""
    pattern_point = shader.position()
    grain = shader.mix(shader.step(shader.noise(pattern_point, per_metre, 1.0), 0.3, 0.7), dark, light)
    stains = shader.step(shader.noise(pattern_point, stains_per_metre, 2.0), 0.42, 0.72)
    return shader.matt(shader.mix(stains, grain, stain))


def _grained(
    light: Colour, dark: Colour, scale: tuple[float, float, float], shader: MaterialBuilder
) -> bpy.types.Material:
    """Return sawn wood; ``scale`` is the number of features per metre along x, y and z."""
    grain = shader.noise(shader.stretched(shader.position(), scale), 1.0)
    return shader.matt(shader.mix(shader.step(grain, 0.25, 0.75), dark, light))


def _anchored(
    light: Colour, dark: Colour, axes: tuple[float, float, float], shader: MaterialBuilder
) -> bpy.types.Material:
    """Return worn concrete with anchor holes in steel sleeves, one per square metre.

    ``axes`` are 1 along the axes of its plane, and 0 along the other.
    """
    point = shader.position()
    wear = shader.step(shader.noise(point, 1.1, 4.0), 0.35, 0.75)
    paint = shader.mix(shader.step(shader.noise(point, 45.0), 0.3, 0.7), dark, light)
    worn = shader.mix(wear, paint, dark)
    distance_m = shader.length(shader.stretched(shader.wrapped(point, 1.0), axes))
    sleeve = shader.mix(shader.step(distance_m, 0.060, 0.064), (0.065, 0.065, 0.065), worn)
    return shader.matt(shader.mix(shader.step(distance_m, 0.036, 0.040), (0.012, 0.012, 0.012), sleeve))


def _panel(colour: Colour, shader: MaterialBuilder) -> bpy.types.Material:
    """Return plywood of formwork with the grain along x, and stains of cement."""
    point = shader.position()
    dark = (0.80 * colour[0], 0.77 * colour[1], 0.72 * colour[2])
    grain = shader.noise(shader.stretched(point, (1.3, 22.0, 22.0)), 1.0, 3.0)
    wood = shader.mix(shader.step(grain, 0.25, 0.75), dark, colour)
    stains = shader.step(shader.noise(point, 2.3, 4.0), 0.50, 0.80)
    return shader.matt(shader.mix(stains, wood, (0.42, 0.37, 0.29)))


def _lamp(shader: MaterialBuilder) -> bpy.types.Material:
    """Return white glass that emits light where the object's ``GLOW_PROPERTY`` is not 0."""
    return shader.glowing((0.80, 0.79, 0.76), shader.product(shader.object_value(GLOW_PROPERTY), 4.0))


def _matt(colour: Colour, shader: MaterialBuilder) -> bpy.types.Material:
    """Return a matt material of one colour."""
    return shader.matt(colour)


def _glossy(colour: Colour, roughness: float, shader: MaterialBuilder) -> bpy.types.Material:
    """Return a Principled material of one colour."""
    return shader.surface(Base_Color=colour, Roughness=roughness)


_MATERIAL_BUILDERS: dict[str, Callable[[MaterialBuilder], bpy.types.Material]] = {
    STEEL: _steel,
    "steel, mill-scale": partial(
        _steel, rust_shift=(-0.45, -0.16), tint=1.15, metallic=0.8, roughness=(0.30, 0.60)
    ),
    "steel, rusted": partial(_steel, rust_shift=(0.10, 0.30), tint=1.15),
    "steel, wet": partial(_steel, tint=0.48, metallic=0.45, roughness=(0.13, 0.17)),
    "wood": _wood,
    "concrete": partial(_speckled, (0.40, 0.40, 0.39), (0.335, 0.335, 0.325), 60.0),
    "plaster": partial(_speckled, (0.63, 0.62, 0.59), (0.585, 0.575, 0.55), 5.0),
    "floor": partial(_speckled, (0.25, 0.26, 0.27), (0.17, 0.18, 0.19), 60.0),
    "cork": partial(_speckled, (0.36, 0.22, 0.11), (0.20, 0.115, 0.055), 120.0),
    "cardboard": partial(_speckled, (0.40, 0.27, 0.155), (0.34, 0.225, 0.125), 25.0),
    "painted metal": partial(_matt, (0.42, 0.44, 0.45)),
    "cabinet": partial(_matt, (0.50, 0.52, 0.53)),
    "dark laminate": partial(_matt, (0.045, 0.047, 0.052)),
    "door": partial(_matt, (0.26, 0.31, 0.34)),
    "blue plastic": partial(_matt, (0.05, 0.11, 0.26)),
    "grey plastic": partial(_matt, (0.20, 0.21, 0.22)),
    "sheet edge": partial(_matt, (0.70, 0.70, 0.68)),
    "red paint": partial(_glossy, (0.33, 0.045, 0.035), 0.35),
    "white glaze": partial(_glossy, (0.66, 0.66, 0.64), 0.15),
    "plywood": partial(_grained, (0.52, 0.34, 0.17), (0.40, 0.25, 0.12), (9.0, 9.0, 1.6)),
    "timber": partial(_grained, (0.56, 0.41, 0.23), (0.42, 0.28, 0.14), (14.0, 14.0, 14.0)),
    "orange plastic": partial(_matt, (0.62, 0.17, 0.02)),
    "black rubber": partial(_matt, (0.022, 0.022, 0.024)),
    "black wire": partial(_glossy, (0.03, 0.03, 0.033), 0.45),
    "site concrete": partial(_mottled, (0.44, 0.43, 0.41), (0.36, 0.355, 0.34), 26.0, 0.7, (0.31, 0.30, 0.28)),
    "blinding": partial(_matt, (0.47, 0.46, 0.44)),
    "gravel": partial(_mottled, (0.42, 0.36, 0.28), (0.25, 0.21, 0.165), 14.0, 0.11, (0.29, 0.235, 0.172)),
    "soil": partial(_mottled, (0.26, 0.175, 0.105), (0.15, 0.10, 0.062), 3.5, 0.5, (0.21, 0.15, 0.09)),
    "trees": partial(_mottled, (0.085, 0.115, 0.045), (0.03, 0.05, 0.022), 0.9, 0.12, (0.055, 0.07, 0.03)),
    "container blue": partial(_matt, (0.045, 0.13, 0.26)),
    "container sand": partial(_matt, (0.45, 0.37, 0.24)),
    "hoarding white": partial(_matt, (0.66, 0.66, 0.64)),
    "hoarding blue": partial(_matt, (0.06, 0.17, 0.42)),
    LAMP: _lamp,
    "strong floor": partial(_anchored, (0.125, 0.15, 0.143), (0.09, 0.108, 0.103), (1.0, 1.0, 0.0)),
    "reaction wall": partial(_anchored, (0.43, 0.43, 0.42), (0.36, 0.36, 0.35), (0.0, 1.0, 1.0)),
    "cast wall": partial(_anchored, (0.44, 0.43, 0.41), (0.36, 0.355, 0.34), (0.0, 1.0, 1.0)),
    "cladding": partial(_mottled, (0.42, 0.43, 0.425), (0.39, 0.40, 0.395), 1.5, 0.25, (0.36, 0.37, 0.37)),
    "window": partial(_matt, (0.52, 0.64, 0.72)),
    "gate": partial(_matt, (0.16, 0.27, 0.38)),
    "yellow paint": partial(_matt, (0.66, 0.44, 0.03)),
    "deck panel, fresh": partial(_panel, (0.60, 0.42, 0.17)),
    "deck panel, used": partial(_panel, (0.53, 0.37, 0.17)),
    "deck panel, worn": partial(_panel, (0.47, 0.345, 0.19)),
    "glued timber": partial(_grained, (0.47, 0.32, 0.165), (0.38, 0.25, 0.125), (18.0, 0.7, 18.0)),
    "yellow timber": partial(_grained, (0.64, 0.46, 0.09), (0.54, 0.37, 0.07), (2.0, 30.0, 30.0)),
    "hills": partial(_mottled, (0.115, 0.155, 0.075), (0.055, 0.085, 0.045), 0.35, 0.05, (0.09, 0.125, 0.07)),
}
