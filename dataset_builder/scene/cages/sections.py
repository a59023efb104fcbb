"""Cages of members of rectangular and round section, main bars in links; the axis is z, from 0 up. Metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import DesignBar, InfeasibleError, Line, X, Y, Z, steel_share, straight
from dataset_builder.scene.cages.rules import (
    COLUMN_STEEL,
    CONTACT_GAP_M,
    MOST_UNHELD_M,
    area_m2,
    contact_m,
    hook_end_m,
    inside_link_m,
    lap_m,
    least_clear_m,
    link_bend_m,
)
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.links import HOOK_DEG, helix_m, ring_m, stirrup_centreline_m, tie_centreline_m

MAIN, LINK, TIE = "main", "link", "tie"
"""Roles of bars."""

CORNERS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
"""Signs of x and y with which successive links are turned, so that their hooks alternate between the corners.

The first two turn the hooks to the corners at +y.
"""


@dataclass(frozen=True)
class Section:
    """Rectangular section: sides of the concrete (x, y), cover of the links, diameters of links and main bars.

    ``bars_x`` and ``bars_y`` are the numbers of bars along a side in each direction, corners included.
    """

    side_x_m: float
    side_y_m: float
    cover_m: float
    link_m: float
    bar_m: float
    bars_x: int
    bars_y: int

    @property
    def link_half_m(self) -> tuple[float, float]:
        """Half of the distances between the axes of opposite legs of a link."""
        around_m = self.cover_m + self.link_m / 2
        return self.side_x_m / 2 - around_m, self.side_y_m / 2 - around_m

    @property
    def bend_m(self) -> float:
        """Axis radius of the bends of a link."""
        return link_bend_m(self.link_m, self.bar_m)

    @property
    def count(self) -> int:
        """Number of main bars."""
        return 2 * (self.bars_x + self.bars_y) - 4

    def corner_inset_m(self, bar_m: float) -> float:
        """Return the distance of a corner bar from the axes of both legs of a link, where the bend holds it."""
        return self.bend_m - (self.bend_m - inside_link_m(self.link_m, bar_m)) / 2**0.5

    def half_m(self, bar_m: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the distances (x, y) from the middle of bars in the corners, and of bars along the sides."""
        corner_m, face_m = self.corner_inset_m(bar_m), inside_link_m(self.link_m, bar_m)
        x, y = self.link_half_m
        return (x - corner_m, y - corner_m), (x - face_m, y - face_m)

    def check(self) -> None:
        """Raise ``InfeasibleError`` unless parallel bars have the least clear distance."""
        if min(self.bars_x, self.bars_y) < 2:
            raise InfeasibleError("fewer than two bars along a side")
        for half_m, count in zip(self.half_m(self.bar_m)[0], (self.bars_x, self.bars_y), strict=True):
            if 2 * half_m / (count - 1) - self.bar_m < least_clear_m(self.bar_m):
                raise InfeasibleError("bars along a side are too close to each other")

    def column_steel_share(self, bars: int) -> float:
        """Return the area of ``bars`` main bars per area of concrete. Raises as ``steel_share`` for a column."""
        return steel_share(area_m2(self.bar_m, bars), self.side_x_m * self.side_y_m, COLUMN_STEEL)

    def along_m(self) -> tuple[list[float], list[float]]:
        """Return the positions along x and along y of the bars between the corners."""
        corner_x, corner_y = self.half_m(self.bar_m)[0]
        along_x = np.linspace(-corner_x, corner_x, self.bars_x)[1:-1].tolist()
        return along_x, np.linspace(-corner_y, corner_y, self.bars_y)[1:-1].tolist()

    def places_m(self) -> list[tuple[float, float]]:
        """Return the positions (x, y) of the main bars: corners first, then those along the sides."""
        (corner_x, corner_y), (face_x, face_y) = self.half_m(self.bar_m)
        along_x, along_y = self.along_m()
        return [
            *((sx * corner_x, sy * corner_y) for sx, sy in CORNERS),
            *((x, sign * face_y) for x in along_x for sign in (1, -1)),
            *((sign * face_x, y) for y in along_y for sign in (1, -1)),
        ]

    def inward(self) -> list[tuple[float, float]]:
        """Return the unit vectors (x, y) from the link to the inside at each of the ``places_m``."""
        along_x, along_y = self.along_m()
        return [
            *((-sx / 2**0.5, -sy / 2**0.5) for sx, sy in CORNERS),
            *((0.0, -float(sign)) for _ in along_x for sign in (1, -1)),
            *((-float(sign), 0.0) for _ in along_y for sign in (1, -1)),
        ]

    def needs_ties(self) -> bool:
        """Return True if bars along a side are too far from the corners to be held by the links."""
        places = np.array(self.places_m())
        apart_m = np.linalg.norm(places[:, None] - places[None, :4], axis=2)
        return bool(apart_m.min(axis=1).max() > MOST_UNHELD_M)


def main_bars(section: Section, length_m: float) -> list[DesignBar]:
    """Return the straight main bars of a section; the first four are those of the corners."""
    return [
        DesignBar(
            MAIN,
            section.bar_m,
            straight((x, y, 0.0), (x, y, length_m)),
            None if index < 4 else X if inward_x == 0 else Y,
            index < 4,
        )
        for index, ((x, y), (inward_x, _)) in enumerate(zip(section.places_m(), section.inward(), strict=True))
    ]


