"""Cages of beams, which lie along x on spacers, and of joints of a beam with a column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import ceil

import numpy as np

from dataset_builder.scene.cages.design import (
    LYING,
    STANDING_M,
    Design,
    DesignBar,
    InfeasibleError,
    Line,
    X,
    Y,
    Z,
    bent,
    cage_mats,
    drawn_of,
    drawn_step,
    rise_m,
    spaced,
    steel_share,
    straight,
    turned,
)
from dataset_builder.scene.cages.families.columns import drawn_cover_m, drawn_section
from dataset_builder.scene.cages.rules import (
    BEAM_STEEL,
    CONTACT_GAP_M,
    COVER_M,
    DENSE,
    DIAMETERS_M,
    LINK_STEEL,
    OPPOSITE_STEEL,
    area_m2,
    beam_link_spacing_m,
    column_link_spacing_m,
    contact_m,
    inside_link_m,
    least_clear_m,
    link_diameters_m,
    square_end_m,
)
from dataset_builder.scene.cages.sections import LINK, Section, links_height_m, main_bars, stirrups, ties
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m
from dataset_builder.scene.shapes.capsules import Clearances

BOTTOM, TOP, SIDE, SPACER = "bottom", "top", "side", "spacer"

SIDE_DIAMETER_M, SIDE_SPACING_M, SIDES_FROM_M = 0.012, 0.25, 0.6
"""Bars along the sides: diameter, largest spacing, and the least depth of beams that have them.

