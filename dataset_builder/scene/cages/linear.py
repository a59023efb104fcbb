"""Parts of cages that members of any section have in common: levels of links, and laps of main bars. Metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dataset_builder.scene.cages.design import DesignBar, InfeasibleError, Line, bent, spaced, straight
from dataset_builder.scene.cages.rules import CRANK_SLOPE, contact_m, lap_m

STARTER = "starter"
_FREE_END_M = 0.05
"""Distance of the first and the last link from the ends of the main bars."""

_STRAIGHT_M = 0.02
"""Straight length of a cranked bar beyond its lap."""

_BESIDE_CRANK_M = 0.02
"""Distance of links from the ends of starters and of cranks."""


@dataclass(frozen=True)
class Lap:
    """Lap of upright bars with starters of the same diameter: the heights between which they lie side by side."""

    bar_m: float
    start_m: float

    @property
    def end_m(self) -> float:
        """Height of the ends of the starters."""
        return self.start_m + lap_m(self.bar_m)

    @property
    def crank_m(self) -> tuple[float, float]:
        """Heights of both ends of the cranks, between which the bars come to the places of the starters."""
        first_m = self.end_m + _STRAIGHT_M
        return first_m, first_m + contact_m(self.bar_m, self.bar_m) / CRANK_SLOPE

    def levels_m(self, first_m: float, last_m: float, spacing_m: float) -> tuple[list[float], list[float]]:
        """Return levels of bars in contact with the starters, and of those in contact with the bars above them.

        Raises ``InfeasibleError`` if the bars are too short for the lap.
        """
        low, high = self.end_m - _BESIDE_CRANK_M, self.crank_m[1] + _BESIDE_CRANK_M
        if high + 0.3 > last_m:
            raise InfeasibleError("the member is too short for laps")
        return spaced(first_m, low, spacing_m), spaced(high, last_m, spacing_m)


def link_levels_m(
    length_m: float, spacing_m: float, dense_m: float, dense_spacing_m: float, lap: Lap | None = None
) -> list[float]:
    """Return levels of links: ``dense_spacing_m`` apart along ``dense_m`` at both ends, else ``spacing_m``.

    They are dense along a lap as well. Raises ``InfeasibleError`` as ``Lap.levels_m``.
    """
    first, last = _FREE_END_M, length_m - _FREE_END_M
    if lap is not None:
        dense, above = lap.levels_m(first, last, dense_spacing_m)
        return [*dense, *_dense_at_last(above[0], last, spacing_m, dense_m, dense_spacing_m)]
    if last - first < 2 * dense_m + spacing_m:
        return spaced(first, last, dense_spacing_m)
    start = spaced(first, first + dense_m, dense_spacing_m)
    return [*start[:-1], *_dense_at_last(first + dense_m, last, spacing_m, dense_m, dense_spacing_m)]


def _dense_at_last(
    first_m: float, last_m: float, spacing_m: float, dense_m: float, dense_spacing_m: float
) -> list[float]:
    """Return levels that are ``dense_spacing_m`` apart along ``dense_m`` at the upper end."""
    if last_m - first_m < dense_m + spacing_m:
        return spaced(first_m, last_m, dense_spacing_m)
    middle = spaced(first_m, last_m - dense_m, spacing_m)
    return [*middle[:-1], *spaced(last_m - dense_m, last_m, dense_spacing_m)]


def lapped(bars: Sequence[DesignBar], inward: Sequence[tuple[float, float]], lap: Lap) -> list[DesignBar]:
    """Return each upright bar as one that laps with a starter.

    Starters are in the places of the bars, in the links. Each bar starts inside of its starter, in the direction
    ``inward`` (x, y), and is cranked above the lap, so that the links hold it from there on. Both stay in their
    places along the side, so that they remain tied to each other.
    """
    made = []
    for bar, (inward_x, inward_y) in zip(bars, inward, strict=True):
        foot, height_m, diameter_m = bar.line_m[0], float(bar.line_m[-1, 2]), bar.diameter_m
        starter_m = straight(foot, (*foot[:2], lap.end_m))
        inside = foot + contact_m(diameter_m, diameter_m) * np.array([inward_x, inward_y, 0.0])
        heights_m = zip((inside, inside, foot, foot), (lap.start_m, *lap.crank_m, height_m), strict=True)
        line_m: Line = bent([(*place[:2], z) for place, z in heights_m], diameter_m)
        made += [
            replace(bar, role=STARTER, line_m=starter_m, spaced_along=None),
            replace(bar, line_m=line_m, spaced_along=None),
        ]
    return made


def rise_m(bars: Sequence[DesignBar]) -> float:
    """Return half the height of the axis of the first of the links."""
    return float(np.ptp(bars[0].line_m[:, 2])) / 2
