"""The light of each place, as it is and in each light variant: plain tables of lamps and skies."""

from __future__ import annotations

from collections.abc import Mapping

from dataset_builder.appearance import SHADOWS, SUN_FROM
from dataset_builder.blender.lighting import LightRig, Panel, Sky, Spot, Sun
from dataset_builder.blender.nodes import Colour

WARM, COOL, WHITE = (1.0, 0.93, 0.85), (0.82, 0.91, 1.0), (1.0, 0.98, 0.95)
EMBER = (1.0, 0.60, 0.30)


def _even(colour: Colour, strength: float) -> Sky:
    return Sky(colour, colour, strength)


LABORATORY_LIGHT: Mapping[str | None, LightRig] = {
    None: LightRig(
        # One lamp and a bright sky: a second lamp from the side made steel noisier.
        _even((0.86, 0.93, 1.0), 0.80),
        (Panel("ceiling-panel", (-0.35, 0.45, 1.9), (0.0, 0.05, 0.0), (0.9, 0.45), 62.0, WARM),),
    ),
    "dusk": LightRig(
        _even((0.42, 0.55, 1.0), 0.13),
        (Panel("window", (-1.9, -0.9, 0.9), (0.0, 0.0, 0.05), (1.1, 0.5), 14.0, EMBER),),
    ),
    "spotlight": LightRig(
        _even((0.7, 0.8, 1.0), 0.05),
        (Spot((-0.95, 0.10, 0.85), (0.0, 0.0, 0.03), 0.012, 62.0, 75.0, WHITE),),
    ),
    "backlight": LightRig(
        _even((0.86, 0.93, 1.0), 0.07),
        (Panel("low-window", (0.2, 2.0, 0.85), (0.0, 0.0, 0.05), (1.4, 0.6), 75.0, WHITE),),
    ),
    SHADOWS: LightRig(_even((0.80, 0.90, 1.0), 0.30), (Sun(SUN_FROM, 0.5, 3.6, WARM),)),
}

_DAY = Sky((0.70, 0.82, 0.95), (0.17, 0.35, 0.74), 0.80, clouds=True)

OUTDOOR_LIGHT: Mapping[str | None, LightRig] = {
    None: LightRig(_DAY, (Sun((-0.55, -0.45, 0.70), 1.2, 4.0, WARM),)),
    "dusk": LightRig(
        Sky((0.95, 0.52, 0.30), (0.10, 0.16, 0.38), 0.28, clouds=False),
        (Sun((-0.85, -0.45, 0.16), 6.0, 0.55, EMBER),),
    ),
    "spotlight": LightRig(
        Sky((0.05, 0.07, 0.12), (0.015, 0.022, 0.05), 0.4),
        (Spot((-14.0, -19.0, 10.5), (0.0, 0.0, 2.6), 0.25, 34.0, 26_000.0, WHITE),),
    ),
    "backlight": LightRig(
        Sky((0.90, 0.84, 0.74), (0.34, 0.46, 0.66), 0.42),
        (Sun((0.22, 0.90, 0.30), 0.6, 4.2, WARM),),
    ),
    SHADOWS: LightRig(_DAY, (Sun(SUN_FROM, 0.5, 3.8, WARM),)),
}
