"""Where the bars of a square pier cage lie, and whether a spec leaves room for them. World frame, metres.

The cage stands on z = 0, centred on x = y = 0. The verticals stand in four rows, each counted from the
negative side; hoops lie outside of them, ties hook round them. Every level is a stack of three layers, one
bar thick: the first half hoop, the second one, the tie.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from itertools import count
from math import ceil, gcd, inf, sqrt

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import PierSpec
from dataset_builder.scene.shapes.bar_mesh import plain_outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m

CLEAR_GAP_M = 5e-4
"""Between bars that a tie wire would pull together: no two surfaces coincide."""

HOOK_EXTENSION = 10.0
"""Straight end of a hook in diameters: EN 1998-1, 5.6.1 at 135 degrees, EN 1992-1-1, figure 8.5 at 90."""

LEAST_LAP = 40.0
"""Straight overlap of two half hoops in diameters, at least; it ends on verticals, so it comes out longer."""

STOCK_LENGTH_M = 12.0
"""The longest bar that mills sell from stock."""


@dataclass(frozen=True)
class Link:
    """A kind of bent bar: its nominal diameter, its outer radius as drawn, its centreline's bend radius."""

    diameter_m: float
    outer_radius_m: float
    bend_radius_m: float

    @property
    def hook_extension_m(self) -> float:
        """The straight end of its hooks, metres."""
        return HOOK_EXTENSION * self.diameter_m


@dataclass(frozen=True)
class PierLayout:
    """The positions that all bars of a pier are made from, metres.

    ``rows_m`` are the places of a side's verticals along it, corners included. Verticals between corners stand
    ``face_m`` from the middle plane; corner ones stand further in, in the bend of the hoops. Centrelines of
    hoops run ``hoop_line_m`` from the middle plane, the ends of ties reach to ``tie_line_m``. Half hoops end
    with hooks round the verticals number ``lap_rows`` of a side. ``level_layers_m`` holds the heights of both
    half hoops and the tie, level by level.
    """

    hoop: Link
    tie: Link
    rows_m: tuple[float, ...]
    face_m: float
    hoop_line_m: float
    tie_line_m: float
    lap_rows: tuple[int, int]
    level_layers_m: tuple[tuple[float, float, float], ...]

    @property
    def intervals(self) -> int:
        """Spaces between the verticals of one side."""
        return len(self.rows_m) - 1


