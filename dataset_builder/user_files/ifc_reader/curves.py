"""IFC curves as pieces: straight legs and arcs of circles, in the file's length unit.

Each piece counts parameters as ISO 10303-42 does for the curve that it comes from, and can be cut exactly.
Polylines, indexed, composite and trimmed curves, lines and circles are read as IFC2x3 and IFC4 (ISO 16739-1)
define them. Anything else raises ``ValueError``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.user_files.ifc_reader.bodies import axis_placement, point_xyz, unit_vector, xyz

ARC_STEP_DEG = 6.0
"""Largest angle between sampled points of an arc, degrees, as in ``bent_line_m``."""

_MAX_DEPTH = 20
"""Largest nesting depth of curves; deeper nesting is taken to be a cycle."""

_MAX_PIECES = 10_000
"""Largest number of pieces of a composite curve, which a short file with nested curves can multiply."""

_FULL_TURN_RAD = 2 * np.pi
_ANGLE_NOISE_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class Leg:
    """Straight leg; ``parameters`` is its parameter range: 1 in a polyline, else a multiple of a line's vector.

    ``legs`` is the number of legs of its polyline, 1 for a line.
    """

    start: Float64[ndarray, " 3"]
    end: Float64[ndarray, " 3"]
    parameters: float = 1.0
    legs: int = 1

    @property
    def length(self) -> float:
        """Distance of its ends."""
        return float(np.linalg.norm(self.end - self.start))

    def points(self) -> Float64[ndarray, "2 3"]:
        """Return both ends."""
        return np.array([self.start, self.end])

    def part(self, first: float, last: float) -> Leg:
        """Return the part between two shares (0 to 1) of the parameter range."""
        chord = self.end - self.start
        start, end = self.start + first * chord, self.start + last * chord
        return replace(
            self, start=start, end=self.end if last == 1 else end, parameters=self.parameters * (last - first)
        )

    def reversed(self) -> Leg:
        """Return the leg from its end to its start."""
        return replace(self, start=self.end, end=self.start)


@dataclass(frozen=True, eq=False)
class Arc:
    """Arc of a circle: centre + cos(t) x_axis + sin(t) y_axis for t from ``first_rad``.

    The arc turns by ``turn_rad``, which is negative if it runs clockwise about x_axis x y_axis. ``parameters`` is
    the turn's size in the project's plane angle unit.
    """

    centre: Float64[ndarray, " 3"]
    x_axis: Float64[ndarray, " 3"]
    y_axis: Float64[ndarray, " 3"]
    first_rad: float
    turn_rad: float
    parameters: float

    @property
    def length(self) -> float:
        """Radius times turn."""
        return abs(self.turn_rad) * float(np.linalg.norm(self.x_axis))

    def points(self) -> Float64[ndarray, "n 3"]:
        """Return points at most ``ARC_STEP_DEG`` apart, including both ends."""
        count = max(2, int(np.ceil(np.rad2deg(abs(self.turn_rad)) / ARC_STEP_DEG - 1e-6)) + 1)
        angles_rad = self.first_rad + self.turn_rad * np.linspace(0.0, 1.0, count)[:, None]
        return np.asarray(self.centre + np.cos(angles_rad) * self.x_axis + np.sin(angles_rad) * self.y_axis)

    def part(self, first: float, last: float) -> Arc:
        """Return the part between two shares (0 to 1) of the parameter range."""
        share = last - first
        return replace(
            self,
            first_rad=self.first_rad + first * self.turn_rad,
            turn_rad=share * self.turn_rad,
            parameters=share * self.parameters,
        )

    def reversed(self) -> Arc:
        """Return the arc from its end to its start."""
        return replace(self, first_rad=self.first_rad + self.turn_rad, turn_rad=-self.turn_rad)


Piece = Leg | Arc


def arc_through(
    start: Float64[ndarray, " 3"], middle: Float64[ndarray, " 3"], end: Float64[ndarray, " 3"], angle_rad: float
) -> list[Piece]:
    """Return the circular arc from ``start`` through ``middle`` to ``end``, or two legs if they are collinear.

    The centre c solves |c - start|^2 = |c - end|^2 = |c - middle|^2 in the plane of the three points.
    ``angle_rad`` is the project's plane angle unit.
    """
    to_middle, to_end = middle - start, end - start
    normal = np.cross(to_middle, to_end)
    if np.linalg.norm(normal) <= 1e-9 * np.linalg.norm(to_middle) * np.linalg.norm(to_end):
        return [Leg(start, middle), Leg(middle, end)]
    x_axis = to_end / np.linalg.norm(to_end)
    y_axis = np.cross(normal, x_axis) / np.linalg.norm(normal)
    half = float(np.linalg.norm(to_end)) / 2
    x, y = float(to_middle @ x_axis), float(to_middle @ y_axis)
    centre_y = (x * x + y * y - 2 * half * x) / (2 * y)
    centre, radius = start + half * x_axis + centre_y * y_axis, float(np.hypot(half, centre_y))
    # By the choice of y_axis the middle has negative y, so the arc runs anticlockwise from start to end.
    first = float(np.arctan2(-centre_y, -half))
    turn = (float(np.arctan2(-centre_y, half)) - first) % (2 * np.pi)
    return [Arc(centre, radius * x_axis, radius * y_axis, first, turn, turn / angle_rad)]


def cut(pieces: list[Piece], ranges: list[float], first: float, last: float) -> list[Piece]:
    """Return the pieces between two values of a parameter that counts ``ranges[i]`` along piece i, from 0."""
    kept: list[Piece] = []
    begin = 0.0
    for piece, size in zip(pieces, ranges, strict=True):
        low, high = max(first - begin, 0.0), min(last - begin, size)
        if size > 0 and high > low:
            kept.append(piece.part(low / size, 1.0 if high == size else high / size))
        begin += size
    return kept


def curve_pieces(curve: Any, angle_rad: float, depth: int = 0) -> list[Piece]:
    """Return the pieces of an IFC curve, in order.

    ``angle_rad`` is the project's plane angle unit, in which circles are trimmed. Raises ``ValueError`` if the
    class of the curve is not supported, or if curves are nested too deeply.
    """
    if depth > _MAX_DEPTH:
        raise ValueError(f"curves are nested more than {_MAX_DEPTH} times, or in a circle")
    match curve.is_a():
        case "IfcPolyline":
            pieces = _legs(np.array([point_xyz(point) for point in curve.Points]))
        case "IfcIndexedPolyCurve":
            pieces = _indexed_curve(curve, angle_rad)
        case "IfcCompositeCurve":
            pieces = _composite_curve(curve, angle_rad, depth)
        case "IfcTrimmedCurve":
            pieces = _trimmed_curve(curve, angle_rad, depth)
        case "IfcCircle":
            pieces = [_circle(curve, angle_rad)]
        case name:
            raise ValueError(f"a curve is a {name}, expected lines and arcs of circles")
    if not pieces:
        raise ValueError(f"a curve ({curve.is_a()}) is empty")
    return pieces


def directrix(solid: Any, angle_rad: float) -> tuple[list[Piece], float, float | None]:
    """Return the pieces of an IfcSweptDiskSolid's curve, and the parameters from and to which it is swept.

    Of a line and a circle they are the swept part, from 0. The end is None if it is that of the curve.
    Raises ``ValueError`` as ``curve_pieces`` does, if a line has no ends, if a circle is swept beyond a turn, and
    if some points have lost a coordinate.
    """
    curve, start, end = solid.Directrix, solid.StartParam, solid.EndParam
    inside = [one for one in solid.file.traverse(curve) if one.is_a() in ("IfcCartesianPoint", "IfcDirection")]
    if len({len(one[0]) for one in inside}) > 1:
        raise ValueError("a curve has points of 2 and of 3 coordinates, expected one number")
    size = math.nan if start is None or end is None else float(end) - float(start)
    if curve.is_a("IfcLine"):
        if not 0 < size < math.inf:
            found = f"the disc is swept along an IfcLine from StartParam {start} to EndParam {end}"
            raise ValueError(f"{found}, expected both, the second above the first: a line has no ends")
        origin, along = _origin_and_vector(curve)
        return [Leg(origin + start * along, origin + end * along, size)], 0.0, size
    if curve.is_a("IfcCircle") and start and size > 0:  # From 0, ``curve_pieces`` has the parameters as they are.
        turned = replace(_circle(curve, angle_rad), first_rad=start * angle_rad)
        if size > turned.parameters * (1 + _ANGLE_NOISE_RAD):
            raise ValueError(f"the disc is swept from {start} to {end} along a circle, expected at most one turn")
        return cut([turned], [turned.parameters], 0.0, size), 0.0, size
    return curve_pieces(curve, angle_rad), float(start or 0.0), None if end is None else float(end)


def _legs(points: Float64[ndarray, "n 3"]) -> list[Piece]:
    return [Leg(start, end, legs=len(points) - 1) for start, end in pairwise(points)]


def _indexed_curve(curve: Any, angle_rad: float) -> list[Piece]:
    points = np.array([xyz(row) for row in curve.Points.CoordList])
    if not curve.Segments:
        return _legs(points)
    pieces: list[Piece] = []
    for segment in curve.Segments:
        index = np.array(segment.wrappedValue) - 1
        if index.min() < 0 or index.max() >= len(points):
            raise ValueError("a segment refers to a point that does not exist")
        corners = points[index]
        if segment.is_a("IfcArcIndex"):
            pieces += arc_through(corners[0], corners[1], corners[2], angle_rad)
        else:
            pieces += _legs(corners)
    return pieces


def _composite_curve(curve: Any, angle_rad: float, depth: int) -> list[Piece]:
    pieces: list[Piece] = []
    known: dict[int, list[Piece]] = {}
    for segment in curve.Segments:
        if not segment.is_a("IfcCompositeCurveSegment"):
            raise ValueError(f"a segment is a {segment.is_a()}, expected an IfcCompositeCurveSegment")
        number = segment.ParentCurve.id()
        if number not in known:
            known[number] = curve_pieces(segment.ParentCurve, angle_rad, depth + 1)
        parts = known[number]
        pieces += parts if segment.SameSense else _reversed(parts)
        if len(pieces) > _MAX_PIECES:
            raise ValueError(f"a composite curve has more than {_MAX_PIECES} pieces")
    return pieces


def _reversed(pieces: list[Piece]) -> list[Piece]:
    return [piece.reversed() for piece in reversed(pieces)]


def _trimmed_curve(curve: Any, angle_rad: float, depth: int) -> list[Piece]:
    basis = curve.BasisCurve
    if basis.is_a("IfcLine"):
        start, along = _origin_and_vector(basis)
        first, last = _trim_parameters(curve, lambda point: float((point - start) @ along / (along @ along)), 1.0)
        return [Leg(start + first * along, start + last * along, abs(last - first))]
    if basis.is_a("IfcCircle"):
        return [_trimmed_circle(curve, _circle(basis, angle_rad), angle_rad)]
    if not basis.is_a("IfcPolyline") and not basis.is_a("IfcIndexedPolyCurve"):
        raise ValueError(f"a {basis.is_a()} is trimmed, expected a line, a circle or a polyline")
    pieces = curve_pieces(basis, angle_rad, depth + 1)
    first, last = sorted(_trim_parameters(curve, None, 1.0))
    parts = cut(pieces, [piece.parameters for piece in pieces], first, last)
    return parts if curve.SenseAgreement else _reversed(parts)


def _origin_and_vector(line: Any) -> tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]]:
    """Return the points of an IfcLine at the parameter 0, and its vector to that at 1."""
    return np.array(point_xyz(line.Pnt)), unit_vector(line.Dir.Orientation) * line.Dir.Magnitude


def _trimmed_circle(curve: Any, whole: Arc, angle_rad: float) -> Arc:
    def angle(point: Float64[ndarray, " 3"]) -> float:
        offset = point - whole.centre
        return float(np.arctan2(offset @ whole.y_axis, offset @ whole.x_axis))

    first, last = _trim_parameters(curve, angle, angle_rad)
    turn = _turn_rad(last - first) if curve.SenseAgreement else -_turn_rad(first - last)
    return replace(whole, first_rad=first, turn_rad=turn, parameters=abs(turn) / angle_rad)


def _turn_rad(difference_rad: float) -> float:
    """Return the anticlockwise turn for a difference of angles: 0 to 2 pi, where a multiple of 2 pi is a turn."""
    if abs(difference_rad) < _ANGLE_NOISE_RAD:
        return 0.0
    turn = difference_rad % _FULL_TURN_RAD
    return _FULL_TURN_RAD if turn < _ANGLE_NOISE_RAD else turn


def _trim_parameters(
    curve: Any, of_point: Callable[[Float64[ndarray, " 3"]], float] | None, unit: float
) -> list[float]:
    """Return the parameters of both trims of a curve, each of which IFC gives as a parameter, a point or both.

    ``of_point`` converts a point to a parameter, None where no point can be; ``unit`` scales a parameter.
    """
    parameters: list[float] = []
    for trim in (curve.Trim1, curve.Trim2):
        by_class = {value.is_a(): value for value in trim}
        if "IfcParameterValue" in by_class and not (
            curve.MasterRepresentation == "CARTESIAN" and "IfcCartesianPoint" in by_class
        ):
            parameters.append(float(by_class["IfcParameterValue"].wrappedValue) * unit)
        elif of_point:
            parameters.append(of_point(np.array(point_xyz(by_class["IfcCartesianPoint"]))))
        else:
            raise ValueError("a polyline is trimmed by points, expected parameters")
    return parameters


def _circle(circle: Any, angle_rad: float) -> Arc:
    """Return a whole circle."""
    radius = float(circle.Radius)
    if not radius > 0:
        raise ValueError(f"a circle has the radius {radius}, expected above 0")
    frame = axis_placement(circle.Position)
    x_axis, y_axis = radius * frame[:3, 0], radius * frame[:3, 1]
    return Arc(frame[:3, 3], x_axis, y_axis, 0.0, _FULL_TURN_RAD, _FULL_TURN_RAD / angle_rad)
