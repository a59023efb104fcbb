"""Solids that are swept circles: swept discs, extruded and revolved circles, as axes with a diameter.

Legs and bends of one bar may be solids of their own, which ``joined_sweeps`` joins.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.shapes.bending import bent_line_m, without_repeats
from dataset_builder.user_files.ifc_reader.bodies import axis_placement, point_xyz, unit_vector
from dataset_builder.user_files.ifc_reader.curves import ARC_STEP_DEG, Arc, Leg, Piece, cut, directrix
from dataset_builder.user_files.ifc_reader.objects import Units

_FOOT_M = 0.3048
_SAME = 1e-6
"""Largest relative difference of parameters and diameters that are taken to be equal."""

_AGREES, _DIFFERS = 0.03, 0.002
"""Largest difference of a length from the declared one, and least one of two ways of counting, relative."""

_CLOSED_GAP = 0.25
"""Largest gap between two segments that is closed, in diameters."""

_NOTED_GAP = 0.01
"""Smallest gap between two segments that is noted when it is closed, in diameters."""

_OBLIQUE = 1e-6
"""Smallest 1 - cos of the angle between an extrusion and its circle's axis that makes it no bar."""

_STRAIGHT = math.cos(math.radians(1.0))
"""Smallest cosine of the angle between two solids that continue each other."""

_END_SHARE = 1e-4
"""Share of a piece at its end whose chord is taken for the tangent."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Circle swept along an axis, in the frame and unit of its file, and notes on how it was read, by code.

    ``outward`` are the unit vectors along the axis that point out of its start and its end.
    """

    axis: Float64[ndarray, "n 3"]
    outward: Float64[ndarray, "2 3"]
    diameter: float
    notes: dict[str, str]

    def placed(self, matrix: Float64[ndarray, "4 4"], scale: float, unit_m: float) -> Sweep:
        """Return the sweep in another frame, metres, to which ``matrix`` leads with the factor ``scale``."""
        turn, origin = matrix[:3, :3], matrix[:3, 3]
        axis_m = (self.axis @ turn.T + origin) * unit_m
        return Sweep(axis_m, self.outward @ turn.T / scale, self.diameter * scale * unit_m, self.notes)


def read_sweep(solid: Any, units: Units, declared: float | None) -> Sweep | None:
    """Return the sweep that a solid is, or None if it is not the sweep of a circle.

    ``declared`` is the length of the bar that the file declares. Raises ``ValueError`` if an IfcSweptDiskSolid has
    a curve that is not supported, degenerate or not connected, has no radius, or has parameters that are not on
    the curve.
    """
    is_swept_area = solid.is_a() in ("IfcExtrudedAreaSolid", "IfcRevolvedAreaSolid")
    if is_swept_area and solid.SweptArea.is_a("IfcCircleProfileDef"):
        return _swept_circle(solid, units.angle_rad)
    if not solid.is_a("IfcSweptDiskSolid"):
        return None
    diameter, notes = _diameter(solid.Radius), _hollow_notes(solid.InnerRadius)
    pieces = _swept_pieces(solid, units, declared, notes)
    axis = _joined([piece.points() for piece in pieces], diameter, notes)
    if solid.is_a("IfcSweptDiskSolidPolygonal") and solid.FilletRadius:
        axis = bent_line_m(axis, solid.FilletRadius, ARC_STEP_DEG)
    return Sweep(axis, _outward(pieces), diameter, notes)


def _outward(pieces: Sequence[Piece]) -> Float64[ndarray, "2 3"]:
    """Return the unit vectors along connected pieces that point out of their start and their end."""
    pieces = [piece for piece in pieces if piece.length]
    start, end = pieces[0].part(0.0, _END_SHARE).points(), pieces[-1].part(1 - _END_SHARE, 1.0).points()
    chords = np.array([start[0] - start[-1], end[-1] - end[0]])
    return np.asarray(chords / np.linalg.norm(chords, axis=1, keepdims=True))


def _diameter(radius: float) -> float:
    """Return the diameter for a radius; raise ``ValueError`` unless it is finite and above 0."""
    if not 0 < radius < math.inf:
        raise ValueError(f"a circle has the radius {radius:g}, expected above 0")
    return 2 * float(radius)


def _hollow_notes(inner_radius: float | None) -> dict[str, str]:
    return {"hollow": "a hollow bar is taken to be solid"} if inner_radius else {}


