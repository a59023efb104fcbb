"""IFC curves as pieces: straight legs, arcs and sampled curves, in the file's length unit.

Each piece counts parameters as ISO 10303-42 does for the curve that it comes from, and can be cut exactly.
Polylines, indexed, composite and trimmed curves, conics and B-splines are read as IFC2x3 and IFC4 (ISO 16739-1)
define them. Anything else raises ``ValueError``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Self

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

_MAX_SPLINE_POINTS = 20_000
"""Largest number of sampled points of one B-spline."""

_FULL_TURN_RAD = 2 * np.pi
_ANGLE_NOISE_RAD = 1e-9


@dataclass(frozen=True, eq=False)
class Sampled:
    """Curve sampled at increasing ``shares`` (0 to 1) of its parameter range ``parameters``."""

    line: Float64[ndarray, "n 3"]
    shares: Float64[ndarray, " n"]
    parameters: float

    @property
    def length(self) -> float:
        """Length of the line through the samples."""
        return float(np.linalg.norm(np.diff(self.line, axis=0), axis=1).sum())

    def points(self) -> Float64[ndarray, "n 3"]:
        """Return the sampled points."""
        return self.line

    def part(self, first: float, last: float) -> Self:
        """Return the part between two shares of the parameter range, interpolated at its ends."""
        inner = (self.shares > first) & (self.shares < last)
        at = np.concatenate([[first], self.shares[inner], [last]])
        line = np.stack([np.interp(at, self.shares, column) for column in self.line.T], axis=-1)
        size = last - first
        return replace(self, line=line, shares=(at - first) / size, parameters=self.parameters * size)

    def reversed(self) -> Self:
        """Return the curve from its end to its start."""
        return replace(self, line=self.line[::-1], shares=1 - self.shares[::-1])


@dataclass(frozen=True, eq=False)
class Leg(Sampled):
    """Straight leg; ``parameters`` is its parameter range: 1 in a polyline, else a multiple of a line's vector.

    ``legs`` is the number of legs of its polyline, 1 for a line.
    """

    legs: int = 1

    @classmethod
    def between(
        cls, start: Float64[ndarray, " 3"], end: Float64[ndarray, " 3"], parameters: float = 1.0, legs: int = 1
    ) -> Leg:
        """Return the leg between two points."""
        return cls(np.array([start, end]), np.array([0.0, 1.0]), parameters, legs)


@dataclass(frozen=True, eq=False)
class Arc:
    """Arc of a circle or an ellipse: centre + cos(t) x_axis + sin(t) y_axis for t from ``first_rad``.

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
        """Length of the arc of a circle; that of an ellipse is by its first half axis."""
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


Piece = Sampled | Arc


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
        return [Leg.between(start, middle), Leg.between(middle, end)]
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

    ``angle_rad`` is the project's plane angle unit, in which conics are trimmed. Raises ``ValueError`` if the
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
        case "IfcCircle" | "IfcEllipse":
            pieces = [_conic(curve, angle_rad)]
        case "IfcBSplineCurveWithKnots" | "IfcRationalBSplineCurveWithKnots":
            pieces = [_b_spline(curve)]
        case name:
            raise ValueError(f"a curve is a {name}, expected lines, arcs and B-splines")
    if not pieces:
        raise ValueError(f"a curve ({curve.is_a()}) is empty")
    return pieces


