"""Appearance variants of scenes: lighting, steel surface, props that occlude the steel, and the camera's sensor.

The names of the variants of a scene are in ``AppearanceSpec.variants``; the standard configs, like the scenes of
the paper, have none. Light, steel and sensor variants change only colour, apart from the screen that ``shadows``
adds. Props are surfaces of the scene mesh, so depth and masks account for them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dataset_builder.specs.config_specs import SceneSpec
from rebar_depth_bench.base.errors import InputError, Problem

LIGHT_SLOT, STEEL_SLOT, PROPS_SLOT, SENSOR_SLOT = "light", "steel", "things", "sensor"
EXCLUSIVE_SLOTS = (LIGHT_SLOT, STEEL_SLOT)
"""Slots that accept one variant at a time; variants of the props slot can be combined."""

SENSOR = "sensor"
SHADOWS = "shadows"
SUN_FROM = (-0.53, -0.36, 0.77)
"""Direction from the steel to the sun of ``shadows``, world axes; the slatted screen is in this direction."""
SCREEN_DISTANCE = 6.0
"""Distance of this screen from the centre of the steel, in half diagonals of the steel; cameras are nearer."""


@dataclass(frozen=True)
class Variant:
    """Appearance variant: name, description for users, and slot."""

    name: str
    description: str
    slot: str


_ALL = (
    Variant("dusk", "little light: a dim blue sky and a weak warm glow from one side", LIGHT_SLOT),
    Variant("spotlight", "one hard lamp in the dark, strong shadows", LIGHT_SLOT),
    Variant(
        "backlight", "a low strong light from the north (+y), so that views towards it see dark steel", LIGHT_SLOT
    ),
    Variant(
        SHADOWS, "hard sun through a slatted screen beyond the cameras: stripes of shadow on the steel", LIGHT_SLOT
    ),
    Variant("city", "light of a panorama: high-rise buildings under a hazy sun", LIGHT_SLOT),
    Variant(
        "courtyard", "light of a panorama: a courtyard between houses, a bright sky without a sun", LIGHT_SLOT
    ),
    Variant("forest", "light of a panorama: a garden under trees, with patches of bright sky", LIGHT_SLOT),
    Variant("interior", "light of a panorama: a hotel room with lamps and a window", LIGHT_SLOT),
    Variant("night", "light of a panorama: a park after dark, with lamps; exposed like the others", LIGHT_SLOT),
    Variant("studio", "light of a panorama: a photographer's studio with softboxes in the dark", LIGHT_SLOT),
    Variant("sunrise", "light of a panorama: a misty park under a low sun", LIGHT_SLOT),
    Variant("sunset", "light of a panorama: a promenade, bluish, with the sun at the horizon", LIGHT_SLOT),
    Variant("mill-scale", "fresh steel: smooth blue-grey scale, hardly any rust", STEEL_SLOT),
    Variant("rusted", "steel that stood outside for months: rust all over", STEEL_SLOT),
    Variant("wet", "steel after rain: darker, with a gloss", STEEL_SLOT),
    Variant(
        "clutter", "buckets, offcuts of timber, boxes, rolls of tape and tools round the steel's foot", PROPS_SLOT
    ),
    Variant(
        "formwork", "two plywood panels on two sides of the steel, which hide part of it from there", PROPS_SLOT
    ),
    Variant("spacers", "plastic wheel spacers round some of the outer bars", PROPS_SLOT),
    Variant("tie-wire", "black wire of 1.2 mm tied round some of the crossings of bars", PROPS_SLOT),
    Variant(
        SENSOR,
        "pictures of a camera at 18 dB gain: vignetting, noise, demosaicing and JPEG compression",
        SENSOR_SLOT,
    ),
)
VARIANTS: Mapping[str, Variant] = {variant.name: variant for variant in _ALL}


def check_variants(names: Iterable[str]) -> None:
    """Raise ``InputError`` for unknown and repeated names, and for several variants of an exclusive slot."""
    requested = tuple(names)
    unknown = [name for name in dict.fromkeys(requested) if name not in VARIANTS]
    problems = [
        Problem("unknown", repr(name), "no such variant", f"one of {', '.join(VARIANTS)}") for name in unknown
    ]
    repeated = [name for name in dict.fromkeys(requested) if requested.count(name) > 1]
    problems += [
        Problem("duplicate", repr(name), f"given {requested.count(name)} times", "once") for name in repeated
    ]
    for slot in EXCLUSIVE_SLOTS:
        conflicting = variants_of_slot(dict.fromkeys(requested), slot)
        if len(conflicting) > 1:
            found = f"{', '.join(conflicting)} all set the {slot}"
            problems.append(Problem("conflict", "", found, "one of them"))
    if problems:
        raise InputError.from_problems("appearance variants", problems)


def variants_of_slot(names: Iterable[str], slot: str) -> tuple[str, ...]:
    """Return the known variants of ``slot`` among ``names``, in the order of ``names``."""
    return tuple(name for name in names if name in VARIANTS and VARIANTS[name].slot == slot)


def exclusive_variant(names: Iterable[str], slot: str) -> str | None:
    """Return the variant of an exclusive slot among ``names``, or None.

    ``names`` must have passed ``check_variants``.
    """
    return next(iter(variants_of_slot(names, slot)), None)


@dataclass(frozen=True)
class ImageLight:
    """Light of a panorama: name and digest of its file, factor on its radiance, and turn.

    The middle column of the image is in the direction of +x, turned by ``turn_deg`` about z, counter-clockwise
    from above.
    """

    image: str
    sha256: str
    strength: float
    turn_deg: float


_IMAGES: Mapping[str, tuple[str, float]] = {
    "city": ("9e42abcd2fa3231e5c2485ca6dd64800534d157b7194ab7fe9cc3bf5a56d0256", 6.836),
    "courtyard": ("6690b47725965531559380121e6878373eb599655e35fefd109a4bd0911366f3", 2.124),
    "forest": ("bdf2298244affa0f85509380fd130ac6d4dfaa3c856df065998f7f4c1a93dc0d", 4.736),
    "interior": ("e945ff5c1ddd7a3aaf05e9fb5c3bc9cb93c5518414febd44ed2c394e013f0cbd", 5.633),
    "night": ("17480af5547465d160f7307c92585cf30820ca563f87f066395decbad8ac32a4", 0.499),
    "studio": ("c36c7fd390b2cdf8693360cf3662cb1d710c95fa799d9f822f42997167839b56", 1.517),
    "sunrise": ("6a1180126e4db7d01f134c5430ea43c1b263ab1a12faf58a444d9ce9c03f3a84", 1.662),
    "sunset": ("3bcafdda4f2d7b9759cc1d73004d34d721a274c29b1a0947be88a602dbac426b", 2.185),
}
"""Digest and luminous irradiance of each panorama: that of a horizontal surface, in the units of the file.