def _swept_circle(solid: Any, angle_rad: float) -> Sweep | None:
    """Return the bar of a circle that is extruded along its axis or revolved, or None for any other sweep."""
    profile = solid.SweptArea
    start = np.array((0.0, 0.0, 0.0) if profile.Position is None else point_xyz(profile.Position.Location))
    matrix = np.eye(4) if solid.Position is None else axis_placement(solid.Position)
    piece: Piece
    if solid.is_a("IfcExtrudedAreaSolid"):
        along = unit_vector(solid.ExtrudedDirection)
        is_bar = 1 - abs(along[2]) <= _OBLIQUE
        piece = Leg(start, start + float(solid.Depth) * along)
    else:
        along, turn_rad = unit_vector(solid.Axis.Axis, (0.0, 0.0, 1.0)), float(solid.Angle) * angle_rad
        arm = start - np.array(point_xyz(solid.Axis.Location))
        arm = arm - arm @ along * along
        is_bar = (
            abs(along[2]) <= _OBLIQUE
            and 0 < turn_rad <= 2 * np.pi + _SAME
            and np.linalg.norm(arm) > profile.Radius
        )
        piece = Arc(start - arm, arm, np.cross(along, arm), 0.0, turn_rad, turn_rad)
    if not is_bar:
        return None
    axis = _drop_repeated_points(piece.points() @ matrix[:3, :3].T + matrix[:3, 3])
    notes = _hollow_notes(getattr(profile, "WallThickness", None))
    return Sweep(axis, _outward([piece]) @ matrix[:3, :3].T, _diameter(profile.Radius), notes)


def _swept_pieces(solid: Any, units: Units, declared: float | None, notes: dict[str, str]) -> list[Piece]:
    """Return the swept part of the curve of an IfcSweptDiskSolid; add to ``notes``.

    Programs disagree about the parameters of an IfcSweptDiskSolid that mean the whole curve. These do, each within
    a millionth: none; 0 to the number of segments; 0 to 1; 0 to the sum of the pieces' parameter ranges (ISO
    10303-42: a leg of a polyline counts 1, a trimmed line its length over the vector's magnitude, an arc its angle
    in the project's unit), also with legs counted by their length in the file's unit or in feet; an end beyond the
    largest of these. Any other parameters cut the curve: they count as in the rule, or else in the first of the
    other ways that ends at the end parameter, or at least reaches it. If that does not give the ``declared``
    length, and one of these ways or one in which polylines or segments count 1, or arcs their length, does, it is
    taken.
    """
    pieces, start, end = directrix(solid, units.angle_rad)
    by_rule = [piece.parameters for piece in pieces]
    if not sum(by_rule) > 0:
        raise ValueError("a curve has no length")
    by_length, by_feet = (
        [piece.length * unit if isinstance(piece, Leg) else piece.parameters for piece in pieces]
        for unit in (1.0, units.length_m / _FOOT_M)
    )
    counts = [by_rule, by_length, by_feet, [1.0] * len(pieces), [size / sum(by_rule) for size in by_rule]]
    totals = [*map(sum, counts), float(len(getattr(solid.Directrix, "Segments", None) or pieces))]
    end = max(totals) if end is None else end
    if not (np.isfinite([start, end]).all() and 0 <= start < end):
        raise ValueError(
            f"the disc is swept from {start} to {end}, expected from 0 or above to a larger parameter"
        )
    ends_at = [total for total in totals if abs(end - total) <= _SAME * total]
    if start <= _SAME * end and (ends_at or end > max(totals)):
        part = pieces
    else:
        chosen = [count for count in counts if abs(end - sum(count)) <= _SAME * end]
        chosen += [count for count in counts if end <= sum(count)]
        part = cut(pieces, (chosen or counts)[0], start, end)
    length = _length(part)
    if declared and length:
        legs = [piece.legs if isinstance(piece, Leg) else 1 for piece in pieces]
        counts.append([size / number for size, number in zip(by_rule, legs, strict=True)])
        counts += [[1 / number for number in legs], [piece.length for piece in pieces]]
        parts = [cut(pieces, count, start, end) for count in counts if end <= sum(count) * (1 + _SAME)]
        other = min(parts, key=lambda one: abs(_length(one) - declared), default=part)
        size = _length(other)
        if abs(size / declared - 1) <= min(_AGREES, abs(length / declared - 1) - _DIFFERS):
            text = f"count so that they give the declared length, not {length / size:.1%} of it"
            notes["parameters"] = f"the parameters {start:g} to {end:g} {text}"
            part, length = other, size
    if length and (share := length / _length(pieces)) < 1 - _SAME:
        notes["cut"] = f"the curve is swept from {solid.StartParam} to {solid.EndParam}, {share:.1%} of its length"
    return part


