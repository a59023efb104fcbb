"""Lights of the environments by light variant: sky, sun, panels and spots. World frame, metres.

Lights are not surfaces and have no depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dataset_builder.scene.model import Colour
from dataset_builder.scene.shapes.solids import Point
from dataset_builder.scene.variants.registry import SHADOWS, SUN_FROM


@dataclass(frozen=True)
class Sky:
    """Sky background: a vertical gradient from ``horizon`` to ``zenith``, uniform if they are equal."""

    horizon: Colour
    zenith: Colour
    strength: float
    clouds: bool = False


@dataclass(frozen=True)
class Panel:
    """A rectangular light of ``size_m`` at ``at_m``, facing ``towards_m`` (world, metres); ``energy`` in watts."""

    at_m: Point
    towards_m: Point
    size_m: tuple[float, float]
    energy: float
    colour: Colour


@dataclass(frozen=True)
class Sun:
    """A light at infinity: direction it comes from, angular diameter in degrees and strength (W / m2)."""

    from_direction: Point
    angle_deg: float
    energy: float
    colour: Colour


@dataclass(frozen=True)
class Spot:
    """A spot lamp at ``at_m``, facing ``towards_m`` (world, metres).

    ``radius_m`` is the radius of the lamp, ``cone_deg`` the full angle of its cone, ``energy`` its power in watts.
    """

    at_m: Point
    towards_m: Point
    radius_m: float
    cone_deg: float
    energy: float
    colour: Colour


@dataclass(frozen=True)
class LightRig:
    """The sky and the lamp of a scene; ``glow`` is that of surfaces which look like lamps, 1 if they are lit."""

    sky: Sky
    lamp: Panel | Sun | Spot
    glow: float = 0.0


WARM, WHITE = (1.0, 0.93, 0.85), (1.0, 0.98, 0.95)
EMBER = (1.0, 0.60, 0.30)


def _uniform_sky(colour: Colour, strength: float) -> Sky:
    """Return a sky of one colour."""
    return Sky(colour, colour, strength)


LABORATORY_LIGHT: Mapping[str | None, LightRig] = {
    None: LightRig(
        # One lamp and a bright sky, because a second lamp from the side increased the noise on steel.
        _uniform_sky((0.86, 0.93, 1.0), 0.80),
        Panel((-0.35, 0.45, 1.9), (0.0, 0.05, 0.0), (0.9, 0.45), 62.0, WARM),
    ),
    "dusk": LightRig(
        _uniform_sky((0.42, 0.55, 1.0), 0.13),
        Panel((-1.9, -0.9, 0.9), (0.0, 0.0, 0.05), (1.1, 0.5), 14.0, EMBER),
    ),
    "spotlight": LightRig(
        _uniform_sky((0.7, 0.8, 1.0), 0.05),
        Spot((-0.95, 0.10, 0.85), (0.0, 0.0, 0.03), 0.012, 62.0, 75.0, WHITE),
    ),
    "backlight": LightRig(
        _uniform_sky((0.86, 0.93, 1.0), 0.07),
        Panel((0.2, 2.0, 0.85), (0.0, 0.0, 0.05), (1.4, 0.6), 75.0, WHITE),
    ),
    SHADOWS: LightRig(_uniform_sky((0.80, 0.90, 1.0), 0.30), Sun(SUN_FROM, 0.5, 3.6, WARM)),
}
"""Lights of the laboratory by light variant; None is the default."""

_DAY = Sky((0.70, 0.82, 0.95), (0.17, 0.35, 0.74), 0.80, clouds=True)

OUTDOOR_LIGHT: Mapping[str | None, LightRig] = {
    None: LightRig(_DAY, Sun((-0.55, -0.45, 0.70), 1.2, 4.0, WARM)),
    "dusk": LightRig(
        Sky((0.95, 0.52, 0.30), (0.10, 0.16, 0.38), 0.28, clouds=False),
        Sun((-0.85, -0.45, 0.16), 6.0, 0.55, EMBER),
    ),
    "spotlight": LightRig(
        Sky((0.05, 0.07, 0.12), (0.015, 0.022, 0.05), 0.4),
        Spot((-14.0, -19.0, 10.5), (0.0, 0.0, 2.6), 0.25, 34.0, 26_000.0, WHITE),
    ),
    "backlight": LightRig(
        Sky((0.90, 0.84, 0.74), (0.34, 0.46, 0.66), 0.42),
        Sun((0.22, 0.90, 0.30), 0.6, 4.2, WARM),
    ),
    SHADOWS: LightRig(_DAY, Sun(SUN_FROM, 0.5, 3.8, WARM)),
}
"""Lights of the building site by light variant; None is the default."""

HALL_LIGHT: Mapping[str | None, LightRig] = {
    None: LightRig(
        _uniform_sky((0.86, 0.93, 1.0), 0.64),
        Panel((1.5, -1.0, 7.05), (1.5, -1.0, 0.0), (9.0, 1.6), 1350.0, WARM),
        glow=1.0,
    ),
    "dusk": LightRig(
        _uniform_sky((0.42, 0.55, 1.0), 0.17),
        Panel((-5.0, -10.2, 4.2), (0.0, 0.0, 0.8), (6.0, 2.0), 700.0, EMBER),
    ),
    "spotlight": LightRig(
        _uniform_sky((0.7, 0.8, 1.0), 0.06),
        Spot((-7.5, -6.5, 6.6), (0.0, 0.0, 0.7), 0.12, 50.0, 9000.0, WHITE),
    ),
    "backlight": LightRig(
        _uniform_sky((0.86, 0.93, 1.0), 0.09),
        Panel((2.0, 11.2, 2.9), (0.0, 0.0, 0.7), (5.5, 4.0), 2600.0, WHITE),
    ),
}
"""Lights of the hall by light variant; None is the default."""

DECK_LIGHT: Mapping[str | None, LightRig] = {name: rig for name, rig in OUTDOOR_LIGHT.items() if name != SHADOWS}
"""Lights of the deck by light variant; the screen of ``shadows`` would stand beside the deck, above the ground."""
