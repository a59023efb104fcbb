"""Rules for reinforcement: diameters, clear distances, covers, laps, hooks, spacings. Lengths in metres.

The values are the recommended ones of EN 1992-1-1:2004 (design) for concrete C30/37 and steel B500, those of
EN 1536 (bored piles), and the nominal sizes of EN 10080:2005, table 6. They were taken from secondary sources, not
from the text of the standards. Clauses without a standard are those of EN 1992-1-1.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, pi

from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m

DIAMETERS_M = (0.006, 0.008, 0.010, 0.012, 0.014, 0.016, 0.020, 0.025, 0.028, 0.032, 0.040)
"""Nominal diameters of ribbed bars (EN 10080, table 6) from 6 to 40 mm."""

COVER_M = (0.020, 0.055)
"""Range of the nominal cover of members cast in formwork: 10 mm of tolerance and the minimum covers for durability
of the exposure classes X0 to XS3, structural class S4 (4.4.1)."""

GROUND_COVER_M = (0.040, 0.075)
"""Nominal cover of concrete cast on prepared ground, and directly on soil (4.4.1.3 (4))."""

AGGREGATE_M = 0.020
"""Largest size of the aggregate."""

CONTACT_GAP_M = 4e-4
"""Clear distance of bars that are tied to each other in a design, so that no surfaces coincide."""

LINK_SLACK_M = 0.003
"""Clear distance by which links are wider than the bars that they hold: links are bent to within 5 mm (tolerance
of BS 8666 for sides up to 1 m, from a secondary source)."""

COLUMN_STEEL, BEAM_STEEL, WALL_STEEL, SLAB_STEEL = (0.002, 0.04), (0.00151, 0.04), (0.002, 0.02), (0.00151, 0.04)
"""Least and largest areas of main bars per area of concrete (9.5.2, 9.2.1.1, 9.6.2, 9.3.1.1).

Those of beams and slabs are for the bars at the side in tension and the effective depth. Walls with more upright
steel would need links as columns do (9.6.4 (1)).
"""

OPPOSITE_STEEL, LINK_STEEL = 0.25, 0.00088
"""Least areas in a beam: bars at the other side per area of the main bars (9.2.1.2 (1), 9.2.1.4 (1)), and legs of
links per area of concrete between links (9.2.2 (5))."""

MOST_UNHELD_M = 0.150
"""Largest distance of a compressed bar of a column from one in the bend of a link or tie (9.5.3 (6))."""

DENSE = 0.6
"""Factor on the largest spacing of a column's links within its larger side from a beam or slab, and along laps of
bars over 14 mm (9.5.3 (4))."""

PILE_CLEAR_M = (0.100, 0.200)
"""Least and largest clear distance of a bored pile's bars (EN 1536, which also has 80 mm; 9.8.5 (3))."""


def contact_m(first_m: float, second_m: float) -> float:
    """Return the distance between the axes of two bars of these diameters that are tied to each other."""
    return outer_radius_m(first_m) + outer_radius_m(second_m) + CONTACT_GAP_M


def least_cover_m(outer_m: float, inner_m: float = 0.0) -> float:
    """Return the least cover of bars, with others inside of them: d, 10 mm, plus 10 mm (4.4.1.2, 4.4.1.3)."""
    return max(outer_m, 0.010, inner_m - outer_m) + 0.010


def pile_cover_m(diameter_m: float) -> float:
    """Return the least cover of a bored pile: 60 mm above a diameter of 0.6 m, else 50 mm (EN 1536)."""
    return 0.060 if diameter_m > 0.6 else 0.050


def least_clear_m(diameter_m: float) -> float:
    """Return the least clear distance of parallel bars: d, aggregate + 5 mm, 20 mm (8.2)."""
    return max(diameter_m, AGGREGATE_M + 0.005, 0.020)


def lap_m(diameter_m: float) -> float:
    """Return a lap length of 40 d, at least 200 mm (8.7.3, for common stresses and concretes)."""
    return max(40 * diameter_m, 0.200)


def least_lap_clear_m(diameter_m: float) -> float:
    """Return the least clear distance of adjacent laps: 2 d, and that of bars (8.7.2 (3))."""
    return max(2 * diameter_m, least_clear_m(diameter_m))


def lap_link_spacing_m(bar_m: float, link_m: float) -> float:
    """Return the largest spacing of links along a lap: 150 mm, half the bar's area in each outer third (8.7.4)."""
    count = ceil(bar_m**2 / 2 / link_m**2) if bar_m >= 0.020 else 1
    return min(lap_m(bar_m) / 3 / count, 0.150)


def hook_end_m(diameter_m: float) -> float:
    """Return the straight end of a link's hook of 135 degrees or more: 5 d, 50 mm (8.5)."""
    return max(5 * diameter_m, 0.050)


def area_m2(diameter_m: float, count: float = 1.0) -> float:
    """Return the nominal area of ``count`` bars."""
    return count * pi / 4 * diameter_m**2


def least_pile_steel_m2(concrete_m2: float) -> float:
    """Return the least area of main bars of a bored pile (9.8.5, table 9.6N)."""
    if concrete_m2 <= 0.5:
        return 0.005 * concrete_m2
    return max(0.0025, 0.0025 * concrete_m2)


def square_end_m(diameter_m: float) -> float:
    """Return the straight end of a bend of 90 degrees: 10 d, 70 mm (8.5)."""
    return max(10 * diameter_m, 0.070)


def inside_link_m(link_m: float, bar_m: float) -> float:
    """Return the distance between the axis of a link and that of a bar that it holds with ``LINK_SLACK_M``."""
    return contact_m(link_m, bar_m) + LINK_SLACK_M


def link_bend_m(link_m: float, bar_m: float) -> float:
    """Return the axis radius of a link's bends round a bar: that of the least mandrel, or the bar's size."""
    return max(bend_radius_m(link_m), inside_link_m(link_m, bar_m))


def link_diameters_m(bar_m: float) -> Sequence[float]:
    """Return the diameters of links round bars: 6 mm or a quarter of the bar (9.5.3), up to 16 mm."""
    return [d for d in DIAMETERS_M if max(0.006, bar_m / 4) <= d <= min(0.016, 0.75 * bar_m)]


def column_link_spacing_m(bar_m: float, side_m: float) -> float:
    """Return the largest spacing of links in a column: 20 d, its least side, 400 mm (9.5.3 (3))."""
    return min(20 * bar_m, side_m, 0.400)


def beam_link_spacing_m(depth_m: float) -> float:
    """Return the largest spacing of a beam's links, and of their legs: 0.75 effective depths (9.2.2 (6), (8))."""
    return 0.75 * depth_m


def slab_spacing_m(thickness_m: float) -> float:
    """Return the largest spacing of a slab's main bars: 3 h, 400 mm (9.3.1.1)."""
    return min(3 * thickness_m, 0.400)


def wall_spacing_m(thickness_m: float) -> float:
    """Return the largest spacing of a wall's vertical bars: 3 h, 400 mm (9.6.2)."""
    return min(3 * thickness_m, 0.400)
