"""Cages of columns (square, rectangular, round) and of bored piles. They stand on the ground, or lie on it."""

from __future__ import annotations

import numpy as np

from dataset_builder.scene.cages.design import LYING, Design, DesignBar, drawn_of, drawn_step, turned
from dataset_builder.scene.cages.members import (
    RoundSection,
    Section,
    bundled,
    lapped,
    link_levels_m,
    main_bars,
    rise_m,
    stirrups,
    ties,
)
from dataset_builder.scene.cages.rules import (
    COVER_M,
    DIAMETERS_M,
    GROUND_COVER_M,
    column_link_spacing_m,
    lap_m,
    link_diameters_m,
)

STANDING_M = 5e-5
"""Height of the ends of standing bars above z = 0, so that they do not coincide with the ground."""

MOST_CLEAR_PILE_M = 0.200
"""Largest clear distance of the bars of a bored pile along its periphery (EN 1992-1-1, 9.8.5)."""


def column(rng: np.random.Generator) -> Design:
    """Draw a column: square, rectangular, round with ties, or round with a spiral; starters may be lapped."""
    shape = str(rng.choice(["square", "rectangular", "round-ties", "spiral"]))
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.012 <= d <= 0.032])
    link_m = drawn_of(rng, link_diameters_m(bar_m))
    cover_m = drawn_step(rng, *COVER_M, 0.005)
    length_m = drawn_step(rng, 1.2, 3.0, 0.1)
    common: dict[str, float | str] = {"shape": shape, "bar_m": bar_m, "link_m": link_m, "cover_m": cover_m}
    common |= {"length_m": length_m}
    if shape in ("square", "rectangular"):
        return _rectangular(rng, shape, common)
    side_m = drawn_step(rng, 0.30, 0.80, 0.05)
    section = RoundSection(side_m, cover_m, link_m, bar_m, int(rng.integers(6, 15)))
    section.check(0.300)
    most_m = min(column_link_spacing_m(bar_m, side_m), 0.15 if shape == "spiral" else 0.4)
    spacing_m = drawn_step(rng, 0.06, most_m, 0.01)
    bars: list[DesignBar] = section.main_bars(length_m)
    if shape == "spiral":
        bars.append(section.spiral(length_m, spacing_m))
    else:
        bars += section.rings(link_levels_m(length_m, spacing_m, side_m, max(0.06, 0.6 * spacing_m)))
    drawn = {**common, "diameter_m": side_m, "bars": float(section.bars), "spacing_m": spacing_m}
    return Design("column", tuple(bars), drawn, STANDING_M)


def drawn_section(
    rng: np.random.Generator, bar_m: float, link_m: float, cover_m: float, side_x_m: float, side_y_m: float
) -> Section:
    """Return a section with a drawn number of bars, at most 0.3 m apart. Raises ``InfeasibleError``."""
    empty = Section(side_x_m, side_y_m, cover_m, link_m, bar_m, 2, 2)
    counts = []
    for half_m in empty.link_half_m:
        span_m = 2 * (half_m - empty.corner_inset_m)
        least = max(2, 1 + int(np.ceil(span_m / 0.30)))
        counts.append(least + int(rng.integers(0, 3)))
    section = Section(side_x_m, side_y_m, cover_m, link_m, bar_m, counts[0], counts[1])
    section.check()
    return section


def _rectangular(rng: np.random.Generator, shape: str, common: dict[str, float | str]) -> Design:
    bar_m, link_m, cover_m, length_m = (float(common[name]) for name in ("bar_m", "link_m", "cover_m", "length_m"))
    side_x_m = drawn_step(rng, 0.25, 0.60, 0.05)
    side_y_m = side_x_m if shape == "square" else drawn_step(rng, 0.25, 0.80, 0.05)
    section = drawn_section(rng, bar_m, link_m, cover_m, side_x_m, side_y_m)
    spacing_m = drawn_step(rng, 0.08, column_link_spacing_m(bar_m, min(side_x_m, side_y_m)), 0.01)
    levels = link_levels_m(length_m, spacing_m, max(side_x_m, side_y_m), max(0.08, 0.6 * spacing_m))
    links = stirrups(section, levels)
    bars = main_bars(section, length_m)
    extra = str(rng.choice(["none", "none", "laps", "bundles"]))
    if extra == "laps":
        bars = lapped(bars, drawn_step(rng, 0.0, max(0.0, length_m - 2.1 * lap_m(bar_m)), 0.05))
    elif extra == "bundles":
        bars = bundled(bars, section)
    with_ties = bool(rng.random() < 0.6) and max(section.bars_x, section.bars_y) > 2
    bars += [*links, *(ties(section, levels, rise_m(links)) if with_ties else [])]
    drawn = {
        **common,
        "side_x_m": side_x_m,
        "side_y_m": side_y_m,
        "bars_x": float(section.bars_x),
        "bars_y": float(section.bars_y),
        "spacing_m": spacing_m,
        "extra": extra,
        "ties": float(with_ties),
    }
    return Design("column", tuple(bars), drawn, STANDING_M)


def pile_cage(rng: np.random.Generator) -> Design:
    """Draw the cage of a bored pile, with a spiral or rings and stiffeners inside; it lies, or stands."""
    diameter_m = drawn_step(rng, 0.40, 1.00, 0.05)
    cover_m = drawn_step(rng, *GROUND_COVER_M, 0.005)
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.016 <= d <= 0.040])
    link_m = drawn_of(rng, link_diameters_m(bar_m))
    section = RoundSection(diameter_m, cover_m, link_m, bar_m, int(rng.integers(6, 19)))
    section.check(MOST_CLEAR_PILE_M)
    length_m = drawn_step(rng, 2.0, 4.5, 0.1)
    shape = str(rng.choice(["spiral", "rings"]))
    pitch_m = drawn_step(rng, 0.10, 0.25, 0.01)
    bars = section.main_bars(length_m)
    bars += (
        [section.spiral(length_m, pitch_m)]
        if shape == "spiral"
        else section.rings(link_levels_m(length_m, pitch_m, 0.0, pitch_m))
    )
    stiffener_m = drawn_of(rng, [0.012, 0.016, 0.020])
    bars += section.stiffeners(np.linspace(0.3, length_m - 0.3, 2 + int(length_m / 1.5)).tolist(), stiffener_m)
    lies = bool(rng.random() < 0.7)
    if lies:
        bars = turned(bars, LYING, (-length_m / 2, 0.0, 0.0))
    drawn: dict[str, float | str] = {
        "shape": shape,
        "diameter_m": diameter_m,
        "cover_m": cover_m,
        "bar_m": bar_m,
        "link_m": link_m,
        "bars": float(section.bars),
        "length_m": length_m,
        "spacing_m": pitch_m,
        "stiffener_m": stiffener_m,
        "lies": float(lies),
    }
    return Design("pile-cage", tuple(bars), drawn, 2e-4 if lies else STANDING_M)