def bundled(bars: Sequence[DesignBar], section: Section) -> list[DesignBar]:
    """Return the bars with a second one inside of each corner bar (EN 1992-1-1, 8.9: bundles of two).

    Raises ``InfeasibleError`` if other bars are nearer than the diameter of one bar with the area of both.
    """
    equivalent_m = 2**0.5 * section.bar_m
    twins = []
    for bar, (inward_x, inward_y) in zip(bars[:4], section.inward(), strict=False):
        shift_m = contact_m(section.bar_m, section.bar_m) * np.array([inward_x, inward_y, 0.0])
        line_m = bar.line_m + shift_m
        others_m = [other.line_m[0] for other in bars if other is not bar]
        clear_m = min(float(np.linalg.norm(line_m[0] - other_m)) for other_m in others_m) - section.bar_m
        if clear_m < least_clear_m(equivalent_m) or equivalent_m > 0.055:
            raise InfeasibleError("a bundle is too close to other bars")
        twins.append(DesignBar(bar.role, bar.diameter_m, line_m))
    return [*bars, *twins]


def stirrups(section: Section, levels_m: Sequence[float], corners: int = 4) -> list[DesignBar]:
    """Return closed links at these levels, whose hooks alternate between the first ``corners`` of ``CORNERS``.

    Raises ``InfeasibleError`` if the section has no room for the hooks.
    """
    size = (section.side_x_m - 2 * section.cover_m, section.side_y_m - 2 * section.cover_m)
    try:
        line_m = stirrup_centreline_m(
            size, section.link_m, outer_radius_m(section.link_m), section.bend_m, hook_end_m(section.link_m)
        )
    except ValueError:
        raise InfeasibleError("a link has no room for its hooks") from None
    centre = np.array([(line_m[:, axis].min() + line_m[:, axis].max()) / 2 for axis in (0, 1)])
    line_m[:, :2] -= centre  # The centroid of a link is not the middle of its legs.
    return [
        DesignBar(
            LINK,
            section.link_m,
            line_m * np.array([*CORNERS[n % corners], 1.0]) + np.array([0.0, 0.0, z_m]),
            Z,
            False,
        )
        for n, z_m in enumerate(levels_m)
    ]


def ties(section: Section, levels_m: Sequence[float], link_rise_m: float) -> list[DesignBar]:
    """Return ties between opposite bars along the sides, on top of the links at these levels.

    ``link_rise_m`` is half the height that the axis of a link takes. Ties along x lie on those along y; the
    straight ends of both hooks of a tie point to one side, which alternates.
    """
    face_x, face_y = section.half_m(section.bar_m)[1]
    along_x, along_y = section.along_m()
    step_m = contact_m(section.link_m, section.link_m)
    above_m = link_rise_m + step_m
    line_x_m, line_y_m = (held_tie_m(face_m, section.link_m, section.bar_m) for face_m in (face_x, face_y))
    made = []
    for n, z_m in enumerate(levels_m):
        side = np.array([1.0, (-1.0) ** n, 1.0])
        for x in along_x:
            line_m = (line_y_m * side)[:, [1, 0, 2]]
            made.append(DesignBar(TIE, section.link_m, line_m + np.array([x, 0.0, z_m + above_m]), Z, False))
        for y in along_y:
            line_m = line_x_m * side
            height_m = z_m + above_m + (step_m if along_x else 0.0)
            made.append(DesignBar(TIE, section.link_m, line_m + np.array([0.0, y, height_m]), Z, False))
    return made


def links_height_m(section: Section, link_rise_m: float, *, with_ties: bool) -> tuple[float, float]:
    """Return how far the steel of a link and of the ties on it reaches below and above the level of the link."""
    layers = sum(map(bool, section.along_m())) if with_ties else 0
    below_m = link_rise_m + outer_radius_m(section.link_m)
    return below_m, below_m + layers * contact_m(section.link_m, section.link_m)


def held_tie_m(half_m: float, tie_m: float, bar_m: float) -> Line:
    """Return a tie along x whose hooks of 135 degrees hold two bars at x = -/+ ``half_m``, y = 0."""
    bend_m = link_bend_m(tie_m, bar_m)
    middle_m = half_m - bend_m + inside_link_m(tie_m, bar_m)
    return tie_centreline_m(middle_m, bend_m, hook_end_m(tie_m), HOOK_DEG)


SPIRAL, STIFFENER = "spiral", "stiffener"

_CLOSED_TURNS = 1.5
"""Closed turns at each end of a spiral (ACI 318-19, 25.7.3.4, from a secondary source)."""

_LEAST_BARS, _MOST_BARS = 6, 18
"""Least number of main bars, of which none is ever left out (EN 1992-1-1, 9.8.5 (3)), and largest number."""


@dataclass(frozen=True)
class RoundSection:
    """Round section: diameter of the concrete, cover of links, diameters of links and main bars, their count."""

    diameter_m: float
    cover_m: float
    link_m: float
    bar_m: float
    bars: int = _LEAST_BARS

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

    def counts(self, least_m: float, most_m: float) -> list[int]:
        """Return the numbers of main bars that are ``least_m`` apart or more, and along the circle ``most_m``."""
        across_m, counts = 2 * self.bar_radius_m, range(_LEAST_BARS, _MOST_BARS + 1)
        clear_m = [
            (n, across_m * np.sin(np.pi / n) - self.bar_m, np.pi * across_m / n - self.bar_m) for n in counts
        ]
        return [count for count, chord_m, arc_m in clear_m if chord_m >= least_m and arc_m <= most_m]

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
        closed_m = 2 * outer_radius_m(self.link_m) + 3 * CONTACT_GAP_M
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
        line_m = ring_m(axis_radius_m, outer_radius_m(bar_m), ring_lap_m, start_deg)
        return DesignBar(role, bar_m, line_m + _up(z_m), Z, role != LINK)


def _up(z_m: float) -> Float64[ndarray, " 3"]:
    return np.array([0.0, 0.0, z_m])