def directrix(solid: Any, angle_rad: float) -> tuple[list[Piece], float, float | None]:
    """Return the pieces of an IfcSweptDiskSolid's curve, and the parameters from and to which it is swept.

    Of a line, a circle and an ellipse they are the swept part, from 0. The end is None if it is that of the curve.
    Raises ``ValueError`` as ``curve_pieces`` does, and if a line has no ends or a circle is swept beyond a turn.
    """
    curve, start, end = solid.Directrix, solid.StartParam, solid.EndParam
    size = math.nan if start is None or end is None else float(end) - float(start)
    if curve.is_a("IfcLine"):
        if not 0 < size < math.inf:
            found = f"the disc is swept along an IfcLine from StartParam {start} to EndParam {end}"
            raise ValueError(f"{found}, expected both, the second above the first: a line has no ends")
        origin, along = _origin_and_vector(curve)
        return [Leg.between(origin + start * along, origin + end * along, size)], 0.0, size
    if curve.is_a("IfcConic") and start and size > 0:  # From 0, ``curve_pieces`` has the parameters as they are.
        turned = replace(_conic(curve, angle_rad), first_rad=start * angle_rad)
        if size > turned.parameters * (1 + _ANGLE_NOISE_RAD):
            raise ValueError(f"the disc is swept from {start} to {end} along a circle, expected at most one turn")
        return cut([turned], [turned.parameters], 0.0, size), 0.0, size
    return curve_pieces(curve, angle_rad), float(start or 0.0), None if end is None else float(end)


def _legs(points: Float64[ndarray, "n 3"]) -> list[Piece]:
    return [Leg.between(start, end, legs=len(points) - 1) for start, end in pairwise(points)]


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
        return [_trimmed_line(curve, basis)]
    if basis.is_a("IfcConic"):
        return [_trimmed_conic(curve, basis, angle_rad)]
    if basis.is_a("IfcCompositeCurve") or basis.is_a("IfcTrimmedCurve"):
        raise ValueError(f"a {basis.is_a()} is trimmed, expected a curve that is not made of others")
    pieces = curve_pieces(basis, angle_rad, depth + 1)
    begin = _knot_vector(basis)[int(basis.Degree)] if basis.is_a("IfcBSplineCurve") else 0.0
    first, last = sorted(_trim_parameter(curve, trim, _no_parameter, 1.0) - begin for trim in "12")
    parts = cut(pieces, [piece.parameters for piece in pieces], first, last)
    return parts if curve.SenseAgreement else _reversed(parts)


def _trimmed_line(curve: Any, line: Any) -> Leg:
    start, along = _origin_and_vector(line)
    first, last = (
        _trim_parameter(curve, trim, lambda point: float((point - start) @ along / (along @ along)), 1.0)
        for trim in "12"
    )
    return Leg.between(start + first * along, start + last * along, abs(last - first))


def _origin_and_vector(line: Any) -> tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]]:
    """Return the points of an IfcLine at the parameter 0, and its vector to that at 1."""
    return np.array(point_xyz(line.Pnt)), unit_vector(line.Dir.Orientation) * line.Dir.Magnitude


def _trimmed_conic(curve: Any, conic: Any, angle_rad: float) -> Arc:
    whole = _conic(conic, angle_rad)
    x_unit, y_unit = whole.x_axis / (whole.x_axis @ whole.x_axis), whole.y_axis / (whole.y_axis @ whole.y_axis)

    def angle(point: Float64[ndarray, " 3"]) -> float:
        offset = point - whole.centre
        return float(np.arctan2(offset @ y_unit, offset @ x_unit))

    first, last = (_trim_parameter(curve, trim, angle, angle_rad) for trim in "12")
    turn = _turn_rad(last - first) if curve.SenseAgreement else -_turn_rad(first - last)
    return Arc(whole.centre, whole.x_axis, whole.y_axis, first, turn, abs(turn) / angle_rad)


def _turn_rad(difference_rad: float) -> float:
    """Return the anticlockwise turn for a difference of angles: 0 to 2 pi, where a multiple of 2 pi is a turn."""
    if abs(difference_rad) < _ANGLE_NOISE_RAD:
        return 0.0
    turn = difference_rad % _FULL_TURN_RAD
    return _FULL_TURN_RAD if turn < _ANGLE_NOISE_RAD else turn


def _no_parameter(_point: Float64[ndarray, " 3"]) -> float:
    raise ValueError("a curve is trimmed by points, expected parameters unless it is a line or an arc")