def joined_sweeps(sweeps: Sequence[Sweep | None], uses: Sequence[int], declared: float | None) -> dict[int, Sweep]:
    """Return sweeps of one frame by their numbers, those that continue each other as one with the first's number.

    Two of them do if their ends are at most ``_CLOSED_GAP`` diameters apart and nearest to each other, in one
    direction to ``_STRAIGHT``, and of equal diameters, unless both have the ``declared`` length of a bar. They are
    of the same use of a map (``uses``), in any order and direction, and may form a ring.
    """
    numbers = [number for number, sweep in enumerate(sweeps) if sweep is not None]
    found = [sweep for sweep in sweeps if sweep is not None]
    partners = _partners(found, [uses[number] for number in numbers], declared) if len(found) > 1 else {}
    joined: dict[int, Sweep] = {}
    used: set[int] = set()
    ends = range(2 * len(found))  # Those of each sweep are 2 n, its start, and 2 n + 1.
    for begin in (*(end for end in ends if end not in partners), *ends[::2]):
        if begin // 2 in used:
            continue
        chain = [begin]
        while (after := partners.get(chain[-1] ^ 1, begin)) != begin:
            chain.append(after)
        used.update(end // 2 for end in chain)
        joined[numbers[min(chain) // 2]] = _chained(found, chain, is_ring=begin in partners)
    return joined


def _chained(sweeps: Sequence[Sweep], chain: Sequence[int], is_ring: bool) -> Sweep:
    """Return the sweeps that begin at the ends in ``chain`` as one, in this order."""
    first, last = sweeps[chain[0] // 2], sweeps[chain[-1] // 2]
    if len(chain) == 1:
        return first
    notes = {code: text for end in chain for code, text in sweeps[end // 2].notes.items()}
    notes["joined"] = f"{len(chain)} solids that continue each other are one bar"
    axis = _joined([sweeps[end // 2].axis[:: -1 if end % 2 else 1].copy() for end in chain], first.diameter, notes)
    if is_ring:
        axis[-1] = axis[0]
    return Sweep(
        axis, np.array([first.outward[chain[0] % 2], last.outward[1 - chain[-1] % 2]]), first.diameter, notes
    )


def _partners(sweeps: Sequence[Sweep], uses: Sequence[int], declared: float | None) -> dict[int, int]:
    """Return for each end of a sweep that continues another the number of that end."""
    points = np.concatenate([sweep.axis[[0, -1]] for sweep in sweeps])
    outward = np.concatenate([sweep.outward for sweep in sweeps])
    diameters, use = np.repeat([sweep.diameter for sweep in sweeps], 2), np.repeat(uses, 2)
    sizes = [np.linalg.norm(np.diff(sweep.axis, axis=0), axis=1).sum() for sweep in sweeps]
    is_bar = [declared is not None and abs(size / declared - 1) <= _AGREES for size in sizes]
    nearest: dict[int, int] = {}
    for end, diameter in enumerate(diameters):
        gaps = np.linalg.norm(points - points[end], axis=1)
        is_like = (use == use[end]) & (abs(diameters - diameter) <= _SAME * diameter)
        gaps[~(is_like & (outward @ outward[end] <= -_STRAIGHT))] = np.inf
        gaps[end ^ 1] = np.inf
        # Where solids are written twice, it is unknown which of them continue each other.
        if gaps.min() <= _CLOSED_GAP * diameter and (gaps <= gaps.min() + _NOTED_GAP * diameter).sum() == 1:
            nearest[end] = int(gaps.argmin())
    return {
        end: other
        for end, other in nearest.items()
        if nearest.get(other) == end and not (is_bar[end // 2] and is_bar[other // 2])
    }


def _joined(
    lines: list[Float64[ndarray, "n 3"]], diameter: float, notes: dict[str, str]
) -> Float64[ndarray, "k 3"]:
    """Return lines, whose ends are moved, as one with joints in the middle of gaps; note a gap.

    Raises ``ValueError`` if there is no line, no length or a gap wider than ``_CLOSED_GAP`` diameters.
    """
    if not lines:
        raise ValueError("the swept part of the curve is empty")
    largest = 0.0
    for before, after in pairwise(lines):
        gap = float(np.linalg.norm(after[0] - before[-1]))
        if not gap <= _CLOSED_GAP * diameter:  # The negated comparison also catches NaN.
            raise ValueError(f"two segments of a curve are {gap:.6g} apart, expected at most a quarter of the "
                             f"diameter {diameter:.6g}")  # fmt: skip
        before[-1] = after[0] = before[-1] + (after[0] - before[-1]) / 2
        largest = max(largest, gap)
    if largest > _NOTED_GAP * diameter:
        notes["gap"] = f"closed a gap of {largest / diameter:.0%} of the diameter between two segments"
    return _drop_repeated_points(np.concatenate(lines))


def _length(pieces: Sequence[Piece]) -> float:
    return sum((piece.length for piece in pieces), 0.0)


def _drop_repeated_points(points: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Return the points without those that equal their predecessor to a millionth of the curve's extent.

    Raises ``ValueError`` if fewer than two points remain or a point is not finite.
    """
    if len(points) < 2 or not np.isfinite(points).all():
        raise ValueError("a curve has fewer than two points, or a point that is not finite")
    distinct = without_repeats(points, 1e-6 * np.ptp(points, axis=0).max())
    if len(distinct) < 2:
        raise ValueError("a curve has no length")
    return distinct
