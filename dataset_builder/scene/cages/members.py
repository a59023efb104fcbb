"""Cages of linear members: longitudinal bars in rectangular or round links. The member's axis is z, from 0 up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import DesignBar, InfeasibleError, Line, Z, spaced, straight
from dataset_builder.scene.cages.rules import (
    CONTACT_GAP_M,
    contact_m,
    hook_end_m,
    inside_link_m,
    lap_m,
    least_clear_m,
    link_bend_m,
    radius_m,
)
from dataset_builder.scene.shapes.links import helix_m, ring_m, stirrup_centreline_m, tie_centreline_m

MAIN, LINK, TIE, SPIRAL, STIFFENER, SIDE = "main", "link", "tie", "spiral", "stiffener", "side"
"""Roles of bars of members."""

_MIRRORS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
"""Signs of x and y with which successive links are turned, so that their hooks alternate between the corners."""


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
    def corner_inset_m(self) -> float:
        """Distance of a corner bar from the axes of both legs of a link, so that the bar is held by the bend."""
        return self.bend_m - (self.bend_m - inside_link_m(self.link_m, self.bar_m)) / 2**0.5

    def check(self) -> None:
        """Raise ``InfeasibleError`` unless parallel bars have the least clear distance."""
        if min(self.bars_x, self.bars_y) < 2:
            raise InfeasibleError("fewer than two bars along a side")
        for half_m, count in zip(self.link_half_m, (self.bars_x, self.bars_y), strict=True):
            between_m = 2 * (half_m - self.corner_inset_m) / (count - 1) - self.bar_m
            if between_m < least_clear_m(self.bar_m):
                raise InfeasibleError("bars along a side are too close to each other")

    def bar_positions_m(self) -> list[tuple[float, float]]:
        """Return the positions (x, y) of the main bars: corners first, then those along the sides."""
        half_x, half_y = self.link_half_m
        corner_x, corner_y = half_x - self.corner_inset_m, half_y - self.corner_inset_m
        face_x, face_y = (half - inside_link_m(self.link_m, self.bar_m) for half in (half_x, half_y))
        corners = [(sx * corner_x, sy * corner_y) for sx, sy in _MIRRORS]
        along_x = np.linspace(-corner_x, corner_x, self.bars_x)[1:-1].tolist()
        along_y = np.linspace(-corner_y, corner_y, self.bars_y)[1:-1].tolist()
        return [
            *corners,
            *((x, sign * face_y) for x in along_x for sign in (1, -1)),
            *((sign * face_x, y) for y in along_y for sign in (1, -1)),
        ]


def main_bars(section: Section, length_m: float, role: str = MAIN) -> list[DesignBar]:
    """Return the straight main bars of a section; the first four are those of the corners."""
    return [
        DesignBar(role, section.bar_m, straight((x, y, 0.0), (x, y, length_m)), is_structural=index < 4)
        for index, (x, y) in enumerate(section.bar_positions_m())
    ]


def lapped(bars: Sequence[DesignBar], at_m: float) -> list[DesignBar]:
    """Return each vertical bar as two that lap from ``at_m``, the upper one beside the lower, towards the middle.

    Raises ``InfeasibleError`` if the bars are too short for that.
    """
    parts = []
    for bar in bars:
        low, high = bar.line_m[0], bar.line_m[-1]
        top_m = at_m + lap_m(bar.diameter_m)
        if top_m > high[2] - lap_m(bar.diameter_m):
            raise InfeasibleError("the member is too short for laps")
        inward = -low[:2] / np.linalg.norm(low[:2])
        beside = low[:2] + contact_m(bar.diameter_m, bar.diameter_m) * inward
        lines = straight(low, (*low[:2], top_m)), straight((*beside, at_m), (*beside, high[2]))
        parts += [DesignBar(bar.role, bar.diameter_m, line, is_structural=bar.is_structural) for line in lines]
    return parts


def bundled(bars: Sequence[DesignBar], section: Section) -> list[DesignBar]:
    """Return the bars with a second one beside each corner bar, along x (EN 1992-1-1, 8.9: bundles of two)."""
    twins = []
    for bar in bars[:4]:
        shift_m = -np.sign(bar.line_m[0, 0]) * contact_m(section.bar_m, section.bar_m)
        twins.append(DesignBar(bar.role, bar.diameter_m, bar.line_m + np.array([shift_m, 0.0, 0.0])))
    return [*bars, *twins]


def stirrups(section: Section, levels_m: Sequence[float]) -> list[DesignBar]:
    """Return closed links at these levels, whose hooks alternate between the corners.

    Raises ``InfeasibleError`` if the section has no room for the hooks.
    """
    size = (section.side_x_m - 2 * section.cover_m, section.side_y_m - 2 * section.cover_m)
    try:
        line_m = stirrup_centreline_m(
            size, section.link_m, radius_m(section.link_m), section.bend_m, hook_end_m(section.link_m)
        )
    except ValueError:
        raise InfeasibleError("a link has no room for its hooks") from None
    centre = np.array([(line_m[:, axis].min() + line_m[:, axis].max()) / 2 for axis in (0, 1)])
    line_m[:, :2] -= centre  # The centroid of a link is not the middle of its legs.
    return [
        DesignBar(LINK, section.link_m, line_m * np.array([*_MIRRORS[n % 4], 1.0]) + _up(z_m), Z, False)
        for n, z_m in enumerate(levels_m)
    ]


def ties(section: Section, levels_m: Sequence[float], link_rise_m: float) -> list[DesignBar]:
    """Return ties between opposite bars along the sides, on top of the links at these levels.

    ``link_rise_m`` is half the height that the axis of a link takes. The ends with 135 degrees alternate.
    """
    half_x, half_y = section.link_half_m
    face_x, face_y = (half - inside_link_m(section.link_m, section.bar_m) for half in (half_x, half_y))
    inner = section.bar_positions_m()[4:]
    pairs = [(0.0, x, face_y) for x, y in inner if abs(y) == face_y and y > 0]
    pairs += [(1.0, y, face_x) for x, y in inner if abs(x) == face_x and x > 0]
    above_m = link_rise_m + contact_m(section.link_m, section.link_m)
    made = []
    for n, z_m in enumerate(levels_m):
        for is_along_x, across_m, half_m in pairs:
            line_m = held_tie_m(half_m, section.link_m, section.bar_m)
            line_m = line_m * np.array([(-1.0) ** n, 1.0, 1.0])
            flat = line_m[:, :2] if is_along_x else line_m[:, 1::-1]
            shift = np.array([0.0, across_m] if is_along_x else [across_m, 0.0])
            height = above_m + is_along_x * contact_m(section.link_m, section.link_m)
            line_m = np.column_stack([flat + shift, np.full(len(flat), z_m + height)])
            made.append(DesignBar(TIE, section.link_m, line_m, Z, False))
    return made


def held_tie_m(half_m: float, tie_m: float, bar_m: float) -> Line:
    """Return a tie along x that holds two bars at x = -/+ ``half_m``, y = 0, in its bends."""
    bend_m = link_bend_m(tie_m, bar_m)
    return tie_centreline_m(half_m - bend_m + inside_link_m(tie_m, bar_m), bend_m, hook_end_m(tie_m))


def link_levels_m(length_m: float, spacing_m: float, dense_m: float, dense_spacing_m: float) -> list[float]:
    """Return levels of links: ``dense_spacing_m`` apart in ``dense_m`` at both ends, ``spacing_m`` in between."""
    first, last = 0.05, length_m - 0.05
    if last - first < 2 * dense_m + spacing_m:
        return spaced(first, last, dense_spacing_m)
    parts = [
        spaced(first, first + dense_m, dense_spacing_m),
        spaced(first + dense_m, last - dense_m, spacing_m),
        spaced(last - dense_m, last, dense_spacing_m),
    ]
    return [*parts[0], *parts[1][1:], *parts[2][1:]]


@dataclass(frozen=True)
class RoundSection:
    """Round section: diameter of the concrete, cover of links, diameters of links and main bars, their count."""

    diameter_m: float
    cover_m: float
    link_m: float
    bar_m: float
    bars: int

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

    def main_bars(self, length_m: float) -> list[DesignBar]:
        """Return the straight main bars."""
        angles = np.arange(self.bars) * 2 * np.pi / self.bars
        places = self.bar_radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return [
            DesignBar(MAIN, self.bar_m, straight((x, y, 0.0), (x, y, length_m)), is_structural=True)
            for x, y in places.tolist()
        ]

    def spiral(self, length_m: float, pitch_m: float) -> DesignBar:
        """Return one spiral, with a closed turn at each end."""
        closed = 2 * radius_m(self.link_m) + 3 * CONTACT_GAP_M
        turns = (length_m - 0.1 - 2 * closed) / pitch_m
        steep = helix_m(self.link_radius_m, pitch_m, turns)
        ends = helix_m(self.link_radius_m, closed, 1.0)
        whole = [ends, steep[1:] + _up(ends[-1, 2])]
        last = helix_m(self.link_radius_m, closed, 1.0, start_deg=360.0 * turns)
        whole.append(last[1:] + _up(ends[-1, 2] + steep[-1, 2]))
        return DesignBar(SPIRAL, self.link_m, np.concatenate(whole) + _up(0.05))

    def rings(self, levels_m: Sequence[float]) -> list[DesignBar]:
        """Return lapped rings at these levels, each turned against the one below."""
        return [
            self._ring(LINK, self.link_m, self.link_radius_m, z_m, 137.5 * n) for n, z_m in enumerate(levels_m)
        ]

    def stiffeners(self, levels_m: Sequence[float], ring_diameter_m: float) -> list[DesignBar]:
        """Return rings inside the main bars, which keep the cage round when it is lifted."""
        inside_m = self.bar_radius_m - contact_m(self.bar_m, ring_diameter_m)
        # The vertices of the ring's polygon lie outside of its circle.
        return [
            self._ring(STIFFENER, ring_diameter_m, inside_m * np.cos(np.deg2rad(2.5)), z, 0.0) for z in levels_m
        ]

    def _ring(self, role: str, bar_m: float, axis_radius_m: float, z_m: float, start_deg: float) -> DesignBar:
        line_m = ring_m(axis_radius_m, radius_m(bar_m), min(lap_m(bar_m), axis_radius_m), start_deg)
        return DesignBar(role, bar_m, line_m + _up(z_m), Z, role != LINK)


def _up(z_m: float) -> Float64[ndarray, " 3"]:
    return np.array([0.0, 0.0, z_m])


def rise_m(bars: Sequence[DesignBar]) -> float:
    """Return half the height of the axis of the first of the links."""
    z_m: Float64[ndarray, " n"] = bars[0].line_m[:, 2]
    return float(np.ptp(z_m)) / 2
