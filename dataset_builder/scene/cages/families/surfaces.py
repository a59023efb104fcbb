"""Cages of walls, slabs and footings: mats of crossing bars, and what holds them apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dataset_builder.scene.cages.design import (
    Design,
    DesignBar,
    InfeasibleError,
    X,
    Y,
    Z,
    bent,
    drawn_of,
    drawn_step,
    spaced,
    straight,
)
from dataset_builder.scene.cages.families.columns import STANDING_M, drawn_section
from dataset_builder.scene.cages.members import TIE, held_tie_m, stirrups
from dataset_builder.scene.cages.rules import (
    COVER_M,
    DIAMETERS_M,
    GROUND_COVER_M,
    contact_m,
    slab_spacing_m,
    square_end_m,
    wall_spacing_m,
)
from dataset_builder.scene.shapes.bending import bend_radius_m

UPRIGHT, LEVEL, CHAIR, STARTER = "upright", "level", "chair", "starter"
LOWER, UPPER = "lower", "upper"
_BARS_PER_CHAIR = 3
_CHAIR_SPACING_M = 0.6
_EDGE_M = 0.05
"""Distance of the outermost bars of a mat from the ends of the bars that cross them."""


def wall(rng: np.random.Generator) -> Design:
    """Draw a wall that stands: two mats with level bars outside of upright ones, and ties between the mats."""
    thickness_m, cover_m = drawn_step(rng, 0.18, 0.40, 0.01), drawn_step(rng, *COVER_M, 0.005)
    length_m, height_m = drawn_step(rng, 1.0, 3.0, 0.1), drawn_step(rng, 1.0, 2.5, 0.1)
    upright_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.010 <= d <= 0.020])
    level_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.008 <= d <= min(0.016, upright_m)])
    spacing_m = drawn_step(rng, 0.10, min(0.30, wall_spacing_m(thickness_m)), 0.025)
    level_spacing_m = drawn_step(rng, 0.10, 0.30, 0.025)
    level_y = thickness_m / 2 - cover_m - level_m / 2
    upright_y = level_y - contact_m(level_m, upright_m)
    columns = spaced(-length_m / 2 + _EDGE_M, length_m / 2 - _EDGE_M, spacing_m)
    rows = spaced(0.08, height_m - 0.08, level_spacing_m)
    bars = [
        DesignBar(UPRIGHT, upright_m, straight((x, s * upright_y, 0.0), (x, s * upright_y, height_m)), X, False)
        for s in (1, -1)
        for x in columns
    ]
    bars += [
        DesignBar(
            LEVEL, level_m, straight((-length_m / 2, s * level_y, z), (length_m / 2, s * level_y, z)), Z, False
        )
        for s in (1, -1)
        for z in rows
    ]
    tie_m = drawn_of(rng, [0.006, 0.008])
    # At least four ties per square metre (EN 1992-1-1, 9.6.4), on the row above a level bar.
    step_x, step_z = max(1, int(0.5 / spacing_m)), max(1, int(0.5 / level_spacing_m))
    flat = held_tie_m(upright_y, tie_m, upright_m)
    for row, z in enumerate(rows[::step_z]):
        for x in columns[(row % 2) * (step_x // 2) :: step_x]:
            line = np.column_stack([flat[:, 1] * (-1.0) ** row, flat[:, 0], flat[:, 2]])
            height = z + contact_m(level_m, tie_m) + 0.01
            bars.append(DesignBar(TIE, tie_m, line + np.array([x, 0.0, height]), Z, False))
    drawn: dict[str, float | str] = {
        "shape": "two mats",
        "thickness_m": thickness_m,
        "cover_m": cover_m,
        "length_m": length_m,
        "height_m": height_m,
        "bar_m": upright_m,
        "level_bar_m": level_m,
        "link_m": tie_m,
        "spacing_m": spacing_m,
        "level_spacing_m": level_spacing_m,
    }
    return Design("wall", tuple(bars), drawn, STANDING_M)


def _mat(
    role: str, diameter_m: float, along: int, positions_m: Sequence[float], half_m: float, z_m: float
) -> list[DesignBar]:
    """Return parallel straight bars along x (``along`` 0) or y (1) at these positions of the other axis."""
    bars = []
    for position in positions_m:
        ends = [[end, position, z_m] if along == 0 else [position, end, z_m] for end in (-half_m, half_m)]
        bars.append(DesignBar(role, diameter_m, np.array(ends), (Y, X)[along], False))
    return bars


def slab(rng: np.random.Generator) -> Design:
    """Draw a slab: a lower and an upper mat of two layers each, and chairs that carry the upper mat."""
    thickness_m, cover_m = drawn_step(rng, 0.16, 0.40, 0.01), drawn_step(rng, 0.020, 0.040, 0.005)
    side_x_m, side_y_m = drawn_step(rng, 1.0, 2.4, 0.1), drawn_step(rng, 1.0, 2.4, 0.1)
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.008 <= d <= 0.016])
    spacing_m = drawn_step(rng, 0.10, min(0.25, slab_spacing_m(thickness_m)), 0.025)
    step_m = contact_m(bar_m, bar_m)
    low = [cover_m + bar_m / 2, cover_m + bar_m / 2 + step_m]
    high = [thickness_m - cover_m - bar_m / 2 - step_m, thickness_m - cover_m - bar_m / 2]
    half_x, half_y = side_x_m / 2, side_y_m / 2
    across_x = spaced(-half_x + _EDGE_M, half_x - _EDGE_M, spacing_m)
    across_y = spaced(-half_y + _EDGE_M, half_y - _EDGE_M, spacing_m)
    bars = [
        *_mat(LOWER, bar_m, 0, across_y, half_x, low[0]),
        *_mat(LOWER, bar_m, 1, across_x, half_y, low[1]),
        *_mat(UPPER, bar_m, 1, across_x, half_y, high[0]),
        *_mat(UPPER, bar_m, 0, across_y, half_x, high[1]),
    ]
    chair_m = drawn_of(rng, [0.008, 0.010, 0.012])
    foot_z, top_z = low[1] + contact_m(bar_m, chair_m), high[0] - contact_m(bar_m, chair_m)
    if top_z - foot_z < 2 * bend_radius_m(chair_m) + 0.01:
        raise InfeasibleError("a slab is too thin for chairs")
    bars += _chairs(chair_m, across_x, across_y, foot_z, top_z)
    drawn: dict[str, float | str] = {
        "shape": "two mats",
        "thickness_m": thickness_m,
        "cover_m": cover_m,
        "length_m": side_x_m,
        "width_m": side_y_m,
        "bar_m": bar_m,
        "link_m": chair_m,
        "spacing_m": spacing_m,
    }
    return Design("slab", tuple(bars), drawn, cover_m)


def _chairs(
    diameter_m: float, across_x: Sequence[float], across_y: Sequence[float], foot_z: float, top_z: float
) -> list[DesignBar]:
    """Return chairs whose feet rest on bars along y of the lower mat and whose tops carry those of the upper mat.

    A chair reaches over ``_BARS_PER_CHAIR`` of these bars, and stands between two bars along x. Chairs are about
    ``_CHAIR_SPACING_M`` apart. Raises ``InfeasibleError`` if bars are too few, or too close for the bends.
    """
    pitch = across_x[1] - across_x[0]
    if len(across_x) < _BARS_PER_CHAIR or len(across_y) < 2:
        raise InfeasibleError("a slab has too few bars for chairs")
    firsts = _spread_indices(len(across_x) - _BARS_PER_CHAIR + 1, pitch, _BARS_PER_CHAIR)
    rows = _spread_indices(len(across_y) - 1, across_y[1] - across_y[0], 1)
    chairs = []
    for row in rows:
        y = (across_y[row] + across_y[row + 1]) / 2
        for first in firsts:
            start, end = across_x[first] - 0.02, across_x[first + _BARS_PER_CHAIR - 1] + 0.02
            legs = across_x[first] + pitch / 2, across_x[first + 1] + pitch / 2
            places = [(start, foot_z), (legs[0], foot_z), (legs[0], top_z)]
            places += [(legs[1], top_z), (legs[1], foot_z), (end, foot_z)]
            try:
                line_m = bent([(x, y, z) for x, z in places], diameter_m)
            except ValueError:
                raise InfeasibleError("the bars of a slab are too close for chairs") from None
            chairs.append(DesignBar(CHAIR, diameter_m, line_m, Y, False))
    return chairs


def _spread_indices(count: int, step_m: float, least: int) -> list[int]:
    """Return indices below ``count`` that are about ``_CHAIR_SPACING_M`` and at least ``least`` steps apart.

    The first and the last one are left out if others remain. Raises ``InfeasibleError`` if only one fits.
    """
    first, last = (1, count - 2) if count >= least + 3 else (0, count - 1)
    if last - first < least:
        raise InfeasibleError("a slab has too few bars for chairs")
    intervals = min((last - first) // least, max(1, round((last - first) * step_m / _CHAIR_SPACING_M)))
    return [first + (last - first) * number // intervals for number in range(intervals + 1)]


def footing(rng: np.random.Generator) -> Design:
    """Draw a pad footing: a mat whose bars are bent up at both ends, and starter bars of a column with links."""
    cover_m = drawn_step(rng, *GROUND_COVER_M, 0.005)
    side_x_m, side_y_m = drawn_step(rng, 1.0, 2.2, 0.1), drawn_step(rng, 1.0, 2.2, 0.1)
    depth_m = drawn_step(rng, 0.35, 0.70, 0.05)
    bar_m = drawn_of(rng, [0.012, 0.016, 0.020])
    spacing_m = drawn_step(rng, 0.125, 0.25, 0.025)
    starter_m, link_m = drawn_of(rng, [0.016, 0.020, 0.025]), drawn_of(rng, [0.008, 0.010])
    column_m = drawn_step(rng, 0.30, 0.50, 0.05)
    low, up = cover_m + bar_m / 2, depth_m - cover_m
    second = low + contact_m(bar_m, bar_m)
    half_x, half_y = side_x_m / 2 - cover_m - bar_m / 2, side_y_m / 2 - cover_m - bar_m / 2
    inset = bend_radius_m(bar_m) + 2 * contact_m(bar_m, bar_m)
    bars = [
        DesignBar(
            LOWER,
            bar_m,
            bent([(-half_x, y, up), (-half_x, y, low), (half_x, y, low), (half_x, y, up)], bar_m),
            Y,
            False,
        )
        for y in spaced(-half_y + inset, half_y - inset, spacing_m)
    ]
    bars += [
        DesignBar(
            UPPER,
            bar_m,
            bent([(x, -half_y, up), (x, -half_y, second), (x, half_y, second), (x, half_y, up)], bar_m),
            X,
            False,
        )
        for x in spaced(-half_x + inset, half_x - inset, spacing_m)
    ]
    section = drawn_section(rng, starter_m, link_m, 0.03, column_m, column_m)
    foot_z = second + contact_m(bar_m, starter_m)
    top_z = depth_m + 40 * starter_m
    foot_m = square_end_m(starter_m) + bend_radius_m(starter_m)
    for index, (x, y) in enumerate(section.bar_positions_m()):
        # The feet point outwards along x, those of the bars along the sides along y, one layer higher.
        outward = (np.sign(x) or 1.0, 0.0) if abs(x) >= abs(y) else (0.0, np.sign(y))
        z = foot_z + (0.0 if index < 4 else contact_m(starter_m, starter_m) * (1 + index % 3))
        corners = [(x + outward[0] * foot_m, y + outward[1] * foot_m, z), (x, y, z), (x, y, top_z)]
        bars.append(DesignBar(STARTER, starter_m, bent(corners, starter_m), None, index < 4))
    levels = [foot_z + 0.15, depth_m - 0.05, depth_m + 0.20, top_z - 0.10]
    if np.diff(levels).min() < 0.06:
        raise InfeasibleError("a footing is too shallow for the links of its starters")
    bars += stirrups(section, levels)
    drawn: dict[str, float | str] = {
        "shape": "pad",
        "side_x_m": side_x_m,
        "side_y_m": side_y_m,
        "depth_m": depth_m,
        "cover_m": cover_m,
        "bar_m": bar_m,
        "starter_m": starter_m,
        "link_m": link_m,
        "spacing_m": spacing_m,
        "column_m": column_m,
    }
    return Design("footing", tuple(bars), drawn, cover_m)
