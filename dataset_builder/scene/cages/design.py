"""Design of a cage: its bars along their nominal axes, helpers to draw them, levels of links, and laps. Metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.rules import CRANK_SLOPE, contact_m, lap_m
from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m

Line = Float64[ndarray, "n 3"]
Direction = tuple[float, float, float]
X: Direction = (1.0, 0.0, 0.0)
Y: Direction = (0.0, 1.0, 0.0)
Z: Direction = (0.0, 0.0, 1.0)

STANDING_M = 5e-5
"""Height of the ends of standing bars above z = 0, so that they do not coincide with the ground."""


LEAST_COVER_M = 0.008
"""Least height of the steel of a cage on spacers as built, above z = 0 and the base of its formwork."""

SUPPORT_SPACING_M = 0.7
"""Largest distance of the chairs or spacers of a mat, about that of practice."""


class InfeasibleError(ValueError):
    """Raised for drawn parameters with which no cage can be made; the message is the reason, without numbers."""


@dataclass(frozen=True, eq=False)
class DesignBar:
    """Bar of a design: role, nominal diameter and nominal axis.

    ``spaced_along`` is the unit vector along which bars of its kind are spaced, or None: only in this direction
    may it be off by the tolerance of the spacing. ``is_structural`` bars are never left out. ``held_along`` is the
    unit vector along which a bar is held by those that it rests on or is tied to, or None: it is neither displaced
    along it nor tilted out of the plane perpendicular to it, other than with its mat.
    """

    role: str
    diameter_m: float
    line_m: Line
    spaced_along: Direction | None = None
    is_structural: bool = True
    held_along: Direction | None = None


@dataclass(frozen=True)
class Mat:
    """Part of a design that is off through the thickness of its member as one: a mat, or a whole cage.

    ``outward`` is the unit vector to the face from which the cover is measured, ``thickness_m`` the size of the
    member along it. ``axes`` are the directions along which the deviation varies. ``supports_m`` are the places
    along each of them of chairs or spacers, between which a mat sags; none for a cage, which is stiff and has a
    face at either side. Steel between two mats follows both: ``between_m`` are the places along ``outward`` up to
    which it does not follow this one, and from which on it follows only this one (None: all steel does).
    """

    name: str
    outward: Direction
    thickness_m: float
    cover_m: float
    axes: tuple[Direction, ...]
    supports_m: tuple[tuple[float, ...], ...] = ()
    between_m: tuple[float, float] | None = None

    def weights(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return the shares in which steel at these points follows the mat."""
        if self.between_m is None:
            return np.ones(len(points_m))
        return np.asarray(np.interp(points_m @ np.array(self.outward), self.between_m, (0.0, 1.0)))


def cage_mats(axis: Direction, cover_m: float, sizes_m: Mapping[Direction, float]) -> tuple[Mat, ...]:
    """Return what is off as one in a cage along an axis: the cage, in each direction of which a size is given."""
    return tuple(
        Mat("xyz"[int(np.argmax(across))], across, size_m, cover_m, (axis,)) for across, size_m in sizes_m.items()
    )


@dataclass(frozen=True, eq=False)
class Design:
    """Bars of a cage, world frame, and what was drawn: names and values of its parameters, metres.

    ``ground_m`` is the height of the lowest point of its steel above z = 0: ``STANDING_M`` if bars stand on the
    ground, or the cover of a cage on spacers. ``mats`` are its parts that are off as one through the thickness.
    """

    family: str
    bars: tuple[DesignBar, ...]
    parameters: dict[str, float | str]
    ground_m: float
    mats: tuple[Mat, ...] = ()

    @property
    def stands(self) -> bool:
        """True if bars stand on the ground."""
        return self.ground_m == STANDING_M


def straight(start_m: Sequence[float], end_m: Sequence[float]) -> Line:
    """Return the line between two points."""
    return np.array([start_m, end_m], dtype=np.float64)


def bent(corners_m: Sequence[Sequence[float]], diameter_m: float) -> Line:
    """Return the line through corners with the least bends of EN 1992-1-1. Raises ``ValueError``."""
    return bent_line_m(np.array(corners_m, dtype=np.float64), bend_radius_m(diameter_m))


def spaced(first_m: float, last_m: float, spacing_m: float) -> list[float]:
    """Return evenly spaced positions from the first to the last, at most ``spacing_m`` apart."""
    if last_m - first_m < 1e-9:
        return [first_m]
    count = max(1, int(np.ceil((last_m - first_m) / spacing_m - 1e-9)))
    positions: list[float] = np.linspace(first_m, last_m, count + 1).tolist()
    return positions


def drawn_step(rng: np.random.Generator, low_m: float, high_m: float, step_m: float) -> float:
    """Return a multiple of ``step_m`` between the limits, which is rounded to the micrometre."""
    low, high = int(np.ceil(low_m / step_m - 1e-9)), int(np.floor(high_m / step_m + 1e-9))
    if high < low:
        raise InfeasibleError("no multiple of the step lies between the limits")
    return round(int(rng.integers(low, high + 1)) * step_m, 6)


def drawn_of(rng: np.random.Generator, choices: Sequence[float]) -> float:
    """Return one of the choices. Raises ``InfeasibleError`` if there is none."""
    if not choices:
        raise InfeasibleError("no diameter fits")
    return float(choices[int(rng.integers(len(choices)))])


