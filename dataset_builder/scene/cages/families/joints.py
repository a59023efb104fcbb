"""Cages of joints of a beam with a column, which stands; at its end (corner) or through it (passing)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from dataset_builder.scene.cages.design import (
    LYING,
    STANDING_M,
    Design,
    DesignBar,
    InfeasibleError,
    X,
    Y,
    Z,
    cage_mats,
    drawn_of,
    drawn_step,
    rise_m,
    spaced,
    turned,
)
from dataset_builder.scene.cages.families.beams import (
    BOTTOM,
    SIDES_FROM_M,
    TOP,
    BeamLayout,
    beam_bars,
    beam_section,
    hook_reach_m,
)
from dataset_builder.scene.cages.families.columns import drawn_cover_m, drawn_section
from dataset_builder.scene.cages.rules import (
    CONTACT_GAP_M,
    DENSE,
    column_link_spacing_m,
    contact_m,
    link_diameters_m,
)
from dataset_builder.scene.cages.sections import LINK, Section, links_height_m, main_bars, stirrups, ties
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import Clearances

_PASSING_M = 0.002
"""Clear distance of links of a column from the bars of the beam that they pass."""

_BEHIND_M = 0.010
"""Clear distance of the hooks of a beam from the bars of a column in front of which they end."""


def joint(rng: np.random.Generator, shape: str) -> Design:
    """Draw a column with a beam that is anchored in it or passes it; ties that the beam would cut are left out."""
    bar_m = drawn_of(rng, [0.016, 0.020, 0.025])
    link_m = drawn_of(rng, link_diameters_m(bar_m))
    cover_m = drawn_cover_m(rng, (0.030, 0.050), link_m, bar_m)
    side_m = drawn_step(rng, 0.40, 0.60, 0.05)
    column = drawn_section(rng, bar_m, link_m, cover_m, side_m, side_m)
    share = column.column_steel_share(column.count)
    height_m, level_m = drawn_step(rng, 1.8, 2.6, 0.1), drawn_step(rng, 0.8, 1.2, 0.05)
    # All of the column is near its beam or a slab.
    spacing_m = drawn_step(rng, 0.08, DENSE * column_link_spacing_m(bar_m, side_m), 0.01)
    depth_m = drawn_step(rng, 0.35, SIDES_FROM_M - 0.05, 0.05)
    if level_m + depth_m + 0.3 > height_m:
        raise InfeasibleError("a column ends too close to its beam")
    beam, drawn = _beam(rng, column, shape, depth_m, level_m)
    standing = main_bars(column, height_m)
    steel = Clearances([bar.line_m for bar in beam], [outer_radius_m(bar.diameter_m) for bar in beam])
    if any(steel.least_m(bar.line_m, outer_radius_m(bar.diameter_m)) < CONTACT_GAP_M for bar in standing):
        raise InfeasibleError("bars of a beam meet those of its column")
    with_ties = column.needs_ties() or (bool(rng.random() < 0.4) and column.count > 4)
    rise = rise_m(stirrups(column, [0.0]))
    levels = _levels_past(beam, links_height_m(column, rise, with_ties=with_ties), height_m, spacing_m)
    held = ties(column, levels, rise) if with_ties else []
    kept = [bar for bar in held if steel.least_m(bar.line_m, outer_radius_m(bar.diameter_m)) > _PASSING_M]
    drawn |= {
        "shape": shape,
        "bar_m": bar_m,
        "link_m": link_m,
        "cover_m": cover_m,
        "side_x_m": side_m,
        "side_y_m": side_m,
        "bars_x": float(column.bars_x),
        "bars_y": float(column.bars_y),
        "length_m": height_m,
        "level_m": level_m,
        "spacing_m": spacing_m,
        "steel_share": share,
        "ties": float(with_ties),
        "ties_left_out": float(len(held) - len(kept)),
    }
    bars = (*standing, *stirrups(column, levels), *kept, *beam)
    return Design("joint", bars, drawn, STANDING_M, cage_mats(Z, cover_m, {X: side_m, Y: side_m}))


def _beam(
    rng: np.random.Generator, column: Section, shape: str, depth_m: float, level_m: float
) -> tuple[list[DesignBar], dict[str, float | str]]:
    """Return the bars of the beam along x, whose concrete is from z = ``level_m`` up, and what was drawn."""
    arm_m = drawn_step(rng, 0.8, 1.5, 0.1)
    width_m = drawn_step(rng, 0.20, min(column.side_x_m - 0.10, depth_m / 1.2), 0.05)
    bar_m = drawn_of(rng, [0.012, 0.016, 0.020])
    link_m = drawn_of(rng, [d for d in link_diameters_m(bar_m) if d <= 0.010])  # The cover suits all of these.
    if depth_m > 3 * width_m:
        raise InfeasibleError("the proportions of a beam do not fit")
    section = beam_section(rng, bar_m, link_m, column.cover_m, width_m, depth_m)
    face_m = column.side_x_m / 2
    if shape == "passing":
        start_m, is_anchored = -face_m - arm_m, False
    else:  # The hooks end in front of the farther bars of the column.
        start_m, is_anchored = _BEHIND_M + contact_m(column.bar_m, bar_m) - column.half_m(column.bar_m)[1][0], True
        start_m = round(start_m + hook_reach_m(section, BeamLayout(0.0, (True, False))), 4)
    layout = BeamLayout(round(face_m + arm_m - start_m, 4), (is_anchored, False), hogging=True)
    first_m = face_m + 0.05 - start_m
    bars, drawn = beam_bars(rng, section, layout, first_link_m=first_m)
    placed = turned(bars, LYING, (start_m, 0.0, level_m + depth_m / 2))
    if shape == "passing":  # The links of the other arm are those of the first one, mirrored.
        placed += [
            DesignBar(bar.role, bar.diameter_m, bar.line_m * [-1, 1, 1], bar.spaced_along, bar.is_structural)
            for bar in placed
            if bar.role == LINK
        ]
    return placed, {f"beam_{name}": value for name, value in drawn.items()} | {"arm_m": arm_m}


def _levels_past(
    beam: Sequence[DesignBar], reach_m: tuple[float, float], height_m: float, spacing_m: float
) -> list[float]:
    """Return levels of links between the ends of a column, and between the layers of the bars of the beam.

    ``reach_m`` is how far the steel of a level reaches below and above it. Raises ``InfeasibleError`` if there is
    no room between the layers.
    """
    limits_m = [0.05]
    for role in (BOTTOM, TOP):
        layer = [bar for bar in beam if bar.role == role]
        radius = outer_radius_m(layer[0].diameter_m) + _PASSING_M
        ends_m = [float(bar.line_m[-1, 2]) for bar in layer]  # The end that has no hook.
        limits_m += [min(ends_m) - radius - reach_m[1], max(ends_m) + radius + reach_m[0]]
    limits_m.append(height_m - 0.05)
    if any(high < low for low, high in pairwise(limits_m)):
        raise InfeasibleError("a joint has no room for the links of its column")
    return [
        level
        for low, high in zip(limits_m[::2], limits_m[1::2], strict=True)
        for level in spaced(low, high, spacing_m)
    ]
