"""Cages of beams, and of joints of a beam with a column. Beams lie along x, on spacers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.scene.cages.clearance import Clearances
from dataset_builder.scene.cages.design import (
    LYING,
    Design,
    DesignBar,
    InfeasibleError,
    Line,
    bent,
    drawn_of,
    drawn_step,
    spaced,
    straight,
    turned,
)
from dataset_builder.scene.cages.families.columns import STANDING_M, drawn_section
from dataset_builder.scene.cages.members import LINK, MAIN, SIDE, Section, main_bars, stirrups
from dataset_builder.scene.cages.rules import (
    COVER_M,
    DIAMETERS_M,
    beam_link_spacing_m,
    column_link_spacing_m,
    contact_m,
    inside_link_m,
    least_clear_m,
    link_diameters_m,
    radius_m,
    square_end_m,
)
from dataset_builder.scene.shapes.bending import bend_radius_m

BOTTOM, TOP = "bottom", "top"
_MAX_LEFT_OUT = 0.4
"""Largest share of a column's links that a joint may leave out where the beam passes."""


def beam(rng: np.random.Generator) -> Design:
    """Draw a beam: one or two layers below, one above, side bars in deep beams, hooked or straight ends."""
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.012 <= d <= 0.032])
    link_m = drawn_of(rng, [d for d in link_diameters_m(bar_m) if d <= 0.012])
    cover_m = drawn_step(rng, *COVER_M, 0.005)
    width_m, depth_m = drawn_step(rng, 0.20, 0.45, 0.05), drawn_step(rng, 0.30, 0.80, 0.05)
    length_m = drawn_step(rng, 1.5, 4.0, 0.1)
    is_hooked = bool(rng.random() < 0.6)
    two_layers = bool(rng.random() < 0.3)
    section = _beam_section(rng, bar_m, link_m, cover_m, width_m, depth_m)
    bars, drawn = _beam_bars(rng, section, length_m, is_hooked=is_hooked, two_layers=two_layers)
    return Design("beam", tuple(bars), drawn, cover_m)


def _beam_bars(
    rng: np.random.Generator,
    section: Section,
    length_m: float,
    *,
    is_hooked: bool,
    two_layers: bool,
) -> tuple[list[DesignBar], dict[str, float | str]]:
    """Return the bars of a beam along x, centred in x and y, whose concrete is from z = 0 up, and what was drawn.

    The x of the section is the width of the beam, its y the depth.
    """
    bar_m, link_m, width_m, depth_m = section.bar_m, section.link_m, section.side_x_m, section.side_y_m
    if depth_m > 3 * width_m or (two_layers and depth_m < 0.45):
        raise InfeasibleError("the proportions of a beam do not fit")
    spacing_m = drawn_step(rng, 0.08, min(beam_link_spacing_m(depth_m), 0.30), 0.01)
    links = stirrups(section, spaced(0.05, length_m - 0.05, spacing_m))
    places = section.bar_positions_m()

    def line(x: float, y: float, behind: float) -> Line:
        out_m = behind * contact_m(bar_m, bar_m)
        return _hooked(x, y, bar_m, length_m, out_m) if is_hooked else straight((x, y, 0.0), (x, y, length_m))

    if two_layers:
        lift_m = bar_m + least_clear_m(bar_m)
        places += [(x, y + lift_m) for x, y in places if y < 0]
    bars = [
        # The hooks of lower bars stand behind those of upper ones, and those along a side behind those of corners.
        DesignBar(TOP, bar_m, line(x, y, 1.5 * (index >= 4)))
        if y > 0
        else DesignBar(BOTTOM, bar_m, line(x, y, 3.0 + 1.5 * (index >= 4)))
        for index, (x, y) in enumerate(places)
    ]
    side_m = 0.012
    if depth_m >= 0.6:  # Skin reinforcement of deep beams (EN 1992-1-1, 7.3.3 (3)).
        x = section.link_half_m[0] - inside_link_m(link_m, side_m)
        for y in np.linspace(-depth_m / 2, depth_m / 2, 2 + int(depth_m / 0.25))[1:-1].tolist():
            bars += [
                DesignBar(SIDE, side_m, straight((sign * x, y, 0.0), (sign * x, y, length_m)), is_structural=False)
                for sign in (1, -1)
            ]
    drawn: dict[str, float | str] = {
        "shape": "hooked" if is_hooked else "straight",
        "bar_m": bar_m,
        "link_m": link_m,
        "cover_m": section.cover_m,
        "side_x_m": width_m,
        "side_y_m": depth_m,
        "length_m": length_m,
        "bars_x": float(section.bars_x),
        "spacing_m": spacing_m,
        "layers": 1.0 + two_layers,
    }
    return turned([*bars, *links], LYING, (-length_m / 2, 0.0, depth_m / 2)), drawn


