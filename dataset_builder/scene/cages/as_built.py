"""Deviations of a built cage from its design: bars displaced, tilted, bowed, left out or doubled. Metres.

A deviation of a bar is taken only if the bar stays clear of all others and above the ground; otherwise a smaller
one is tried. Bars that rest on others or are tied into a mat (``held_along``) deviate within the plane of the mat,
so that they do not hover. All steel then follows its ``Mat`` through the thickness of the member: one smooth
displacement of offset, tilt, and sag between supports, which keeps the distances of bars that lie on each other.

Tolerances of the cover are those of EN 13670:2009, 10.6, as The Concrete Society gives them (concrete.org.uk,
fingertips, "Maximum cover to steel reinforcement", a secondary source); those of spacing, tilt and bow are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import LEAST_COVER_M, Design, DesignBar, InfeasibleError, Mat, Z
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

PLUS_TOLERANCES_M, SIZES_M = {1: (0.010, 0.015, 0.025), 2: (0.005, 0.010, 0.020)}, (0.150, 0.400, 2.500)
"""Largest excess of the cover by tolerance class, and the sizes of members to which the three numbers belong."""

MINUS_TOLERANCE_M = 0.010
"""Largest deficit of the cover, the allowance for deviations of EN 1992-1-1, 4.4.1.3."""

BEYOND, _BEYOND_SHARES, _WITHIN_SHARES = 0.1, (1.05, 1.5), (0.1, 1.0)
"""Probability that a mat is beyond its tolerance, and ranges of its largest deviation in tolerances."""

_SQUEEZE = 0.2
"""Largest approach of a mat to the opposite one, per distance of both: ties and chairs keep their shape."""

_SAG_CURVATURE = 0.06
"""Largest curvature of a sagging mat, 1/m: 3 mm in 0.7 m, and 0.1 mm in ``_RING_SPACING_M``."""

_NEEDED_M = MIN_CLEAR_M + 1.5e-4
"""Clear distance that is checked before the mats deviate, which may reduce it a little."""

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
    """Bars as built, bars of the design that were left out, and the numbers of refused deviations.

    ``mats`` are records of the deviations of mats, as JSON values.
    """

    bars: tuple[BuiltBar, ...]
    left_out: tuple[DesignBar, ...]
    mats: tuple[dict[str, Any], ...]
    doubled: int
    deviations_reduced: int
    deviations_refused: int


def build_as(design: Design, rng: np.random.Generator) -> BuiltCage:
    """Return the cage as it is built. Raises ``InfeasibleError`` if bars of the design touch each other."""
    tolerance_class = int(rng.integers(1, 3))
    points_m = np.concatenate([_divided(bar.line_m) for bar in design.bars])
    mats = [_drawn_mat(mat, points_m[mat.weights(points_m) == 1], tolerance_class, rng) for mat in design.mats]
    lowest_m = min(lowest_steel_m(bar.line_m, bar.diameter_m) for bar in design.bars)
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
            is_above = lowest_steel_m(line_m, bar.diameter_m) > lowest_m - 1e-9
            if is_above and near.bar_clearance_m(line_m, radius) >= _NEEDED_M:
                lines[index] = line_m
                clearances.replace(index, line_m)
                reduced += (share, spacing_share) != _SHARES[0]
                break
        else:
            refused += 1
    built = [
        BuiltBar(bar.role, bar.diameter_m, line_m, bar.line_m) for bar, line_m in zip(bars, lines, strict=True)
    ]
    doubles = _doubled(bars, built, clearances, rng)
    moved = _with_mats([*built, *doubles], mats, lowest_m if design.stands else -np.inf)
    radii_m, records = [outer_radius_m(bar.diameter_m) for bar in moved], tuple(record for *_, record in mats)
    if not Clearances([bar.line_m for bar in moved], radii_m).are_all(MIN_CLEAR_M + 1e-8):
        raise InfeasibleError("bars touch each other as their mats deviate")
    return BuiltCage(tuple(moved), tuple(left_out), records, len(doubles), reduced, refused)


def lowest_steel_m(line_m: Float64[ndarray, "n 3"], diameter_m: float) -> float:
    """Return the height of the lowest point of a bar's surface, whose ends are flat discs."""
    step_m, heights_m = np.diff(line_m, axis=0), line_m[:, 2]
    level = np.hypot(step_m[:, 0], step_m[:, 1]) / np.linalg.norm(step_m, axis=1)
    return float((np.minimum(heights_m[:-1], heights_m[1:]) - outer_radius_m(diameter_m) * level).min())


