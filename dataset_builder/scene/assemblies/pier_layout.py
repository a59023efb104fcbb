"""Positions of the bars of a square pier cage. World frame, metres.

The cage stands on z = 0, centred on x = y = 0. The verticals stand in four rows, each counted from the
negative side; hoops lie outside of them, ties hook round them. Every level is a stack of three layers, each
one bar thick: the first half hoop, the second half hoop, the tie.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from math import ceil, gcd, sqrt

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import PierSpec
from dataset_builder.scene.shapes.bar_mesh import plain_outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m

CLEAR_GAP_M = 5e-4
"""Clear distance between bars that would be tied together, metres, so that no surfaces coincide."""

HOOK_EXTENSION_DIAMETERS = 10.0
"""Straight end of a hook in diameters: EN 1998-1, 5.6.1 at 135 degrees, EN 1992-1-1, figure 8.5 at 90 degrees."""

MIN_LAP_DIAMETERS = 40.0
"""Least straight overlap of two half hoops in diameters; laps end on verticals and are therefore longer."""


@dataclass(frozen=True)
class BentBarType:
    """A type of bent bar: nominal diameter, outer radius of its mesh and bend radius of its centreline."""

    diameter_m: float
    outer_radius_m: float
    bend_radius_m: float

    @property
    def hook_extension_m(self) -> float:
        """Length of the straight end of a hook, metres."""
        return HOOK_EXTENSION_DIAMETERS * self.diameter_m


@dataclass(frozen=True)
class PierLayout:
    """Positions of all bars of a pier, metres.

    ``rows_m`` are the positions of a side's verticals along it, corners included. Verticals between corners are
    at a distance ``face_m`` from the middle plane; corner verticals are further in, in the bend of the hoops.
    Centrelines of hoops are at ``hoop_line_m`` from the middle plane, the ends of ties reach to ``tie_line_m``.
    ``lap_rows`` are the indices of a side's verticals round which half hoops end with hooks. ``level_layers_m``
    are the heights of first half hoop, second half hoop and tie of each level.
    """

    hoop: BentBarType
    tie: BentBarType
    rows_m: tuple[float, ...]
    face_m: float
    hoop_line_m: float
    tie_line_m: float
    lap_rows: tuple[int, int]
    level_layers_m: tuple[tuple[float, float, float], ...]

    @property
    def intervals(self) -> int:
        """Number of spaces between the verticals of one side."""
        return len(self.rows_m) - 1


def pier_layout(spec: PierSpec) -> PierLayout:
    """Return the positions of all bars of ``spec``, which has room for them; its verticals are a multiple of 4."""
    vertical_m = plain_outer_radius_m(spec.vertical_diameter_m)
    hoop = _bent_bar_type(spec.hoop_diameter_m, vertical_m)
    tie = _bent_bar_type(spec.tie_diameter_m, vertical_m)
    hoop_line_m = spec.side_m / 2 - hoop.outer_radius_m
    face_m = hoop_line_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    corner_m = hoop_line_m - _corner_inset_m(hoop, vertical_m)
    rows_m = np.linspace(-corner_m, corner_m, spec.verticals // 4 + 1)
    spacing_m = float(rows_m[1] - rows_m[0])
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


def vertical_positions_m(layout: PierLayout) -> Float64[ndarray, "n 2"]:
    """Return the positions (x, y) of the verticals, counter-clockwise from the corner at -x, -y."""
    side = [(row_m, -layout.face_m) for row_m in layout.rows_m[:-1]]
    side[0] = (layout.rows_m[0], layout.rows_m[0])
    south = np.array(side)
    east = np.stack([-south[:, 1], south[:, 0]], axis=1)
    return np.concatenate([south, east, -south, -east])


def tie_row(tie_number: int, intervals: int) -> int:
    """Return the row (never a corner) that the tie ``tie_number`` of its direction holds.

    Consecutive ties are far apart: steps of seven rows, or of the next number that is coprime to the number of
    inner rows, visit all inner rows.
    """
    rows = intervals - 1
    step = next(step for step in count(7) if gcd(step, rows) == 1)
    return 1 + step * tie_number % rows


def _bent_bar_type(diameter_m: float, vertical_m: float) -> BentBarType:
    """Return the bar type with the smallest mandrel of EN 1992-1-1, or a larger one if a vertical requires it."""
    outer_m = plain_outer_radius_m(diameter_m)
    return BentBarType(diameter_m, outer_m, max(bend_radius_m(diameter_m), vertical_m + CLEAR_GAP_M + outer_m))


def _corner_inset_m(hoop: BentBarType, vertical_m: float) -> float:
    """Return the distance of a corner vertical from both legs of a hoop at which the bend clears it, metres."""
    clearance_m = hoop.bend_radius_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    return hoop.bend_radius_m - clearance_m / sqrt(2)


def _lap_rows(intervals: int, spacing_m: float, diameter_m: float) -> tuple[int, int]:
    """Return the indices of the verticals at which a side's lap begins and ends, centred on the side."""
    spanned_intervals = ceil(MIN_LAP_DIAMETERS * diameter_m / spacing_m)
    low = (intervals - spanned_intervals) // 2
    return low, low + spanned_intervals


def _level_layers_m(spec: PierSpec, hoop: BentBarType, tie: BentBarType) -> tuple[tuple[float, float, float], ...]:
    """Return the heights of first half hoop, second half hoop and tie of each level, evenly spaced."""
    above_first = np.cumsum(
        [0.0, 2 * hoop.outer_radius_m + CLEAR_GAP_M, hoop.outer_radius_m + CLEAR_GAP_M + tie.outer_radius_m]
    )
    stack_m = hoop.outer_radius_m + float(above_first[2]) + tie.outer_radius_m
    pitch_m = spec.height_m / spec.levels
    lowest_m = (pitch_m - stack_m) / 2 + hoop.outer_radius_m
    heights = lowest_m + pitch_m * np.arange(spec.levels)[:, None] + above_first
    return tuple((float(first), float(second), float(tied)) for first, second, tied in heights)
