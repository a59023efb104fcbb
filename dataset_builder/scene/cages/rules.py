"""Rules for reinforcement: diameters, clear distances, covers, laps, hooks, spacings. Lengths in metres.

The values are the recommended ones of EN 1992-1-1:2004 (design) and the nominal sizes of EN 10080:2005, table 6.
They were taken from secondary sources, not from the text of the standards.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m

DIAMETERS_M = (0.006, 0.008, 0.010, 0.012, 0.014, 0.016, 0.020, 0.025, 0.028, 0.032, 0.040)
"""Nominal diameters of ribbed bars (EN 10080, table 6) from 6 to 40 mm."""

COVER_M = (0.020, 0.055)
"""Range of the nominal cover of members cast in formwork: 10 mm of tolerance and the minimum covers for durability
of the exposure classes X0 to XS3, structural class S4 (EN 1992-1-1, 4.4.1)."""

GROUND_COVER_M = (0.040, 0.075)
"""Nominal cover of concrete cast on prepared ground, and directly on soil (EN 1992-1-1, 4.4.1.3 (4))."""

AGGREGATE_M = 0.020
"""Largest size of the aggregate."""

CONTACT_GAP_M = 4e-4
"""Clear distance of bars that are tied to each other in a design, so that no surfaces coincide."""


LINK_SLACK_M = 0.003
"""Clear distance by which links are wider than the bars that they hold: links are bent to within 5 mm (tolerance
of BS 8666 for sides up to 1 m, from a secondary source)."""


COLUMN_STEEL, BEAM_STEEL, WALL_STEEL, SLAB_STEEL = (0.002, 0.04), (0.0015, 0.04), (0.002, 0.04), (0.0013, 0.04)
"""Least and largest areas of main bars per area of concrete (EN 1992-1-1, 9.5.2, 9.2.1.1, 9.6.2, 9.3.1.1).

Those of beams and slabs are for the bars at the side in tension and the effective depth; the least area of beams
is that of concrete C30/37.
"""

MOST_UNHELD_M = 0.150
"""Largest distance of a compressed bar of a column from one in the bend of a link or tie (EN 1992-1-1, 9.5.3)."""

CRANK_SLOPE = 1 / 6
"""Slope at which a bar is bent sideways to lap with another one (ACI 318-19, 10.7.4.1; secondary source)."""


def contact_m(first_m: float, second_m: float) -> float:
    """Return the distance between the axes of two bars of these diameters that are tied to each other."""
    return outer_radius_m(first_m) + outer_radius_m(second_m) + CONTACT_GAP_M


def least_clear_m(diameter_m: float) -> float:
    """Return the least clear distance of parallel bars: d, aggregate + 5 mm, 20 mm (EN 1992-1-1, 8.2)."""
    return max(diameter_m, AGGREGATE_M + 0.005, 0.020)


def lap_m(diameter_m: float) -> float:
    """Return a lap length of 40 d, at least 200 mm (EN 1992-1-1, 8.7.3, for common stresses and concretes)."""
    return max(40 * diameter_m, 0.200)


def hook_end_m(diameter_m: float) -> float:
    """Return the straight end of a link's hook of 135 degrees or more: 5 d, 50 mm (EN 1992-1-1, 8.5)."""
    return max(5 * diameter_m, 0.050)


def area_m2(diameter_m: float, count: float = 1.0) -> float:
    """Return the nominal area of ``count`` bars."""
    return count * pi / 4 * diameter_m**2


def least_pile_steel_m2(concrete_m2: float) -> float:
    """Return the least area of main bars of a bored pile (EN 1992-1-1, 9.8.5, table 9.6N)."""
    if concrete_m2 <= 0.5:
        return 0.005 * concrete_m2
    return max(0.0025, 0.0025 * concrete_m2)


def square_end_m(diameter_m: float) -> float:
    """Return the straight end of a bend of 90 degrees: 10 d, 70 mm (EN 1992-1-1, 8.5)."""
    return max(10 * diameter_m, 0.070)


def inside_link_m(link_m: float, bar_m: float) -> float:
    """Return the distance between the axis of a link and that of a bar that it holds with ``LINK_SLACK_M``."""
    return contact_m(link_m, bar_m) + LINK_SLACK_M


def link_bend_m(link_m: float, bar_m: float) -> float:
    """Return the axis radius of a link's bends round a bar: that of the least mandrel, or the bar's size."""
    return max(bend_radius_m(link_m), inside_link_m(link_m, bar_m))


def link_diameters_m(bar_m: float) -> Sequence[float]:
    """Return the diameters of links round bars: 6 mm or a quarter of the bar (EN 1992-1-1, 9.5.3), up to 16 mm."""
    return [d for d in DIAMETERS_M if max(0.006, bar_m / 4) <= d <= min(0.016, 0.75 * bar_m)]


def column_link_spacing_m(bar_m: float, side_m: float) -> float:
    """Return the largest spacing of links in a column: 20 d, its least side, 400 mm (EN 1992-1-1, 9.5.3)."""
    return min(20 * bar_m, side_m, 0.400)


def beam_link_spacing_m(depth_m: float) -> float:
    """Return the largest spacing of vertical links in a beam: 0.75 of the effective depth (EN 1992-1-1, 9.2.2)."""
    return 0.75 * 0.9 * depth_m


def slab_spacing_m(thickness_m: float) -> float:
    """Return the largest spacing of a slab's main bars: 3 h, 400 mm (EN 1992-1-1, 9.3.1.1)."""
    return min(3 * thickness_m, 0.400)


def wall_spacing_m(thickness_m: float) -> float:
    """Return the largest spacing of a wall's vertical bars: 3 h, 400 mm (EN 1992-1-1, 9.6.2)."""
    return min(3 * thickness_m, 0.400)