_DrawnMat = tuple[Mat, Float64[ndarray, " k"], dict[str, Any]]
"""Mat, its deviation as factors of its ``_shapes``, and the record of it as JSON values."""


def _shapes(mat: Mat, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n k"]:
    """Return unit deviations of a mat at points: slopes along its axes, sag amid its supports, and offset."""
    along_m = points_m @ np.array(mat.axes).T
    sag = np.zeros(len(points_m))
    for at_m, places_m in zip(along_m.T, mat.supports_m, strict=False):
        turns = np.interp(at_m, places_m, np.arange(len(places_m)))
        sag = sag + (1 - np.cos(2 * np.pi * turns)) / 2 / len(mat.axes)
    return np.column_stack([along_m, sag, np.ones(len(points_m))])


def _drawn_mat(
    mat: Mat, points_m: Float64[ndarray, "n 3"], tolerance_class: int, rng: np.random.Generator
) -> _DrawnMat:
    """Return a mat with steel at these points and its deviation.

    Its largest excess or deficit of cover is a drawn share of the tolerance, below or above 1. A share above 1 is
    drawn only at a side where the mat has room for it.
    """
    plus_m = float(np.interp(mat.thickness_m, SIZES_M, PLUS_TOLERANCES_M[tolerance_class]))
    tolerances_m = np.array([plus_m, MINUS_TOLERANCE_M])
    room_m = np.full(2, mat.cover_m - LEAST_COVER_M - 0.001)
    if not mat.supports_m:  # More cover at one face of a cage is less at the other.
        tolerances_m[:] = tolerances_m.min()
    else:
        room_m[0] = _SQUEEZE * np.ptp(mat.between_m) if mat.between_m else np.inf
    side, share = int(rng.integers(2)), rng.uniform(*_WITHIN_SHARES)
    is_beyond = bool(rng.random() < BEYOND)
    if is_beyond:
        least, most = _BEYOND_SHARES
        wide = np.flatnonzero(room_m > least * tolerances_m).tolist()
        side = wide[side % len(wide)]
        share = rng.uniform(least, min(most, float(room_m[side] / tolerances_m[side])))
    limits_m = np.minimum(share * tolerances_m, room_m)
    shapes, axes = _shapes(mat, points_m), len(mat.axes)
    slopes = rng.uniform(-0.5, 0.5, axes) * limits_m.sum() / np.ptp(shapes[:, :axes], axis=0)
    pitch_m = min((float(np.diff(places_m).min()) for places_m in mat.supports_m), default=0.0)
    sag_m = rng.random() * _SAG_CURVATURE * (pitch_m / np.pi) ** 2  # Upper mats sag from their face, others to it.
    factors = np.array([*slopes, sag_m if mat.outward[2] > 0 else -sag_m, 0.0])
    factors *= min(1.0, limits_m.sum() / np.ptp(shapes @ factors))
    excess_m = shapes @ factors
    factors[-1] = -limits_m[1] - excess_m.min() if side else limits_m[0] - excess_m.max()
    record = {
        "name": mat.name,
        "deviation_m": [round(float(end + factors[-1]), 9) for end in (excess_m.min(), excess_m.max())],
        "tolerance_m": [round(float(end), 9) for end in (-tolerances_m[1], tolerances_m[0])],
        "class": tolerance_class,
        "beyond": is_beyond,
    }
    return mat, factors, record


def _with_mats(bars: Sequence[BuiltBar], mats: Sequence[_DrawnMat], least_z: float) -> list[BuiltBar]:
    """Return bars displaced with the mats; those that would reach below ``least_z`` are raised to it."""
    sags = any(mat.supports_m for mat, *_ in mats)
    lines_m = [_divided(bar.line_m) if sags else bar.line_m for bar in bars]
    points_m = moved_m = np.concatenate(lines_m)
    for mat, factors, _ in mats:
        excess_m = mat.weights(points_m) * (_shapes(mat, points_m) @ factors)
        moved_m = moved_m - excess_m[:, None] * np.array(mat.outward)
    parts_m = np.split(moved_m, np.cumsum([len(line_m) for line_m in lines_m])[:-1])
    for bar, line_m in zip(bars, parts_m, strict=True):
        line_m[:, 2] += max(0.0, least_z - lowest_steel_m(line_m, bar.diameter_m))
    return [replace(bar, line_m=line_m) for bar, line_m in zip(bars, parts_m, strict=True)]


def _some_left_out(
    bars: tuple[DesignBar, ...], rng: np.random.Generator
) -> tuple[list[DesignBar], list[DesignBar]]:
    """Return the bars that are built, and the one that is left out, if any."""
    optional = [index for index, bar in enumerate(bars) if not bar.is_structural]
    if not optional or rng.random() >= _LEFT_OUT:
        return list(bars), []
    missing = int(rng.choice(optional))
    return [bar for index, bar in enumerate(bars) if index != missing], [bars[missing]]


def _doubled(
    bars: Sequence[DesignBar], built: Sequence[BuiltBar], clearances: Clearances, rng: np.random.Generator
) -> list[BuiltBar]:
    """Return a straight bar that lies beside another one and is not in the design, or none."""
    if rng.random() >= _DOUBLED:
        return []
    straight = [
        (bar, design.held_along)
        for design, bar in zip(bars, built, strict=True)
        if len(design.line_m) == 2 and np.linalg.norm(np.diff(design.line_m, axis=0)) >= _DOUBLED_FROM_M
    ]
    for _ in range(8 if straight else 0):
        bar, held_along = straight[int(rng.integers(len(straight)))]
        along = bar.line_m[-1] - bar.line_m[0]
        is_level = abs(along[2]) < 0.5 * np.linalg.norm(along)  # It is laid beside another one, not below it.
        side = np.array(held_along or Z) if held_along or is_level else rng.normal(size=3)
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
    diameter_m: float
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
        line_m = _divided(self.line_m, 4) if self.bow_m.any() else self.line_m
        middle_m = (line_m.min(axis=0) + line_m.max(axis=0)) / 2
        if self.stands:  # A bar that stands on the ground is tilted about its foot.
            middle_m = line_m[np.argmin(line_m[:, 2])]
        moved = middle_m + (line_m - middle_m) @ _rotation(share * self.tilt_rad).T
        moved = moved + share * self.shift_m + spacing_share * self.spacing_m
        if self.bow_m.any():
            along = np.linspace(0.0, np.pi, len(line_m))[:, None]
            moved = moved + share * np.sin(along) * self.bow_m
        if self.stands:
            moved[:, 2] += line_m[:, 2].min() - lowest_steel_m(moved, self.diameter_m)
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
    return _Deviation(line_m, bar.diameter_m, spacing_m, shift_m, tilt_rad, bow_m, is_standing)


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


def _divided(line_m: Float64[ndarray, "n 3"], least: int = 1) -> Float64[ndarray, "k 3"]:
    """Return a line with points at most ``_RING_SPACING_M`` apart, with ``least`` pieces for each of its own."""
    step_m = np.diff(line_m, axis=0)
    pieces = np.maximum(least, np.ceil(np.linalg.norm(step_m, axis=1) / _RING_SPACING_M - 1e-9)).astype(int)
    piece = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    points_m = np.repeat(line_m[:-1], pieces, axis=0) + piece[:, None] * np.repeat(
        step_m / pieces[:, None], pieces, axis=0
    )
    return np.concatenate([points_m, line_m[-1:]])
