"""Cages of slabs, two mats of two layers each with chairs under the upper one, and of pad footings, one mat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dataset_builder.scene.cages.design import (
    STARTER,
    SUPPORT_SPACING_M,
    Design,
    DesignBar,
    InfeasibleError,
    Mat,
    X,
    Y,
    Z,
    bent,
    drawn_of,
    drawn_step,
    spaced,
    steel_share,
    straight,
)
from dataset_builder.scene.cages.families.columns import drawn_cover_m, drawn_section
from dataset_builder.scene.cages.rules import (
    DENSE,
    DIAMETERS_M,
    GROUND_COVER_M,
    SLAB_STEEL,
    area_m2,
    column_link_spacing_m,
    contact_m,
    lap_m,
    slab_spacing_m,
    square_end_m,
)
from dataset_builder.scene.cages.sections import Section, stirrups
from dataset_builder.scene.shapes.bending import bend_radius_m

LOWER, UPPER, CHAIR = "lower", "upper", "chair"
_EDGE_M = 0.05
"""Distance of the outermost bars of a mat from the ends of the bars that cross them."""

_CLOSE_M = 0.150
"""Largest spacing of bars of which a chair carries two, or stands on two, instead of one."""

_FOOT_END_M = 0.04
"""Length of a chair's foot beyond the last bar that it stands on."""


def slab(rng: np.random.Generator, shape: str) -> Design:
    """Draw a slab on spacers, of bars of one diameter and spacing."""
    thickness_m = drawn_step(rng, 0.16, 0.40, 0.01)
    side_x_m, side_y_m = drawn_step(rng, 1.0, 2.4, 0.1), drawn_step(rng, 1.0, 2.4, 0.1)
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.008 <= d <= 0.016])
    cover_m = drawn_cover_m(rng, (0.020, 0.040), bar_m, 0.0)
    effective_m = thickness_m - cover_m - bar_m / 2
    most_m = min(0.25, slab_spacing_m(thickness_m), area_m2(bar_m) / (SLAB_STEEL[0] * effective_m))
    spacing_m = drawn_step(rng, 0.10, most_m, 0.025)
    chair_m = drawn_of(rng, [0.008, 0.010, 0.012])
    step_m = contact_m(bar_m, bar_m)
    low = [cover_m + bar_m / 2, cover_m + bar_m / 2 + step_m]
    high = [effective_m - step_m, effective_m]
    share = steel_share(area_m2(bar_m) / spacing_m, effective_m, SLAB_STEEL)
    across_x = spaced(_EDGE_M - side_x_m / 2, side_x_m / 2 - _EDGE_M, spacing_m)
    across_y = spaced(_EDGE_M - side_y_m / 2, side_y_m / 2 - _EDGE_M, spacing_m)
    between_m = contact_m(bar_m, chair_m)
    foot_z, top_z = low[0] + between_m, high[0] - between_m
    chairs, places_m, under_feet = _chairs(chair_m, across_x, across_y, foot_z, top_z)
    bars = [
        *_mat(LOWER, bar_m, 0, across_y, side_x_m / 2, low[0]),
        *_mat(LOWER, bar_m, 1, across_x, side_y_m / 2, low[1]),
        *_mat(UPPER, bar_m, 1, across_x, side_y_m / 2, high[0]),
        *_mat(UPPER, bar_m, 0, across_y, side_x_m / 2, high[1]),
        *chairs,
    ]
    for index in under_feet:
        bars[index] = replace(bars[index], spaced_along=None, is_structural=True)
    drawn: dict[str, float | str] = {
        "shape": shape,
        "thickness_m": thickness_m,
        "cover_m": cover_m,
        "length_m": side_x_m,
        "width_m": side_y_m,
        "bar_m": bar_m,
        "link_m": chair_m,
        "spacing_m": spacing_m,
        "steel_share": share,
    }
    first_z = max(low[1], foot_z)
    mats = (
        Mat(LOWER, (0.0, 0.0, -1.0), thickness_m, cover_m, (X, Y), places_m, (-top_z, -first_z)),
        Mat(UPPER, Z, thickness_m, cover_m, (X, Y), places_m, (first_z, top_z)),
    )
    return Design("slab", tuple(bars), drawn, cover_m, mats)


def _mat(
    role: str, diameter_m: float, along: int, positions_m: Sequence[float], half_m: float, z_m: float
) -> list[DesignBar]:
    """Return parallel straight bars along x (``along`` 0) or y (1) at these positions of the other axis."""
    bars = []
    for position in positions_m:
        first, last = ((end, position, z_m) if along == 0 else (position, end, z_m) for end in (-half_m, half_m))
        bars.append(DesignBar(role, diameter_m, straight(first, last), (Y, X)[along], False, Z))
    return bars