def _beam_section(
    rng: np.random.Generator, bar_m: float, link_m: float, cover_m: float, width_m: float, depth_m: float
) -> Section:
    """Return the section of a beam, which has bars along its upper and lower sides only."""
    return replace(drawn_section(rng, bar_m, link_m, cover_m, width_m, depth_m), bars_y=2)


def _hooked(x: float, y: float, bar_m: float, length_m: float, out_m: float) -> Line:
    """Return a bar along the member, ``out_m`` longer at both ends, which are bent towards the other face."""
    inward = -1.0 if y > 0 else 1.0
    reach_m = bend_radius_m(bar_m) + square_end_m(bar_m)
    if reach_m > 2 * abs(y) - 2 * contact_m(bar_m, bar_m):
        raise InfeasibleError("a beam is too shallow for the hooks of its bars")
    tip = y + inward * reach_m
    return bent([(x, tip, -out_m), (x, y, -out_m), (x, y, length_m + out_m), (x, tip, length_m + out_m)], bar_m)


def joint(rng: np.random.Generator) -> Design:
    """Draw a column with a beam anchored in it; links of the column that the beam would cut are left out."""
    bar_m = drawn_of(rng, [0.016, 0.020, 0.025])
    link_m = drawn_of(rng, link_diameters_m(bar_m))
    cover_m = drawn_step(rng, 0.03, 0.05, 0.005)
    side_m = drawn_step(rng, 0.40, 0.60, 0.05)
    column = drawn_section(rng, bar_m, link_m, cover_m, side_m, side_m)
    height_m, level_m = drawn_step(rng, 1.8, 2.6, 0.1), drawn_step(rng, 0.8, 1.2, 0.05)
    spacing_m = drawn_step(rng, 0.08, column_link_spacing_m(bar_m, side_m), 0.01)
    width_m = drawn_step(rng, 0.20, side_m - 0.10, 0.05)
    depth_m, length_m = drawn_step(rng, 0.35, 0.60, 0.05), drawn_step(rng, 1.2, 2.0, 0.1)
    beam_bar_m = drawn_of(rng, [0.012, 0.016, 0.020])
    beam_link_m = drawn_of(rng, [d for d in link_diameters_m(beam_bar_m) if d <= 0.010])
    section = _beam_section(rng, beam_bar_m, beam_link_m, cover_m, width_m, depth_m)
    beam_bars, drawn = _beam_bars(rng, section, length_m, is_hooked=True, two_layers=False)
    # The beam's far hooks are in the column, behind its axis; its links begin at the column's face.
    start_m = column.link_half_m[0] - column.corner_inset_m - contact_m(bar_m, beam_bar_m) - 0.02
    shift_m = (length_m / 2 - start_m, 0.0, level_m)
    beam_bars = [
        bar
        for bar in turned(beam_bars, np.eye(3), shift_m)
        if bar.role != LINK or bar.line_m[:, 0].min() > side_m / 2 + 0.02
    ]
    standing = main_bars(column, height_m, MAIN)
    fixed = Clearances(
        [bar.line_m for bar in (*standing, *beam_bars)],
        [radius_m(bar.diameter_m) for bar in (*standing, *beam_bars)],
    )
    links = stirrups(column, spaced(0.05, height_m - 0.05, spacing_m))
    kept = [bar for bar in links if fixed.least_m(bar.line_m, radius_m(link_m)) > 0]
    if len(kept) < (1 - _MAX_LEFT_OUT) * len(links):
        raise InfeasibleError("the beam of a joint leaves too few links of its column")
    drawn = {f"beam_{name}": value for name, value in drawn.items()} | {
        "shape": "corner",
        "bar_m": bar_m,
        "link_m": link_m,
        "cover_m": cover_m,
        "side_x_m": side_m,
        "side_y_m": side_m,
        "length_m": height_m,
        "level_m": level_m,
        "spacing_m": spacing_m,
        "links_left_out": float(len(links) - len(kept)),
    }
    return Design("joint", (*standing, *kept, *beam_bars), drawn, STANDING_M)
