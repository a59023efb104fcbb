"""Solids that are swept circles: swept discs and extruded circles, as axes with a diameter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.shapes.bending import bent_line_m, without_repeats
from dataset_builder.user_files.ifc_reader.bodies import axis_placement, point_xyz, unit_vector
from dataset_builder.user_files.ifc_reader.curves import ARC_STEP_DEG, Leg, Piece, curve_pieces, cut
from dataset_builder.user_files.ifc_reader.objects import Units

_FOOT_M = 0.3048
_SAME_PARAMETER = 1e-6
"""Largest relative difference of parameters that are taken to be equal."""

_CLOSED_GAP = 0.25
"""Largest gap between two segments that is closed, in diameters."""

_NOTED_GAP = 0.01
"""Smallest gap between two segments that is noted when it is closed, in diameters."""

_OBLIQUE = 1e-6
"""Smallest 1 - cos of the angle between an extrusion and its circle's axis that makes it no bar."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """Circle swept along an axis, in the frame and unit of its file, and notes on how it was read, by code."""

    axis: Float64[ndarray, "n 3"]
    diameter: float
    notes: dict[str, str]


def read_sweep(solid: Any, units: Units) -> Sweep | None:
    """Return the sweep that a solid is, or None if it is not the sweep of a circle.

    Raises ``ValueError`` if an IfcSweptDiskSolid has a curve that is not supported, degenerate or not connected,
    has no radius, or has parameters that are not on the curve.
    """
    if solid.is_a("IfcSweptDiskSolid"):
        return _swept_disc(solid, units)
    if solid.is_a() == "IfcExtrudedAreaSolid" and solid.SweptArea.is_a("IfcCircleProfileDef"):
        return _extruded_circle(solid)
    return None


def _swept_disc(solid: Any, units: Units) -> Sweep:
    diameter, notes = _diameter(solid.Radius), _hollow_notes(solid.InnerRadius)
    whole = curve_pieces(solid.Directrix, units.angle_rad)
    pieces = _swept_pieces(solid, whole, units.length_m)
    line, gap = _joined(pieces, diameter)
    axis = _drop_repeated_points(line)
    if gap > _NOTED_GAP * diameter:
        notes["gap"] = f"closed a gap of {gap / diameter:.0%} of the diameter between two segments"
    if pieces is not whole:
        share = _length(axis) / sum(_length(piece.points()) for piece in whole)
        notes["cut"] = f"the curve is swept from {solid.StartParam} to {solid.EndParam}, {share:.1%} of its length"
    if solid.is_a("IfcSweptDiskSolidPolygonal") and solid.FilletRadius:
        axis = bent_line_m(axis, solid.FilletRadius, ARC_STEP_DEG)
    return Sweep(axis, diameter, notes)


def _diameter(radius: float) -> float:
    """Return the diameter for a radius; raise ``ValueError`` unless it is finite and above 0."""
    if not 0 < radius < math.inf:
        raise ValueError(f"a circle has the radius {radius:g}, expected above 0")
    return 2 * float(radius)


def _hollow_notes(inner_radius: float | None) -> dict[str, str]:
    return {"hollow": "a hollow bar is taken to be solid"} if inner_radius else {}


def _extruded_circle(solid: Any) -> Sweep | None:
    """Return the bar of a circle that is extruded along its axis, or None if it is extruded obliquely."""
    profile, along = solid.SweptArea, unit_vector(solid.ExtrudedDirection)
    if 1 - abs(along[2]) > _OBLIQUE:
        return None
    start = np.array((0.0, 0.0, 0.0) if profile.Position is None else point_xyz(profile.Position.Location))
    matrix = np.eye(4) if solid.Position is None else axis_placement(solid.Position)
    ends = np.array([start, start + float(solid.Depth) * along]) @ matrix[:3, :3].T + matrix[:3, 3]
    notes = _hollow_notes(getattr(profile, "WallThickness", None))
    return Sweep(_drop_repeated_points(ends), _diameter(profile.Radius), notes)


def _swept_pieces(solid: Any, pieces: list[Piece], unit_m: float) -> list[Piece]:
    """Return ``pieces`` itself if the whole curve is swept, else the swept part of them.

    Programs disagree about the parameters of an IfcSweptDiskSolid that mean the whole curve. These do, each within
    a millionth: none; 0 to the number of segments; 0 to 1; 0 to the sum of the pieces' parameter ranges (ISO
    10303-42: a leg of a polyline counts 1, a trimmed line its length over the vector's magnitude, an arc its angle
    in the project's unit), also with legs counted by their length in the file's unit or in feet; an end beyond the
    largest of these. Any other parameters cut the curve: they count as in the rule, or else in the first of the
    other ways that ends at the end parameter, or at least reaches it.
    """
    start, end = float(solid.StartParam or 0.0), solid.EndParam
    by_rule = [piece.parameters for piece in pieces]
    if not sum(by_rule) > 0:
        raise ValueError("a curve has no length")
    counts = [
        by_rule,
        [piece.length if isinstance(piece, Leg) else piece.parameters for piece in pieces],
        [piece.length * unit_m / _FOOT_M if isinstance(piece, Leg) else piece.parameters for piece in pieces],
        [1.0] * len(pieces),
        [size / sum(by_rule) for size in by_rule],
    ]
    totals = [*map(sum, counts), float(len(getattr(solid.Directrix, "Segments", None) or pieces))]
    end = max(totals) if end is None else float(end)
    if not (np.isfinite([start, end]).all() and 0 <= start < end):
        raise ValueError(
            f"the disc is swept from {start} to {end}, expected from 0 or above to a larger parameter"
        )
    ends_at = [total for total in totals if abs(end - total) <= _SAME_PARAMETER * total]
    if start <= _SAME_PARAMETER * end and (ends_at or end > max(totals)):
        return pieces
    chosen = [count for count in counts if abs(end - sum(count)) <= _SAME_PARAMETER * end]
    chosen += [count for count in counts if end <= sum(count)]
    return cut(pieces, (chosen or counts)[0], start, end)


def _joined(pieces: list[Piece], diameter: float) -> tuple[Float64[ndarray, "k 3"], float]:
    """Return the pieces as one line with joints in the middle of gaps, and the largest gap.

    Raises ``ValueError`` if no piece is given or a gap is larger than ``_CLOSED_GAP`` diameters.
    """
    if not pieces:
        raise ValueError("the swept part of the curve is empty")
    lines = [np.array(piece.points(), np.float64) for piece in pieces]
    largest = 0.0
    for before, after in pairwise(lines):
        gap = float(np.linalg.norm(after[0] - before[-1]))
        if not gap <= _CLOSED_GAP * diameter:  # The negated comparison also catches NaN.
            raise ValueError(f"two segments of a curve are {gap:.6g} apart, expected at most a quarter of the "
                             f"diameter {diameter:.6g}")  # fmt: skip
        before[-1] = after[0] = before[-1] + (after[0] - before[-1]) / 2
        largest = max(largest, gap)
    return np.concatenate(lines), largest


def _length(line: Float64[ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


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