def pier_layout(spec: PierSpec) -> PierLayout:
    """Return the positions of all bars of ``spec``; raise ``ValueError`` where they would not fit or collide."""
    _check_numbers(spec)
    vertical_m = plain_outer_radius_m(spec.vertical_diameter_m)
    hoop = _link(spec.hoop_diameter_m, vertical_m)
    tie = _link(spec.tie_diameter_m, vertical_m)
    hoop_line_m = spec.side_m / 2 - hoop.outer_radius_m
    face_m = hoop_line_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    corner_m = hoop_line_m - _corner_inset_m(hoop, vertical_m)
    rows_m = np.linspace(-corner_m, corner_m, spec.verticals // 4 + 1)
    spacing_m = float(rows_m[1] - rows_m[0])
    _check_hooks(spacing_m, vertical_m, hoop)
    return PierLayout(
        hoop=hoop,
        tie=tie,
        rows_m=tuple(float(row) for row in rows_m),
        face_m=face_m,
        hoop_line_m=hoop_line_m,
        tie_line_m=face_m + vertical_m + CLEAR_GAP_M + tie.outer_radius_m,
        lap_rows=_lap_rows(len(rows_m) - 1, spacing_m, hoop.diameter_m),
        level_layers_m=_level_layers_m(spec, hoop, tie),
    )


def vertical_places_m(layout: PierLayout) -> Float64[ndarray, "n 2"]:
    """Return where the verticals stand (x, y), counter-clockwise from the corner at -x, -y."""
    side = [(row_m, -layout.face_m) for row_m in layout.rows_m[:-1]]
    side[0] = (layout.rows_m[0], layout.rows_m[0])
    south = np.array(side)
    east = np.stack([-south[:, 1], south[:, 0]], axis=1)
    return np.concatenate([south, east, -south, -east])


def tie_row(turn: int, intervals: int) -> int:
    """Return the row that the tie number ``turn`` of its direction holds: never a corner, neighbours far apart.

    Steps of seven, or of the next number that shares no divisor with the rows, visit all inner rows in turn.
    """
    rows = intervals - 1
    step = next(step for step in count(7) if gcd(step, rows) == 1)
    return 1 + step * turn % rows


def check_stock_length(role: str, length_m: float) -> None:
    """Raise ``ValueError`` where a bar is longer than any that can be bought."""
    if length_m > STOCK_LENGTH_M:
        raise ValueError(f"a {role} of this pier is {length_m:.2f} m long, stock bars end at {STOCK_LENGTH_M} m")


def _check_numbers(spec: PierSpec) -> None:
    if not all(0 < value < inf for value in astuple(spec) if not isinstance(value, str)):
        raise ValueError(f"lengths, diameters and counts must be positive and finite: {spec}")
    if spec.verticals % 4:
        raise ValueError(f"verticals is {spec.verticals}, expected a multiple of 4: the cage has four equal sides")
    if spec.tie_diameter_m > spec.hoop_diameter_m:
        raise ValueError(
            f"ties of {spec.tie_diameter_m} m are thicker than hoops of {spec.hoop_diameter_m} m, "
            "expected no thicker: their hooks would stand out of the cage"
        )


def _link(diameter_m: float, vertical_m: float) -> Link:
    """Return a bent bar with the least mandrel of EN 1992-1-1, or a wider one where a vertical needs it."""
    outer_m = plain_outer_radius_m(diameter_m)
    return Link(diameter_m, outer_m, max(bend_radius_m(diameter_m), vertical_m + CLEAR_GAP_M + outer_m))


def _corner_inset_m(hoop: Link, vertical_m: float) -> float:
    """Return how far from both legs of a hoop its corner vertical stands, so that the bend clears it."""
    play_m = hoop.bend_radius_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    return hoop.bend_radius_m - play_m / sqrt(2)


def _check_hooks(spacing_m: float, vertical_m: float, link: Link) -> None:
    """Raise where the end of a hook, 45 degrees into the core, could reach the next vertical or its row."""
    reach_m = (link.bend_radius_m + link.hook_extension_m) / sqrt(2) + link.outer_radius_m
    needed_m = reach_m + CLEAR_GAP_M + vertical_m
    if spacing_m < needed_m:
        raise ValueError(
            f"verticals stand {spacing_m:.4f} m apart, the hooks of {link.diameter_m} m bars need {needed_m:.4f} m"
        )


def _lap_rows(intervals: int, spacing_m: float, diameter_m: float) -> tuple[int, int]:
    """Return the numbers of the verticals at which a side's lap begins and ends, round the side's middle."""
    spanned = ceil(LEAST_LAP * diameter_m / spacing_m)
    low = (intervals - spanned) // 2
    if low < 1:
        raise ValueError(
            f"a lap of {LEAST_LAP * diameter_m:.3f} m takes {spanned} spaces between verticals, "
            f"a side has {intervals}, expected {spanned + 2} or more"
        )
    return low, low + spanned


def _level_layers_m(spec: PierSpec, hoop: Link, tie: Link) -> tuple[tuple[float, float, float], ...]:
    """Return the heights of first half hoop, second half hoop and tie of each level, evenly spread."""
    above_first = np.cumsum(
        [0.0, 2 * hoop.outer_radius_m + CLEAR_GAP_M, hoop.outer_radius_m + CLEAR_GAP_M + tie.outer_radius_m]
    )
    stack_m = hoop.outer_radius_m + float(above_first[2]) + tie.outer_radius_m
    pitch_m = spec.height_m / spec.levels
    if pitch_m < stack_m + CLEAR_GAP_M:
        raise ValueError(
            f"{spec.levels} levels in {spec.height_m} m are {pitch_m:.4f} m apart, "
            f"two half hoops and a tie above each other take {stack_m + CLEAR_GAP_M:.4f} m"
        )
    lowest_m = (pitch_m - stack_m) / 2 + hoop.outer_radius_m
    heights = lowest_m + pitch_m * np.arange(spec.levels)[:, None] + above_first
    return tuple((float(first), float(second), float(tied)) for first, second, tied in heights)
