"""Cages of members of round section: main bars in rings or a spiral. The member's axis is z, from 0 up. Metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import DesignBar, InfeasibleError, Line, Z, straight
from dataset_builder.scene.cages.rectangular import LINK, MAIN
from dataset_builder.scene.cages.rules import (
    CONTACT_GAP_M,
    contact_m,
    inside_link_m,
    lap_m,
    least_clear_m,
    radius_m,
)
from dataset_builder.scene.shapes.links import helix_m, ring_m

SPIRAL, STIFFENER = "spiral", "stiffener"

_CLOSED_TURNS = 1.5
"""Closed turns at each end of a spiral (ACI 318-19, 25.7.3.4, from a secondary source)."""

_LEAST_BARS = 6
"""Least number of main bars, of which none is ever left out."""


@dataclass(frozen=True)
class RoundSection:
    """Round section: diameter of the concrete, cover of links, diameters of links and main bars, their count."""

    diameter_m: float
    cover_m: float
    link_m: float
    bar_m: float
    bars: int

    @property
    def concrete_m2(self) -> float:
        """Area of the concrete."""
        return float(np.pi / 4 * self.diameter_m**2)

    @property
    def link_radius_m(self) -> float:
        """Radius of the links' axes."""
        return self.diameter_m / 2 - self.cover_m - self.link_m / 2

    @property
    def bar_radius_m(self) -> float:
        """Radius of the circle of the main bars' axes."""
        return self.link_radius_m - inside_link_m(self.link_m, self.bar_m)

    def check(self, most_clear_m: float) -> None:
        """Raise ``InfeasibleError`` unless the clear distance of the bars is from the least one to this one."""
        between_m = 2 * self.bar_radius_m * np.sin(np.pi / self.bars) - self.bar_m
        if not least_clear_m(self.bar_m) <= between_m <= most_clear_m:
            raise InfeasibleError("bars of a round section are too close or too far apart")

    def outward(self) -> Float64[ndarray, "n 2"]:
        """Return the unit vectors (x, y) from the middle to the main bars."""
        angles = np.arange(self.bars) * 2 * np.pi / self.bars
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def main_bars(self, length_m: float) -> list[DesignBar]:
        """Return the straight main bars."""
        radius = self.bar_radius_m
        return [
            DesignBar(
                MAIN,
                self.bar_m,
                straight((radius * x, radius * y, 0.0), (radius * x, radius * y, length_m)),
                spaced_along=(-y, x, 0.0),
                is_structural=self.bars <= _LEAST_BARS,
            )
            for x, y in self.outward().tolist()
        ]

    def spiral(self, length_m: float, pitch_m: float) -> DesignBar:
        """Return one spiral, with ``_CLOSED_TURNS`` at each end."""
        closed_m = 2 * radius_m(self.link_m) + 3 * CONTACT_GAP_M
        turns = (length_m - 0.1 - 2 * _CLOSED_TURNS * closed_m) / pitch_m
        parts: list[Line] = []
        height_m, start_deg = 0.05, 0.0
        for rise_m, count in ((closed_m, _CLOSED_TURNS), (pitch_m, turns), (closed_m, _CLOSED_TURNS)):
            part_m = helix_m(self.link_radius_m, rise_m, count, start_deg) + _up(height_m)
            parts.append(part_m[1:] if parts else part_m)
            height_m, start_deg = float(part_m[-1, 2]), start_deg + 360.0 * count
        return DesignBar(SPIRAL, self.link_m, np.concatenate(parts))

    def rings(self, levels_m: Sequence[float]) -> list[DesignBar]:
        """Return lapped rings at these levels, each turned against the one below.

        Raises ``InfeasibleError`` if the lap is longer than half the ring.
        """
        if lap_m(self.link_m) > np.pi * self.link_radius_m:
            raise InfeasibleError("rings are too small for their laps")
        return [
            self._ring(LINK, self.link_m, self.link_radius_m, z_m, lap_m(self.link_m), 137.5 * n)
            for n, z_m in enumerate(levels_m)
        ]

    def stiffeners(self, levels_m: Sequence[float], ring_diameter_m: float) -> list[DesignBar]:
        """Return rings inside the main bars, which keep the cage round when it is lifted: welded laps of 10 d."""
        inside_m = self.bar_radius_m - contact_m(self.bar_m, ring_diameter_m)
        # The vertices of the ring's polygon lie outside of its circle.
        inside_m *= float(np.cos(np.deg2rad(2.5)))
        return [
            self._ring(STIFFENER, ring_diameter_m, inside_m, z_m, 10 * ring_diameter_m, 137.5 * n)
            for n, z_m in enumerate(levels_m)
        ]

    def _ring(
        self, role: str, bar_m: float, axis_radius_m: float, z_m: float, ring_lap_m: float, start_deg: float
    ) -> DesignBar:
        line_m = ring_m(axis_radius_m, radius_m(bar_m), ring_lap_m, start_deg)
        return DesignBar(role, bar_m, line_m + _up(z_m), Z, role != LINK)


def _up(z_m: float) -> Float64[ndarray, " 3"]:
    return np.array([0.0, 0.0, z_m])
