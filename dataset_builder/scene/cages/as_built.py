"""Deviations of a built cage from its design: bars displaced, tilted, bowed, left out or doubled. Metres.

The tolerances are those of common execution rules: cover -10 mm and more inwards (EN 13670:2009, 10.6, from a
secondary source), and ours for spacing, tilt and bow. A deviation is taken only if the bar stays clear of all
others; otherwise a smaller one is tried. Bars that rest on others or are tied into a mat (``held_along``) deviate
within the plane of the mat, so that they do not hover.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import Design, DesignBar, InfeasibleError, Z
from dataset_builder.scene.cages.rules import contact_m
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import Clearances

SPACING_TOLERANCE_M = 0.020
"""Largest deviation of a bar along the direction in which its kind is spaced."""

PLACE_TOLERANCE_M = 0.008
"""Largest displacement in any other direction, within the tolerance of the cover."""

TILT_TOLERANCE_DEG = 2.5
"""Largest tilt of a bar or link about its middle, or about its foot if it stands."""

END_TOLERANCE_M = 0.012
"""Largest displacement of the end of a bar by its tilt, which limits that of long bars."""

BOW_TOLERANCE = 1 / 250
"""Largest bow of a straight bar, in lengths."""

MIN_CLEAR_M = 1e-4
"""Least clear distance of two bars as built."""

_NEEDED_M = MIN_CLEAR_M + 1e-8
"""Clear distance that is checked; axes are rounded to the nanometre afterwards."""

_SHARES = ((1.0, 1.0), (0.5, 1.0), (0.25, 1.0), (0.1, 1.0), (0.1, 0.3), (0.0, 1.0), (0.0, 0.3))
"""Shares that are tried of the drawn deviation, and of its part along the direction of the spacing."""

_BOWED_FROM = 30.0
"""Least length, in diameters, of a straight bar that is bowed."""

_DOUBLED_FROM_M = 0.5
"""Least length of a bar that is doubled."""

_RING_SPACING_M = 0.1
_LEFT_OUT, _DOUBLED = 0.35, 0.35
"""Probabilities that one bar of a cage is left out, and that one is doubled."""


@dataclass(frozen=True, eq=False)
class BuiltBar:
    """Bar of a built cage: role, nominal diameter, its axis, and its nominal one (None: not in the design)."""

    role: str
    diameter_m: float
    line_m: Float64[ndarray, "n 3"]
    nominal_m: Float64[ndarray, "k 3"] | None


@dataclass(frozen=True, eq=False)
class BuiltCage:
    """Bars as built, bars of the design that were left out, and the numbers of refused deviations."""

    bars: tuple[BuiltBar, ...]
    left_out: tuple[DesignBar, ...]
    doubled: int
    deviations_reduced: int
    deviations_refused: int


def build_as(design: Design, rng: np.random.Generator) -> BuiltCage:
    """Return the cage as it is built. Raises ``InfeasibleError`` if bars of the design touch each other."""
    bars, left_out = _some_left_out(design.bars, rng)
    clearances = Clearances([bar.line_m for bar in bars], [outer_radius_m(bar.diameter_m) for bar in bars])
    if not clearances.are_all(_NEEDED_M):
        raise InfeasibleError("bars of the design touch each other")
    lines, reduced, refused = [bar.line_m for bar in bars], 0, 0
    for index in rng.permutation(len(bars)).tolist():
        bar = bars[index]
        deviation = _drawn_deviation(bar, rng, stands=design.stands)
        radius = outer_radius_m(bar.diameter_m)
        near = clearances.neighbours(bar.line_m, radius, index, deviation.most_m)
        for share, spacing_share in _SHARES:
            line_m = deviation.applied(share, spacing_share)
            if near.bar_clearance_m(line_m, radius) >= _NEEDED_M:
                lines[index] = line_m
                clearances.replace(index, line_m)
                reduced += (share, spacing_share) != _SHARES[0]
                break
        else:
            refused += 1
    built = [
        BuiltBar(bar.role, bar.diameter_m, line_m, bar.line_m) for bar, line_m in zip(bars, lines, strict=True)
    ]
    doubles = _doubled(built, clearances, rng)
    return BuiltCage((*built, *doubles), tuple(left_out), len(doubles), reduced, refused)


def _some_left_out(
    bars: tuple[DesignBar, ...], rng: np.random.Generator
) -> tuple[list[DesignBar], list[DesignBar]]:
    """Return the bars that are built, and the one that is left out, if any."""
    optional = [index for index, bar in enumerate(bars) if not bar.is_structural]
    if not optional or rng.random() >= _LEFT_OUT:
        return list(bars), []
    missing = int(rng.choice(optional))
    return [bar for index, bar in enumerate(bars) if index != missing], [bars[missing]]


def _doubled(built: list[BuiltBar], clearances: Clearances, rng: np.random.Generator) -> list[BuiltBar]:
    """Return a straight bar that lies beside another one and is not in the design, or none."""
    if rng.random() >= _DOUBLED:
        return []
    straight = [
        bar
        for bar in built
        if bar.nominal_m is not None
        and len(bar.nominal_m) == 2
        and np.linalg.norm(np.diff(bar.nominal_m, axis=0)) >= _DOUBLED_FROM_M
    ]
    for _ in range(8 if straight else 0):
        bar = straight[int(rng.integers(len(straight)))]
        along = bar.line_m[-1] - bar.line_m[0]
        is_level = abs(along[2]) < 0.5 * np.linalg.norm(along)  # It is laid beside another one, not below it.
        side = np.array([0.0, 0.0, 1.0]) if is_level else rng.normal(size=3)
        beside = np.cross(along, side) * rng.choice([-1.0, 1.0])
        distance_m = contact_m(bar.diameter_m, bar.diameter_m) + MIN_CLEAR_M
        line_m = bar.line_m + beside / np.linalg.norm(beside) * distance_m
        if clearances.least_m(line_m, outer_radius_m(bar.diameter_m)) >= _NEEDED_M:
            return [BuiltBar(bar.role, bar.diameter_m, line_m, None)]
    return []


@dataclass(frozen=True, eq=False)
class _Deviation:
    """Drawn deviation of a bar: displacement, along the spacing and otherwise, tilt (rotation vector), and bow."""

    line_m: Float64[ndarray, "n 3"]
    spacing_m: Float64[ndarray, " 3"]
    shift_m: Float64[ndarray, " 3"]
    tilt_rad: Float64[ndarray, " 3"]
    bow_m: Float64[ndarray, " 3"]
    stands: bool

    @property
    def most_m(self) -> float:
        """Largest displacement of a point of the axis."""
        turn_m = float(np.linalg.norm(self.tilt_rad) * np.linalg.norm(np.ptp(self.line_m, axis=0)))
        return turn_m + sum(float(np.linalg.norm(part)) for part in (self.spacing_m, self.shift_m, self.bow_m))

    def applied(self, share: float, spacing_share: float) -> Float64[ndarray, "k 3"]:
        """Return the axis with these shares of the deviation."""
        line_m = _with_rings(self.line_m) if self.bow_m.any() else self.line_m
        middle_m = (line_m.min(axis=0) + line_m.max(axis=0)) / 2
        if self.stands:  # A bar that stands on the ground is tilted about its foot.
            middle_m = line_m[np.argmin(line_m[:, 2])]
        moved = middle_m + (line_m - middle_m) @ _rotation(share * self.tilt_rad).T
        moved = moved + share * self.shift_m + spacing_share * self.spacing_m
        if self.bow_m.any():
            along = np.linspace(0.0, np.pi, len(line_m))[:, None]
            moved = moved + share * np.sin(along) * self.bow_m
        if self.stands:
            moved[:, 2] += line_m[:, 2].min() - moved[:, 2].min()
        return np.asarray(moved)


def _drawn_deviation(bar: DesignBar, rng: np.random.Generator, *, stands: bool) -> _Deviation:
    line_m = bar.line_m
    length_m = float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum())
    size_m = float(np.linalg.norm(np.ptp(line_m, axis=0)))
    shift_m = _within_ball(rng) * PLACE_TOLERANCE_M
    spacing_m = np.zeros(3)
    if bar.spaced_along is not None:
        along = np.array(bar.spaced_along)
        spacing_m = along * rng.uniform(-1, 1) * SPACING_TOLERANCE_M
        shift_m = shift_m - along * (shift_m @ along)
    is_standing = stands and float(line_m[:, 2].min()) < 1e-9 and bar.spaced_along != Z
    reach_m = size_m if is_standing else size_m / 2
    most_rad = min(np.deg2rad(TILT_TOLERANCE_DEG), END_TOLERANCE_M / reach_m)
    tilt_rad = _within_ball(rng) * most_rad
    bow_m, side = np.zeros(3), rng.normal(size=3)
    if bar.held_along is not None:
        held = np.array(bar.held_along)
        shift_m, tilt_rad, side = shift_m - held * (shift_m @ held), held * (tilt_rad @ held), held
    if len(line_m) == 2 and length_m > _BOWED_FROM * bar.diameter_m:
        side = np.cross(line_m[1] - line_m[0], side)
        bow_m = side / np.linalg.norm(side) * rng.uniform(-BOW_TOLERANCE, BOW_TOLERANCE) * length_m
    return _Deviation(line_m, spacing_m, shift_m, tilt_rad, bow_m, is_standing)


def _within_ball(rng: np.random.Generator) -> Float64[ndarray, " 3"]:
    """Return a random vector of length up to 1: a uniform direction, and a length that favours small ones."""
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction) * rng.random())


def _rotation(vector_rad: Float64[ndarray, " 3"]) -> Float64[ndarray, "3 3"]:
    """Return the rotation matrix of a rotation vector (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector_rad / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross))


def _with_rings(line_m: Float64[ndarray, "2 3"]) -> Float64[ndarray, "k 3"]:
    """Return a straight line with points at most ``_RING_SPACING_M`` apart."""
    count = max(4, int(np.ceil(np.linalg.norm(line_m[1] - line_m[0]) / _RING_SPACING_M)))
    return np.asarray(line_m[0] + np.linspace(0, 1, count + 1)[:, None] * (line_m[1] - line_m[0]))