def _trim_parameter(
    curve: Any, which: str, of_point: Callable[[Float64[ndarray, " 3"]], float], unit: float
) -> float:
    """Return the parameter of the trim ``which`` ("1" or "2"), which IFC gives as a parameter, a point or both.

    ``of_point`` converts a point to a parameter; ``unit`` scales a parameter.
    """
    trims_by_class = {value.is_a(): value for value in getattr(curve, f"Trim{which}")}
    as_point = "IfcCartesianPoint" in trims_by_class and (
        curve.MasterRepresentation == "CARTESIAN" or "IfcParameterValue" not in trims_by_class
    )
    if as_point:
        return of_point(np.array(point_xyz(trims_by_class["IfcCartesianPoint"])))
    return float(trims_by_class["IfcParameterValue"].wrappedValue) * unit


def _conic(conic: Any, angle_rad: float) -> Arc:
    """Return a whole circle or ellipse."""
    if conic.is_a("IfcCircle"):
        semi_axes = float(conic.Radius), float(conic.Radius)
    else:
        semi_axes = float(conic.SemiAxis1), float(conic.SemiAxis2)
    if not min(semi_axes) > 0:
        raise ValueError(f"a curve ({conic.is_a()}) has the radius {min(semi_axes)}, expected above 0")
    frame = axis_placement(conic.Position)
    x_axis, y_axis = semi_axes[0] * frame[:3, 0], semi_axes[1] * frame[:3, 1]
    return Arc(frame[:3, 3], x_axis, y_axis, 0.0, _FULL_TURN_RAD, _FULL_TURN_RAD / angle_rad)


def _b_spline(curve: Any) -> Sampled:
    """Return a B-spline with knots, sampled so that neighbouring chords turn by at most ``ARC_STEP_DEG``."""
    from scipy.interpolate import BSpline  # Imported when needed: it takes a second.

    degree = int(curve.Degree)
    knots = _knot_vector(curve)
    weights = np.array(getattr(curve, "WeightsData", None) or np.ones(len(curve.ControlPointsList)))
    control = np.array([point_xyz(point) for point in curve.ControlPointsList])
    if len(weights) != len(control) or len(knots) != len(control) + degree + 1 or not (weights > 0).all():
        raise ValueError("the knots or weights of a B-spline do not match its control points")
    spline = BSpline(knots, np.column_stack([control * weights[:, None], weights]), degree)
    spans = np.unique(knots[degree : len(control) + 1])
    for per_span in 2 ** np.arange(2, 12):
        if len(spans) * per_span > _MAX_SPLINE_POINTS:
            break
        at = np.concatenate([np.linspace(a, b, per_span, endpoint=False) for a, b in pairwise(spans)])
        at = np.append(at, spans[-1])
        values = spline(at)
        line = values[:, :3] / values[:, 3:]
        if _largest_turn_deg(line) <= ARC_STEP_DEG:
            size = float(spans[-1] - spans[0])
            return Sampled(line, (at - spans[0]) / size, size)
    raise ValueError(f"a B-spline needs more than {_MAX_SPLINE_POINTS} points, or has a sharp corner")


def _knot_vector(curve: Any) -> Float64[ndarray, " k"]:
    """Return the knots of a B-spline, each repeated as often as it counts; the curve begins at ``[degree]``.

    Raises ``ValueError`` if the multiplicities are not valid.
    """
    degree, repeats = int(curve.Degree), [int(count) for count in curve.KnotMultiplicities]
    if len(repeats) != len(curve.Knots) or not all(1 <= count <= degree + 1 for count in repeats):
        raise ValueError("the knot multiplicities of a B-spline are not valid")
    return np.repeat(np.array(curve.Knots, np.float64), repeats)


def _largest_turn_deg(line: Float64[ndarray, "n 3"]) -> float:
    """Return the largest angle between neighbouring chords, degrees."""
    chords = np.diff(line, axis=0)
    before, after = chords[:-1], chords[1:]
    sines, cosines = np.linalg.norm(np.cross(before, after), axis=1), (before * after).sum(axis=1)
    return float(np.rad2deg(np.arctan2(sines, cosines)).max())