def _chairs(
    diameter_m: float, across_x: Sequence[float], across_y: Sequence[float], foot_z: float, top_z: float
) -> tuple[list[DesignBar], tuple[tuple[float, ...], tuple[float, ...]], set[int]]:
    """Return chairs whose feet stand on bars along x of the lowest layer and whose tops carry bars along y.

    Also return the places (x, y) of their middles, and the indices in ``across_y`` of the bars that they stand on.
    The top of a chair is along x. Its feet are along y between bars of the second layer, one to each side, so that
    the chair does not fall over; they are tied to the bars. Raises ``InfeasibleError`` if bars are too few, or too
    close for the bends.
    """
    pitch_x, pitch_y = across_x[1] - across_x[0], across_y[1] - across_y[0]
    carried, under = (2 if pitch <= _CLOSE_M + 1e-9 else 1 for pitch in (pitch_x, pitch_y))
    firsts = _spread_indices(0, len(across_x) - 2 - carried, pitch_x, carried + 1)
    rows = _spread_indices(under - 1, len(across_y) - 1 - under, pitch_y, under + 1)
    foot_m = (under - 0.5) * pitch_y + _FOOT_END_M
    chairs = []
    for row in rows:
        y = (across_y[row] + across_y[row + 1]) / 2
        for first in firsts:
            x = across_x[first] + pitch_x / 2
            end_x = x + carried * pitch_x
            places = [(x, y + foot_m, foot_z), (x, y, foot_z), (x, y, top_z)]
            places += [(end_x, y, top_z), (end_x, y, foot_z), (end_x, y - foot_m, foot_z)]
            try:
                line_m = bent(places, diameter_m)
            except ValueError:
                raise InfeasibleError("a slab is too thin or its bars are too close for chairs") from None
            chairs.append(DesignBar(CHAIR, diameter_m, line_m, None, False, Z))
    middle_x = tuple(across_x[first] + (1 + carried) / 2 * pitch_x for first in firsts)
    middle_y = tuple((across_y[row] + across_y[row + 1]) / 2 for row in rows)
    return chairs, (middle_x, middle_y), {row + n for row in rows for n in range(1 - under, under + 1)}