def turned(
    bars: Sequence[DesignBar], rotation: Float64[ndarray, "3 3"], shift_m: Sequence[float]
) -> list[DesignBar]:
    """Return bars rotated about the origin and then moved."""
    return [
        replace(
            bar,
            line_m=bar.line_m @ rotation.T + np.asarray(shift_m),
            spaced_along=_rotated(bar.spaced_along, rotation),
            held_along=_rotated(bar.held_along, rotation),
        )
        for bar in bars
    ]


def _rotated(direction: Direction | None, rotation: Float64[ndarray, "3 3"]) -> Direction | None:
    if direction is None:
        return None
    x, y, z = (rotation @ np.array(direction)).tolist()
    return (x, y, z)


def steel_share(steel_m2: float, concrete_m2: float, shares: tuple[float, float]) -> float:
    """Return the area of steel per area of concrete; raise ``InfeasibleError`` if it is not within ``shares``."""
    if not shares[0] <= steel_m2 / concrete_m2 <= shares[1]:
        raise InfeasibleError(f"too {'little' if steel_m2 < shares[0] * concrete_m2 else 'much'} steel")
    return round(steel_m2 / concrete_m2, 6)


LYING = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Rotation that takes z, the axis of a member, to x; its x to y and its y to z."""

STARTER = "starter"
_FREE_END_M = 0.05
"""Distance of the first and the last link from the ends of the main bars."""

_STRAIGHT_M = 0.02
"""Straight length of a cranked bar beyond its lap."""

_BESIDE_CRANK_M = 0.02
"""Distance of links from the ends of starters and of cranks."""


@dataclass(frozen=True)
class Lap:
    """Lap of upright bars with starters of the same diameter: the heights between which they lie side by side."""

    bar_m: float
    start_m: float

    @property
    def end_m(self) -> float:
        """Height of the ends of the starters."""
        return self.start_m + lap_m(self.bar_m)

    @property
    def crank_m(self) -> tuple[float, float]:
        """Heights of both ends of the cranks, between which the bars come to the places of the starters."""
        first_m = self.end_m + _STRAIGHT_M
        return first_m, first_m + contact_m(self.bar_m, self.bar_m) / CRANK_SLOPE

    def levels_m(self, first_m: float, last_m: float, spacing_m: float) -> tuple[list[float], list[float]]:
        """Return levels of bars in contact with the starters, and of those in contact with the bars above them.

        Raises ``InfeasibleError`` if the bars are too short for the lap.
        """
        low, high = self.end_m - _BESIDE_CRANK_M, self.crank_m[1] + _BESIDE_CRANK_M
        if high + 0.3 > last_m:
            raise InfeasibleError("the member is too short for laps")
        return spaced(first_m, low, spacing_m), spaced(high, last_m, spacing_m)


def link_levels_m(
    length_m: float, spacing_m: float, dense_m: float, dense_spacing_m: float, lap: Lap | None = None
) -> list[float]:
    """Return levels of links: ``dense_spacing_m`` apart along ``dense_m`` at both ends, else ``spacing_m``.

    They are dense along a lap as well. Raises ``InfeasibleError`` as ``Lap.levels_m``.
    """
    first, last = _FREE_END_M, length_m - _FREE_END_M
    if lap is not None:
        dense, above = lap.levels_m(first, last, dense_spacing_m)
        return [*dense, *_dense_at_last(above[0], last, spacing_m, dense_m, dense_spacing_m)]
    if last - first < 2 * dense_m + spacing_m:
        return spaced(first, last, dense_spacing_m)
    start = spaced(first, first + dense_m, dense_spacing_m)
    return [*start[:-1], *_dense_at_last(first + dense_m, last, spacing_m, dense_m, dense_spacing_m)]


def _dense_at_last(
    first_m: float, last_m: float, spacing_m: float, dense_m: float, dense_spacing_m: float
) -> list[float]:
    """Return levels that are ``dense_spacing_m`` apart along ``dense_m`` at the upper end."""
    if last_m - first_m < dense_m + spacing_m:
        return spaced(first_m, last_m, dense_spacing_m)
    middle = spaced(first_m, last_m - dense_m, spacing_m)
    return [*middle[:-1], *spaced(last_m - dense_m, last_m, dense_spacing_m)]


def lapped(bars: Sequence[DesignBar], inward: Sequence[tuple[float, float]], lap: Lap) -> list[DesignBar]:
    """Return each upright bar as one that laps with a starter.

    Starters are in the places of the bars, in the links. Each bar starts inside of its starter, in the direction
    ``inward`` (x, y), and is cranked above the lap, so that the links hold it from there on. Both stay in their
    places along the side, so that they remain tied to each other.
    """
    made = []
    for bar, (inward_x, inward_y) in zip(bars, inward, strict=True):
        foot, height_m, diameter_m = bar.line_m[0], float(bar.line_m[-1, 2]), bar.diameter_m
        starter_m = straight(foot, (*foot[:2], lap.end_m))
        inside = foot + contact_m(diameter_m, diameter_m) * np.array([inward_x, inward_y, 0.0])
        heights_m = zip((inside, inside, foot, foot), (lap.start_m, *lap.crank_m, height_m), strict=True)
        line_m: Line = bent([(*place[:2], z) for place, z in heights_m], diameter_m)
        made += [
            replace(bar, role=STARTER, line_m=starter_m, spaced_along=None),
            replace(bar, line_m=line_m, spaced_along=None),
        ]
    return made


def rise_m(bars: Sequence[DesignBar]) -> float:
    """Return half the height of the axis of the first of the links."""
    return float(np.ptp(bars[0].line_m[:, 2])) / 2
