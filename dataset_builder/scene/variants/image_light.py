"""Image-based lighting: the eight panoramas of the bpy wheel as variants of the light.

The files are ``datafiles/studiolights/world/*.exr`` of the wheel, 1024 x 512 pixels each. According to
``license.txt`` beside them they were made by Greg Zaal (Poly Haven) and are licensed as CC0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dataset_builder.config.specs import SceneSpec
from dataset_builder.scene.variants import LIGHT_SLOT, exclusive_variant


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
"""Digest and luminous irradiance of each panorama: that of a horizontal surface, in the units of the file."""
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