Deep beams need such bars (EN 1992-1-1, 7.3.3 (3)); the numbers are ours.
"""

_SPACER_SPACING_M = 1.0
_HOOK_STEP = 1.5
"""Distance between the ends of successive layers of hooked bars, in distances of touching bars."""


@dataclass(frozen=True)
class BeamLayout:
    """Layout of a beam: length, whether its bars have hooks at its start and its end, and its main bars.

    The main bars, in one or two layers, are those below, or above if a beam is ``hogging`` over a support.
    """

    length_m: float
    hooks: tuple[bool, bool]
    two_layers: bool = False
    hogging: bool = False


def beam(rng: np.random.Generator, shape: str) -> Design:
    """Draw a beam: one or two layers below, one above, side bars in deep beams, hooked or straight ends."""
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.012 <= d <= 0.032])
    link_m = drawn_of(rng, [d for d in link_diameters_m(bar_m) if d <= 0.012])
    cover_m = drawn_cover_m(rng, COVER_M, link_m, bar_m)
    width_m = drawn_step(rng, 0.20, 0.45, 0.05)
    depth_m = drawn_step(rng, max(0.30, 1.2 * width_m), min(0.80, 3 * width_m), 0.05)
    is_hooked, two_layers = shape == "hooked", bool(rng.random() < 0.3)
    if two_layers and depth_m < 0.45:
        raise InfeasibleError("the proportions of a beam do not fit")
    layout = BeamLayout(drawn_step(rng, 1.5, 4.0, 0.1), (is_hooked, is_hooked), two_layers)
    section = beam_section(rng, bar_m, link_m, cover_m, width_m, depth_m)
    bars, drawn = beam_bars(rng, section, layout, first_link_m=0.05)
    lying = turned(bars, LYING, (-layout.length_m / 2, 0.0, depth_m / 2))
    mats = cage_mats(X, cover_m, {Y: width_m, Z: depth_m})
    return Design("beam", tuple(lying), {"shape": shape, **drawn}, cover_m, mats)


def beam_section(
    rng: np.random.Generator, bar_m: float, link_m: float, cover_m: float, width_m: float, depth_m: float
) -> Section:
    """Return the section of a beam, which has bars along its upper and lower sides only."""
    return replace(drawn_section(rng, bar_m, link_m, cover_m, width_m, depth_m), bars_y=2)


def beam_bars(
    rng: np.random.Generator, section: Section, layout: BeamLayout, first_link_m: float
) -> tuple[list[DesignBar], dict[str, float | str]]:
    """Return the bars of a beam along z from 0 up, and what was drawn; its x is the width and its y the depth.

    The links start at ``first_link_m``. Raises ``InfeasibleError`` if the parts of the beam do not fit.
    """
    bar_m, width_m, depth_m, length_m = section.bar_m, section.side_x_m, section.side_y_m, layout.length_m
    role, other_role, side = (TOP, BOTTOM, 1.0) if layout.hogging else (BOTTOM, TOP, -1.0)
    outer = _layer_m(section, bar_m, section.bars_x, side)
    inner_m = outer[0][1] + (2 * contact_m(bar_m, _spacer_m(bar_m)) if layout.two_layers else 0.0)
    effective_m = depth_m / 2 + abs(float(np.mean([y for _, y, _ in outer])) + inner_m) / 2
    most_m = beam_link_spacing_m(effective_m)
    if 2 * section.link_half_m[0] > most_m:
        raise InfeasibleError("links of a beam need more than two legs")
    most_m = min(most_m, area_m2(section.link_m, 2) / (LINK_STEEL * width_m), 0.30)
    spacing_m = drawn_step(rng, 0.08, most_m, 0.01)
    steel_m2 = area_m2(bar_m, section.bars_x * (1 + layout.two_layers))
    share = steel_share(steel_m2, effective_m * width_m, BEAM_STEEL)
    others_m = [d for d in DIAMETERS_M if max(0.010, bar_m / 2) <= d <= bar_m]
    least_m2 = OPPOSITE_STEEL * steel_m2
    other_m = drawn_of(rng, [d for d in others_m if area_m2(d, section.bars_x) > least_m2])
    others = int(rng.integers(max(2, ceil(least_m2 / area_m2(other_m))), section.bars_x + 1))
    opposite = _layer_m(section, other_m, others, -side)
    links = stirrups(section, spaced(first_link_m, length_m - 0.05, spacing_m), corners=2)
    step_m = _HOOK_STEP * contact_m(bar_m, bar_m)
    bend_m = bend_radius_m(bar_m)  # Hooks bend beyond the ends, so that all links hold the bars.
    bars = [_bar(other_role, other_m, place, layout, bend_m) for place in opposite]
    if layout.two_layers:
        spacers = _spacers(section, links, outer[0][1])
        face_x = section.half_m(bar_m)[1][0]
        places = [(x, inner_m, abs(x) == face_x) for x in np.linspace(-face_x, face_x, section.bars_x).tolist()]
        bars += [*(_bar(role, bar_m, place, layout, bend_m + step_m) for place in places), *spacers]
    bars += [_bar(role, bar_m, place, layout, hook_reach_m(section, layout)) for place in outer]
    if depth_m >= SIDES_FROM_M:
        bars += _side_bars(section, layout, *sorted((inner_m, opposite[0][1])))
    drawn: dict[str, float | str] = {
        "bar_m": bar_m,
        "link_m": section.link_m,
        "cover_m": section.cover_m,
        "side_x_m": width_m,
        "side_y_m": depth_m,
        "length_m": length_m,
        "bars_x": float(section.bars_x),
        "other_bar_m": other_m,
        "other_bars_x": float(others),
        "spacing_m": spacing_m,
        "steel_share": share,
        "layers": 1.0 + layout.two_layers,
    }
    return [*bars, *links], drawn


def hook_reach_m(section: Section, layout: BeamLayout) -> float:
    """Return how far the farthest hooked bars reach beyond the ends of a beam."""
    layers = 1 + layout.two_layers
    return bend_radius_m(section.bar_m) + layers * _HOOK_STEP * contact_m(section.bar_m, section.bar_m)


def _layer_m(section: Section, bar_m: float, count: int, side: float) -> list[tuple[float, float, bool]]:
    """Return the places of bars along the upper (``side`` 1) or lower (-1) legs: x, y, and whether in a corner."""
    (corner_x, corner_y), (_, face_y) = section.half_m(bar_m)
    along_m = np.linspace(-corner_x, corner_x, count)
    if float(along_m[1] - along_m[0]) - bar_m < least_clear_m(bar_m):
        raise InfeasibleError("bars along a side are too close to each other")
    inner = [(x, side * face_y, False) for x in along_m[1:-1].tolist()]
    return [*((x, side * corner_y, True) for x in (-corner_x, corner_x)), *inner]


def _bar(role: str, bar_m: float, place: tuple[float, float, bool], layout: BeamLayout, out_m: float) -> DesignBar:
    x, y, is_corner = place
    return DesignBar(role, bar_m, _hooked((x, y), bar_m, layout, out_m), None if is_corner else X)


def _hooked(place: tuple[float, float], bar_m: float, layout: BeamLayout, out_m: float) -> Line:
    """Return a bar along the member, ``out_m`` longer at hooked ends, which are bent towards the other side."""
    x, y = place
    tip = y - np.sign(y) * (bend_radius_m(bar_m) + square_end_m(bar_m))
    if any(layout.hooks) and abs(tip) > abs(y) + bar_m / 2:
        raise InfeasibleError("a beam is too shallow for the hooks of its bars")
    ends = [-out_m if layout.hooks[0] else 0.0, layout.length_m + (out_m if layout.hooks[1] else 0.0)]
    line_m = [(x, y, ends[0]), (x, y, ends[1])]
    line_m = [(x, tip, ends[0])] * layout.hooks[0] + line_m + [(x, tip, ends[1])] * layout.hooks[1]
    return bent(line_m, bar_m)


def _spacer_m(bar_m: float) -> float:
    """Return the diameter of bars that keep two layers apart."""
    return min(d for d in DIAMETERS_M if d >= least_clear_m(bar_m))


def _spacers(section: Section, links: Sequence[DesignBar], below_m: float) -> list[DesignBar]:
    """Return bars across a layer at y = ``below_m``, beside links, which carry another layer."""
    spacer_m = _spacer_m(section.bar_m)
    y = below_m + contact_m(section.bar_m, spacer_m)
    half_m = section.link_half_m[0] - contact_m(section.link_m, spacer_m) - 0.003
    levels_m = [float(link.line_m[:, 2].mean()) for link in links]
    count = 2 + int((levels_m[-1] - levels_m[0]) / _SPACER_SPACING_M)
    chosen = np.linspace(1, len(links) - 2, count).round().astype(int)
    beside_m = rise_m(links) + contact_m(section.link_m, spacer_m)
    return [
        DesignBar(
            SPACER,
            spacer_m,
            straight((-half_m, y, levels_m[index] + beside_m), (half_m, y, levels_m[index] + beside_m)),
            Z,
            False,
            Y,
        )
        for index in sorted(set(chosen.tolist()))
    ]


def _side_bars(section: Section, layout: BeamLayout, low_m: float, high_m: float) -> list[DesignBar]:
    """Return bars along both sides between layers at y = ``low_m`` and ``high_m``, inside of hooks at the ends."""
    x = section.link_half_m[0] - inside_link_m(section.link_m, SIDE_DIAMETER_M)
    start_m, end_m = (0.03 if is_hooked else 0.0 for is_hooked in layout.hooks)
    return [
        DesignBar(
            SIDE,
            SIDE_DIAMETER_M,
            straight((sign * x, y, start_m), (sign * x, y, layout.length_m - end_m)),
            is_structural=False,
        )
        for y in spaced(low_m, high_m, SIDE_SPACING_M)[1:-1]
        for sign in (1, -1)
    ]


# Joints of a beam with a column, which stands; at its end (corner) or through it (passing).

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
