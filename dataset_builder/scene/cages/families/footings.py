"""Cages of pad footings: a mat whose bars are bent up at both ends, and the starters of a column with links."""

from __future__ import annotations

from collections.abc import Sequence

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
from dataset_builder.scene.cages.families.columns import drawn_section
from dataset_builder.scene.cages.rules import (
    DENSE,
    GROUND_COVER_M,
    SLAB_STEEL,
    area_m2,
    column_link_spacing_m,
    contact_m,
    lap_m,
    square_end_m,
)
from dataset_builder.scene.cages.sections import Section, stirrups
from dataset_builder.scene.shapes.bending import bend_radius_m

LOWER, UPPER, EDGE = "lower", "upper", "edge"
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
