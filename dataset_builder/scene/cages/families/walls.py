"""Cages of walls that stand: two mats of upright and level bars, and ties between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dataset_builder.scene.cages.design import (
    STANDING_M,
    SUPPORT_SPACING_M,
    Design,
    DesignBar,
    InfeasibleError,
    Lap,
    Mat,
    X,
    Y,
    Z,
    bent,
    drawn_of,
    drawn_step,
    lapped,
    spaced,
    steel_share,
    straight,
)
from dataset_builder.scene.cages.families.columns import drawn_cover_m
from dataset_builder.scene.cages.rules import (
    COVER_M,
    DIAMETERS_M,
    LINK_SLACK_M,
    WALL_STEEL,
    area_m2,
    contact_m,
    lap_m,
    wall_spacing_m,
)
from dataset_builder.scene.cages.sections import TIE, held_tie_m
from dataset_builder.scene.shapes.bending import bend_radius_m

UPRIGHT, LEVEL, U_BAR = "upright", "level", "u-bar"
_EDGE_M, _FIRST_ROW_M = 0.05, 0.08
"""Distances of the outermost bars of a mat from the ends of the bars that cross them: upright, level ones."""

_LEAST_BETWEEN_M = 0.060
"""Least clear distance of the mats, in which concrete can be poured and compacted."""

_TIE_SPACING_M = 0.5
"""Largest distance of ties, four per square metre (EN 1992-1-1, 9.6.4 (2))."""

_TIE_GAP_M = 0.002
"""Clear distance of a tie from the level bar below it."""


def wall(rng: np.random.Generator, shape: str) -> Design:
    """Draw a wall: two mats with level bars outside of upright ones, and ties; laps at the foot or U-bars."""
    thickness_m = drawn_step(rng, 0.18, 0.40, 0.01)
    length_m, height_m = drawn_step(rng, 1.0, 3.0, 0.1), drawn_step(rng, 1.0, 2.5, 0.1)
    # Laps of bars from 20 mm up would need links across the wall (EN 1992-1-1, 8.7.4.1 (3)).
    upright_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.010 <= d <= (0.016 if shape == "laps" else 0.020)])
    level_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.008 <= d <= min(0.016, upright_m)])
    tie_m = drawn_of(rng, [0.006, 0.008])
    least_m = COVER_M[0] + max(0.0, tie_m + LINK_SLACK_M - level_m)  # The bends of ties are beside level bars.
    cover_m = drawn_cover_m(rng, (least_m, COVER_M[1]), level_m, upright_m)
    upright_m2, level_m2 = 2 * area_m2(upright_m) / thickness_m, 2 * area_m2(level_m) / thickness_m
    most_m = min(0.30, wall_spacing_m(thickness_m), upright_m2 / WALL_STEEL[0])
    spacing_m = drawn_step(rng, 0.10, most_m, 0.025)
    end_x, edge_x = length_m / 2, length_m / 2 - _EDGE_M
    if shape == "u-bars":  # The outermost upright bars are where the bends of the U-bars end.
        end_x -= cover_m
        edge_x = end_x - level_m / 2 - max(bend_radius_m(level_m), contact_m(level_m, upright_m))
    columns = spaced(-edge_x, edge_x, spacing_m)
    upright_share = steel_share(upright_m2, columns[1] - columns[0], WALL_STEEL)
    most_m = min(0.30, level_m2 / max(0.25 * upright_share, 0.001))  # EN 1992-1-1, 9.6.3 (1).
    level_spacing_m = drawn_step(rng, 0.10, most_m, 0.025)
    level_y = thickness_m / 2 - cover_m - level_m / 2
    upright_y = level_y - contact_m(level_m, upright_m)
    if 2 * upright_y - upright_m < _LEAST_BETWEEN_M:
        raise InfeasibleError("the mats of a wall are too close to each other")
    rows = spaced(_FIRST_ROW_M, height_m - _FIRST_ROW_M, level_spacing_m)
    uprights = [
        DesignBar(UPRIGHT, upright_m, straight((x, y, 0.0), (x, y, height_m)), X, False, Y)
        for y in (upright_y, -upright_y)
        for x in columns
    ]
    drawn: dict[str, float | str] = {
        "shape": shape,
        "thickness_m": thickness_m,
        "cover_m": cover_m,
        "length_m": length_m,
        "height_m": height_m,
        "bar_m": upright_m,
        "level_bar_m": level_m,
        "link_m": tie_m,
        "spacing_m": spacing_m,
        "steel_share": upright_share,
        "level_spacing_m": level_spacing_m,
    }
    if shape == "laps":
        lap = Lap(upright_m, level_m, drawn_step(rng, 0.01, 0.06, 0.01))
        drawn["lap_start_m"] = lap.start_m
        across = lap.levels_m(rows[0], rows[-1], level_spacing_m)
        rows = [*across[:-1], *spaced(across[-1], rows[-1], level_spacing_m)]
        inward = [(0.0, -float(np.sign(bar.line_m[0, 1]))) for bar in uprights]
        uprights = lapped(uprights, inward, lap)
    bars = [*uprights, *_level_bars(level_m, rows, end_x, level_y)]
    bars += _ties(columns, rows, (spacing_m, level_spacing_m), (tie_m, upright_m, level_m), upright_y)
    if shape == "u-bars":
        bars += _u_bars(level_m, rows, end_x - level_m / 2, level_y)
    # Bars that lap with starters are inside of these.
    inner_y = upright_y - (contact_m(upright_m, upright_m) if shape == "laps" else 0.0)
    mats = _mats(thickness_m, cover_m, columns, rows, inner_y)
    return Design("wall", tuple(bars), drawn, STANDING_M, mats)


def _mats(
    thickness_m: float, cover_m: float, columns: Sequence[float], rows: Sequence[float], inner_y: float
) -> tuple[Mat, ...]:
    """Return both mats, between whose inner bars at y = ``inner_y`` and ``-inner_y`` there are ties."""
    supports_m = tuple(tuple(spaced(line[0], line[-1], SUPPORT_SPACING_M)) for line in (columns, rows))
    return tuple(
        Mat(name, (0.0, side, 0.0), thickness_m, cover_m, (X, Z), supports_m, (-inner_y, inner_y))
        for name, side in (("front", -1.0), ("back", 1.0))
    )


def _level_bars(level_m: float, rows: Sequence[float], end_x: float, level_y: float) -> list[DesignBar]:
    return [
        DesignBar(LEVEL, level_m, straight((-end_x, y, z), (end_x, y, z)), Z, False, Y)
        for y in (level_y, -level_y)
        for z in rows
    ]


def _ties(
    columns: Sequence[float],
    rows: Sequence[float],
    spacings_m: tuple[float, float],
    diameters_m: tuple[float, float, float],
    upright_y: float,
) -> list[DesignBar]:
    """Return ties that hold upright bars of both mats and lie on level bars, staggered from row to row."""
    tie_m, upright_m, level_m = diameters_m
    step_x, step_z = (max(1, int(_TIE_SPACING_M / spacing_m + 1e-9)) for spacing_m in spacings_m)
    flat_m = held_tie_m(upright_y, tie_m, upright_m)[:, [1, 0, 2]]
    above_m = contact_m(level_m, tie_m) + _TIE_GAP_M
    return [
        DesignBar(TIE, tie_m, flat_m * [(-1.0) ** row, 1.0, 1.0] + np.array([x, 0.0, z + above_m]), Z, False)
        for row, z in enumerate(rows[::step_z])
        for x in columns[(row % 2) * (step_x // 2) :: step_x]
    ]


def _u_bars(diameter_m: float, rows: Sequence[float], back_x: float, level_y: float) -> list[DesignBar]:
    """Return bars that close both ends of the wall, below the level bars, with which their legs lap.

    ``back_x`` is the distance of their backs from the middle. Raises ``InfeasibleError`` for a short wall.
    """
    leg_x = back_x - bend_radius_m(diameter_m) - lap_m(diameter_m)
    if leg_x < 0.05:
        raise InfeasibleError("a wall is too short for the laps of its U-bars")
    below_m = contact_m(diameter_m, diameter_m)
    corners_m = [(leg_x, level_y), (back_x, level_y), (back_x, -level_y), (leg_x, -level_y)]
    lines = [bent([(s * x, y, z - below_m) for x, y in corners_m], diameter_m) for s in (1, -1) for z in rows]
    return [DesignBar(U_BAR, diameter_m, line_m, Z, False, Y) for line_m in lines]