def _spread_indices(first: int, last: int, step_m: float, least: int) -> list[int]:
    """Return indices from ``first`` to ``last``, about ``SUPPORT_SPACING_M`` and at least ``least`` steps apart.

    The first and the last one are left out if others remain. Raises ``InfeasibleError`` if only one fits.
    """
    if last - first >= least + 2:
        first, last = first + 1, last - 1
    if last - first < least:
        raise InfeasibleError("a slab has too few bars for chairs")
    intervals = min((last - first) // least, max(1, round((last - first) * step_m / SUPPORT_SPACING_M)))
    return [first + (last - first) * number // intervals for number in range(intervals + 1)]


# Pad footings: a mat whose bars are bent up at both ends, and the starters of a column with links.

EDGE = "edge"
_EDGE_DIAMETER_M = 0.010
_COLUMN_COVER_M = 0.030


def footing(rng: np.random.Generator, shape: str) -> Design:
    """Draw a pad footing; ends of bars that reach the top are held by bars along the edges."""
    cover_m = drawn_step(rng, *GROUND_COVER_M, 0.005)
    side_x_m, side_y_m = drawn_step(rng, 1.0, 2.2, 0.1), drawn_step(rng, 1.0, 2.2, 0.1)
    depth_m = drawn_step(rng, 0.35, 0.70, 0.05)
    bar_m = drawn_of(rng, [0.012, 0.016, 0.020])
    effective_m = depth_m - cover_m - bar_m / 2
    spacing_m = drawn_step(rng, 0.125, min(0.25, area_m2(bar_m) / (SLAB_STEEL[0] * effective_m)), 0.025)
    starter_m, link_m = drawn_of(rng, [0.016, 0.020, 0.025]), drawn_of(rng, [0.008, 0.010])
    column_m = drawn_step(rng, 0.30, 0.50, 0.05)
    low = cover_m + bar_m / 2
    second = low + contact_m(bar_m, bar_m)
    share = steel_share(area_m2(bar_m) / spacing_m, effective_m, SLAB_STEEL)
    bob_m = second + bend_radius_m(bar_m) + square_end_m(bar_m)
    up_m = bob_m if shape == "bobs" else depth_m - cover_m
    if bob_m > depth_m - cover_m:
        raise InfeasibleError("a footing is too shallow for the ends of its bars")
    half_x, half_y = side_x_m / 2 - low, side_y_m / 2 - low
    inset_m = bend_radius_m(bar_m) + 2 * contact_m(bar_m, bar_m)
    across_x = spaced(inset_m - half_x, half_x - inset_m, spacing_m)
    across_y = spaced(inset_m - half_y, half_y - inset_m, spacing_m)
    bars = _layers(bar_m, (half_x, half_y), (low, second), up_m, (across_x, across_y))
    if shape == "full-height":
        bars += _edge_bars(bar_m, half_x, half_y, up_m, second + bend_radius_m(bar_m))
    section = drawn_section(rng, starter_m, link_m, _COLUMN_COVER_M, column_m, column_m)
    starters_share = section.column_steel_share(section.count)
    foot_m = bend_radius_m(starter_m) + max(square_end_m(starter_m), spacing_m + 0.03)
    if section.half_m(starter_m)[1][0] + foot_m > min(half_x, half_y) - 0.03:
        raise InfeasibleError("a footing is too small for the feet of its starters")
    feet_z = low + contact_m(bar_m, starter_m), second + contact_m(bar_m, starter_m)
    top_z = depth_m + 0.02 + lap_m(starter_m)
    bars += _starters(section, foot_m, feet_z, top_z)
    first_z = feet_z[1] + bend_radius_m(starter_m) + 0.04
    if first_z > depth_m - 0.11:
        raise InfeasibleError("a footing is too shallow for the links of its starters")
    above_m = spaced(depth_m + 0.05, top_z - 0.05, DENSE * column_link_spacing_m(starter_m, column_m))
    bars += stirrups(section, [*spaced(first_z, depth_m - 0.05, 0.30), *above_m])
    drawn: dict[str, float | str] = {
        "shape": shape,
        "side_x_m": side_x_m,
        "side_y_m": side_y_m,
        "depth_m": depth_m,
        "cover_m": cover_m,
        "bar_m": bar_m,
        "starter_m": starter_m,
        "starters_x": float(section.bars_x),
        "starters_y": float(section.bars_y),
        "link_m": link_m,
        "spacing_m": spacing_m,
        "steel_share": share,
        "starters_steel_share": starters_share,
        "column_m": column_m,
    }
    supports_m = tuple(tuple(spaced(-half, half, SUPPORT_SPACING_M)) for half in (half_x, half_y))
    mat = Mat(LOWER, (0.0, 0.0, -1.0), depth_m, cover_m, (X, Y), supports_m)
    return Design("footing", tuple(bars), drawn, cover_m, (mat,))


def _layers(
    bar_m: float,
    half_m: tuple[float, float],
    levels_m: tuple[float, float],
    up_m: float,
    across_m: tuple[Sequence[float], Sequence[float]],
) -> list[DesignBar]:
    """Return bars along x and, above them, along y, whose ends are bent up to the height ``up_m``."""
    (half_x, half_y), (low, second), (across_x, across_y) = half_m, levels_m, across_m
    corners_x = [(-half_x, up_m), (-half_x, low), (half_x, low), (half_x, up_m)]
    corners_y = [(-half_y, up_m), (-half_y, second), (half_y, second), (half_y, up_m)]
    bars = [DesignBar(LOWER, bar_m, bent([(x, y, z) for x, z in corners_x], bar_m), Y, False, Z) for y in across_y]
    return bars + [
        DesignBar(UPPER, bar_m, bent([(x, y, z) for y, z in corners_y], bar_m), X, False, Z) for x in across_x
    ]


def _starters(section: Section, foot_m: float, feet_z: tuple[float, float], top_z: float) -> list[DesignBar]:
    """Return the starters of a column, whose feet point outwards.

    Feet along y lie on the lower bars of the mat, at ``feet_z[0]``, and those along x on the upper ones, at
    ``feet_z[1]``: each crosses the bars that it lies on.
    """
    bars = []
    for index, ((x, y), (inward_x, inward_y)) in enumerate(zip(section.places_m(), section.inward(), strict=True)):
        to_x, to_y = (-np.sign(inward_x), 0.0) if inward_x else (0.0, -np.sign(inward_y))
        z = feet_z[1] if inward_x else feet_z[0]
        corners = [(x + to_x * foot_m, y + to_y * foot_m, z), (x, y, z), (x, y, top_z)]
        bars.append(DesignBar(STARTER, section.bar_m, bent(corners, section.bar_m), None, index < 4, Z))
    return bars


def _edge_bars(bar_m: float, half_x: float, half_y: float, top_z: float, bend_z: float) -> list[DesignBar]:
    """Return bars along the four edges, inside of the ends of the bars that reach up to ``top_z``."""
    edge_m, bars = _EDGE_DIAMETER_M, []
    inside_m = contact_m(bar_m, edge_m)
    for z in [top_z - 0.05, (top_z + bend_z) / 2] if top_z - bend_z > 0.25 else [top_z - 0.05]:
        for sign in (1, -1):
            y, x = sign * (half_y - inside_m), sign * (half_x - inside_m)
            above = z + contact_m(edge_m, edge_m)
            bars.append(DesignBar(EDGE, edge_m, straight((-half_x, y, z), (half_x, y, z)), Z, False, Y))
            bars.append(DesignBar(EDGE, edge_m, straight((x, -half_y, above), (x, half_y, above)), Z, False, X))
    return bars
