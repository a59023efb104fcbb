"""Cages of columns (square, rectangular, round) and of bored piles. They stand on the ground, or lie on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.scene.cages.design import (
    LYING,
    STANDING_M,
    Design,
    DesignBar,
    InfeasibleError,
    Lap,
    X,
    Y,
    Z,
    cage_mats,
    drawn_of,
    drawn_step,
    lapped,
    link_levels_m,
    rise_m,
    steel_share,
    turned,
)
from dataset_builder.scene.cages.rules import (
    COLUMN_STEEL,
    COVER_M,
    DENSE,
    DIAMETERS_M,
    GROUND_COVER_M,
    PILE_CLEAR_M,
    area_m2,
    column_link_spacing_m,
    lap_link_spacing_m,
    least_clear_m,
    least_cover_m,
    least_pile_steel_m2,
    link_diameters_m,
    pile_cover_m,
)
from dataset_builder.scene.cages.sections import RoundSection, Section, bundled, main_bars, stirrups, ties

LYING_M = 2e-4
"""Height above the ground of the lowest steel of a cage that lies."""

MOST_CLEAR_M = 0.300
"""Largest distance of main bars of a column (common practice)."""

_EXTRAS = ("none", "none", "laps", "bundles")


def column(rng: np.random.Generator, shape: str) -> Design:
    """Draw a column: square, rectangular, round with ties, or round with a spiral; starters may be lapped."""
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.012 <= d <= 0.032])
    link_m = drawn_of(rng, link_diameters_m(bar_m))
    is_round = shape not in ("square", "rectangular")
    extra = str(rng.choice(_EXTRAS[:3] if is_round else _EXTRAS))
    covered_m = 2**0.5 * bar_m if extra == "bundles" else bar_m  # One bar of the same area (8.9.1 (2)).
    cover_m = drawn_cover_m(rng, COVER_M, link_m, covered_m)
    length_m = drawn_step(rng, 1.2, 3.0, 0.1)
    common: dict[str, float | str] = {"shape": shape, "bar_m": bar_m, "link_m": link_m, "cover_m": cover_m}
    common |= {"length_m": length_m, "extra": extra}
    if not is_round:
        return _rectangular(rng, shape, common)
    diameter_m = drawn_step(rng, 0.30, 0.80, 0.05)
    lap = _drawn_lap(rng, bar_m, link_m, extra)
    section = RoundSection(diameter_m, cover_m, link_m, bar_m)
    section = replace(section, bars=int(drawn_of(rng, section.counts(least_clear_m(bar_m), MOST_CLEAR_M))))
    share = steel_share(area_m2(bar_m, section.bars), section.concrete_m2, COLUMN_STEEL)
    most_m = column_link_spacing_m(bar_m, diameter_m)
    if shape == "spiral":  # Its pitch is the same everywhere, and a turn passes a lap's end (9.5.3 (4), 8.7.4.2).
        most_m = min(DENSE * most_m, min(lap_link_spacing_m(bar_m, link_m), 0.10) if lap else 0.15)
    spacing_m = drawn_step(rng, min(0.06, most_m), most_m, 0.01)
    bars: list[DesignBar] = section.main_bars(length_m)
    levels = link_levels_m(length_m, spacing_m, diameter_m, max(0.06, DENSE * spacing_m), lap)
    if lap is not None:
        bars = lapped(bars, [(-x, -y) for x, y in section.outward().tolist()], lap)
    bars += [section.spiral(length_m, spacing_m)] if shape == "spiral" else section.rings(levels)
    drawn = {**common, "diameter_m": diameter_m, "bars": float(section.bars), "spacing_m": spacing_m}
    drawn["steel_share"] = share
    drawn |= {} if lap is None else {"lap_start_m": lap.start_m}
    mats = cage_mats(Z, cover_m, dict.fromkeys((X, Y), diameter_m))
    return Design("column", tuple(bars), drawn, STANDING_M, mats)


def drawn_cover_m(rng: np.random.Generator, range_m: tuple[float, float], outer_m: float, inner_m: float) -> float:
    """Return a cover within a range that suits outer bars and those inside of them; a multiple of 5 mm."""
    return drawn_step(rng, max(range_m[0], least_cover_m(outer_m, inner_m)), range_m[1], 0.005)


def _drawn_lap(rng: np.random.Generator, bar_m: float, link_m: float, extra: str) -> Lap | None:
    """Return a lap that starts a little above the ground, or None."""
    return Lap(bar_m, link_m, drawn_step(rng, 0.01, 0.03, 0.01)) if extra == "laps" else None


def drawn_section(
    rng: np.random.Generator, bar_m: float, link_m: float, cover_m: float, side_x_m: float, side_y_m: float
) -> Section:
    """Return a section with a drawn number of bars, at most 0.3 m apart. Raises ``InfeasibleError``."""
    section = Section(side_x_m, side_y_m, cover_m, link_m, bar_m, 2, 2)
    counts = []
    for half_m in section.half_m(bar_m)[0]:
        least = max(2, 1 + int(np.ceil(2 * half_m / MOST_CLEAR_M)))
        counts.append(least + int(rng.integers(0, 3)))
    section = replace(section, bars_x=counts[0], bars_y=counts[1])
    section.check()
    return section


def _rectangular(rng: np.random.Generator, shape: str, common: dict[str, float | str]) -> Design:
    bar_m, link_m, cover_m, length_m = (float(common[name]) for name in ("bar_m", "link_m", "cover_m", "length_m"))
    side_x_m = drawn_step(rng, 0.25, 0.60, 0.05)
    side_y_m = side_x_m if shape == "square" else drawn_step(rng, 0.25, 0.80, 0.05)
    if shape == "rectangular" and side_x_m == side_y_m:
        raise InfeasibleError("a rectangular section is square")
    extra = str(common["extra"])
    section = drawn_section(rng, bar_m, link_m, cover_m, side_x_m, side_y_m)
    share = section.column_steel_share(section.count + (4 if extra == "bundles" else 0))
    spacing_m = drawn_step(rng, 0.08, column_link_spacing_m(bar_m, min(side_x_m, side_y_m)), 0.01)
    lap = _drawn_lap(rng, bar_m, link_m, extra)
    levels = link_levels_m(length_m, spacing_m, max(side_x_m, side_y_m), max(0.08, DENSE * spacing_m), lap)
    links = stirrups(section, levels)
    bars = main_bars(section, length_m)
    if lap is not None:
        bars = lapped(bars, section.inward(), lap)
    elif extra == "bundles":
        bars = bundled(bars, section)
    with_ties = section.needs_ties() or (bool(rng.random() < 0.4) and section.count > 4)
    bars += [*links, *(ties(section, levels, rise_m(links)) if with_ties else [])]
    drawn = {
        **common,
        "side_x_m": side_x_m,
        "side_y_m": side_y_m,
        "bars_x": float(section.bars_x),
        "bars_y": float(section.bars_y),
        "spacing_m": spacing_m,
        "ties": float(with_ties),
        "steel_share": share,
    }
    drawn |= {} if lap is None else {"lap_start_m": lap.start_m}
    mats = cage_mats(Z, cover_m, {X: side_x_m, Y: side_y_m})
    return Design("column", tuple(bars), drawn, STANDING_M, mats)


def pile_cage(rng: np.random.Generator, shape: str) -> Design:
    """Draw the cage of a bored pile, with a spiral or rings and stiffeners inside; it lies, or stands."""
    diameter_m = drawn_step(rng, 0.40, 1.00, 0.05)
    bar_m = drawn_of(rng, [d for d in DIAMETERS_M if 0.016 <= d <= 0.040])
    link_m = drawn_of(rng, link_diameters_m(bar_m))
    cover_m = drawn_cover_m(rng, (pile_cover_m(diameter_m), GROUND_COVER_M[1]), link_m, bar_m)
    section = RoundSection(diameter_m, cover_m, link_m, bar_m)
    section = replace(section, bars=int(drawn_of(rng, section.counts(*PILE_CLEAR_M))))
    least_share = least_pile_steel_m2(section.concrete_m2) / section.concrete_m2
    share = steel_share(area_m2(bar_m, section.bars), section.concrete_m2, (least_share, COLUMN_STEEL[1]))
    length_m = drawn_step(rng, 2.0, 4.5, 0.1)
    pitch_m = drawn_step(rng, 0.12, min(0.25, column_link_spacing_m(bar_m, diameter_m)), 0.01)
    bars = section.main_bars(length_m)
    bars += (
        [section.spiral(length_m, pitch_m)]
        if shape == "spiral"
        else section.rings(link_levels_m(length_m, pitch_m, 0.0, pitch_m))
    )
    stiffener_m = drawn_of(rng, [0.012, 0.016] if diameter_m < 0.6 else [0.016, 0.020, 0.025])
    bars += section.stiffeners(np.linspace(0.3, length_m - 0.3, 2 + int(length_m / 1.5)).tolist(), stiffener_m)
    lies = bool(rng.random() < 0.7) or length_m > 4 * diameter_m
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
        "steel_share": share,
        "lies": float(lies),
    }
    # A cage that lies rests on the ground.
    axis, across = (X, (Y,)) if lies else (Z, (X, Y))
    mats = cage_mats(axis, cover_m, dict.fromkeys(across, diameter_m))
    return Design("pile-cage", tuple(bars), drawn, LYING_M if lies else STANDING_M, mats)