The files are ``datafiles/studiolights/world/*.exr`` of the bpy wheel, 1024 x 512 pixels each. According to
``license.txt`` beside them they were made by Greg Zaal (Poly Haven) and are licensed as CC0.
"""
IRRADIANCE = 5.0
"""Irradiance of a horizontal surface in every scene.

It was chosen so that the mean level of the pictures is about that of the standard light. Without a turn, four left
views of each scene at 320 x 180 differ from it by -7 to +3 levels (of 255) in the laboratory, and by -22 to +21 on
the building site, where the panorama is in the picture. ``python -m benchmarks.variants ROOT`` prints the levels
of a folder.
"""
IMAGE_LIGHTS = tuple(_IMAGES)
"""Names of the variants with the light of a panorama."""


def image_light(scene: SceneSpec) -> ImageLight | None:
    """Return the panorama that lights a scene, None for other lights; the scene's seed determines its turn."""
    name = exclusive_variant(scene.appearance.variants, LIGHT_SLOT)
    if name is None or name not in _IMAGES:
        return None
    sha256, irradiance = _IMAGES[name]
    random = np.random.default_rng([scene.seed, *b"image light"])
    return ImageLight(name, sha256, IRRADIANCE / irradiance, round(float(random.uniform(0.0, 360.0)), 3))
