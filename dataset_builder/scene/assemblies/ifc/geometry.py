"""Curves and placements of IFC as points and matrices, in the file's own length unit.

Written after the definitions of IFC4 (ISO 16739-1): IfcSweptDiskSolid and its directrix, IfcLocalPlacement,
IfcMappedItem. Whatever else a file may hold raises ``ValueError``; the caller then takes the tessellated surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.shapes.bending import bent_line_m

STEP_DEG = 6.0
"""Arcs come as points this far apart at most, like those of ``bent_line_m``."""

MAX_DEPTH = 50
"""Of placements within each other: a cycle is deeper."""

_JOIN = 1e-3
"""Of a composite curve's extent: how far apart the ends of two joined segments may lie."""
_SAME_SCALE = 1e-6


def directrix(solid: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    """Return the sampled axis of an IfcSweptDiskSolid, both ends included.

    ``angle_rad`` is the project's plane angle unit, in which circles are trimmed.
    """
    points = _points(solid.Directrix, angle_rad)
    if solid.is_a("IfcSweptDiskSolidPolygonal") and solid.FilletRadius:
        points = bent_line_m(points, solid.FilletRadius, STEP_DEG)
    _check_whole_curve(solid)
    return _without_repeats(points)


def _check_whole_curve(solid: Any) -> None:
    """Raise ``ValueError`` where the disc is swept along a part of the directrix only.

    The whole is nothing said, 0 to the number of segments, or 0 to 1, as IfcOpenShell takes it too.
    """
    curve = solid.Directrix
    counted = {"IfcPolyline": "Points", "IfcCompositeCurve": "Segments", "IfcIndexedPolyCurve": "Segments"}
    parts = getattr(curve, counted.get(curve.is_a(), ""), None)
    end = None if parts is None else len(parts) - (curve.is_a() == "IfcPolyline")
    if solid.StartParam not in (None, 0.0) or solid.EndParam not in (None, 1.0, end):
        raise ValueError(
            f"the disc is swept from {solid.StartParam} to {solid.EndParam}, expected the whole curve"
        )


def _points(curve: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    if curve.is_a() not in _CURVES:
        raise ValueError(f"a curve is a {curve.is_a()}, expected lines and arcs")
    return _CURVES[curve.is_a()](curve, angle_rad)


def _polyline(curve: Any, _angle_rad: float) -> Float64[ndarray, "n 3"]:
    return np.array([_point(point) for point in curve.Points])


def _indexed(curve: Any, _angle_rad: float) -> Float64[ndarray, "n 3"]:
    points = np.array([_xyz(row) for row in curve.Points.CoordList])
    pieces = []
    for segment in curve.Segments or ():
        index = np.array(segment.wrappedValue) - 1
        if index.min() < 0 or index.max() >= len(points):
            raise ValueError("a segment names a point that is not there")
        corners = points[index]
        pieces.append(arc_through(*corners) if segment.is_a("IfcArcIndex") else corners)
    return _joined(pieces) if pieces else points


def _composite(curve: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    pieces = []
    for segment in curve.Segments:
        if not segment.is_a("IfcCompositeCurveSegment"):
            raise ValueError(f"a segment is a {segment.is_a()}, expected an IfcCompositeCurveSegment")
        if segment.ParentCurve.is_a("IfcCompositeCurve"):
            raise ValueError("a composite curve is made of composite curves")
        points = _points(segment.ParentCurve, angle_rad)
        pieces.append(points if segment.SameSense else points[::-1])
    return _joined(pieces)


def _trimmed(curve: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    basis = curve.BasisCurve
    if basis.is_a("IfcLine"):
        start = np.array(_point(basis.Pnt))
        along = _direction(basis.Dir.Orientation) * basis.Dir.Magnitude
        ends = [
            _trim(curve, trim, lambda point: float((point - start) @ along / (along @ along)), 1.0)
            for trim in "12"
        ]
        return np.asarray(start + np.array(ends)[:, None] * along)
    if not basis.is_a("IfcCircle"):
        raise ValueError(f"a {basis.is_a()} is trimmed, expected a line or a circle")
    frame = axis_placement(basis.Position)

    def angle(point: Float64[ndarray, " 3"]) -> float:
        x, y, _ = frame[:3, :3].T @ (point - frame[:3, 3])
        return float(np.arctan2(y, x))

    first, last = (_trim(curve, trim, angle, angle_rad) for trim in "12")
    turn = (last - first) % (2 * np.pi) if curve.SenseAgreement else -((first - last) % (2 * np.pi))
    at = first + turn * np.linspace(0.0, 1.0, _samples(abs(turn)))[:, None]
    x_axis, y_axis = frame[:3, 0], frame[:3, 1]
    return np.asarray(frame[:3, 3] + basis.Radius * (np.cos(at) * x_axis + np.sin(at) * y_axis))


def _trim(curve: Any, which: str, of_point: Callable[[Float64[ndarray, " 3"]], float], unit: float) -> float:
    """Return the parameter at which a curve is trimmed: given as such, or by a point, or as both."""
    given = {value.is_a(): value for value in getattr(curve, f"Trim{which}")}
    as_point = "IfcCartesianPoint" in given and (
        curve.MasterRepresentation == "CARTESIAN" or "IfcParameterValue" not in given
    )
    if as_point:
        return of_point(np.array(_point(given["IfcCartesianPoint"])))
    return float(given["IfcParameterValue"].wrappedValue) * unit


_CURVES: Mapping[str, Callable[[Any, float], Float64[ndarray, "n 3"]]] = {
    "IfcPolyline": _polyline,
    "IfcIndexedPolyCurve": _indexed,
    "IfcCompositeCurve": _composite,
    "IfcTrimmedCurve": _trimmed,
}


def arc_through(
    start: Float64[ndarray, " 3"], middle: Float64[ndarray, " 3"], end: Float64[ndarray, " 3"]
) -> Float64[ndarray, "k 3"]:
    """Return points on the circle's arc from ``start`` through ``middle`` to ``end``, the two ends exact.

    The centre solves |c - a|^2 = |c - b|^2 = |c - m|^2 in the plane of the three. Three points on a line give
    that line.
    """
    to_middle, to_end = middle - start, end - start
    normal = np.cross(to_middle, to_end)
    if np.linalg.norm(normal) <= 1e-9 * np.linalg.norm(to_middle) * np.linalg.norm(to_end):
        return np.array([start, middle, end])
    x_axis = to_end / np.linalg.norm(to_end)
    y_axis = np.cross(normal, x_axis) / np.linalg.norm(normal)
    half = float(np.linalg.norm(to_end)) / 2
    x, y = float(to_middle @ x_axis), float(to_middle @ y_axis)
    up = (x * x + y * y - 2 * half * x) / (2 * y)
    centre, radius = start + half * x_axis + up * y_axis, float(np.hypot(half, up))
    # With y_axis as it is, the middle lies at negative y: the arc runs anticlockwise from start to end.
    first = float(np.arctan2(-up, -half))
    turn = (float(np.arctan2(-up, half)) - first) % (2 * np.pi)
    at = first + turn * np.linspace(0.0, 1.0, _samples(turn))[:, None]
    points = centre + radius * (np.cos(at) * x_axis + np.sin(at) * y_axis)
    points[0], points[-1] = start, end
    return np.asarray(points)


def _samples(turn_rad: float) -> int:
    return max(2, int(np.ceil(np.rad2deg(turn_rad) / STEP_DEG - 1e-6)) + 1)


def _joined(pieces: list[Float64[ndarray, "n 3"]]) -> Float64[ndarray, "k 3"]:
    """Return the pieces as one line; raise ``ValueError`` where the end of one is not the start of the next."""
    line = np.concatenate(pieces)
    extent = float(np.ptp(line, axis=0).max())
    for before, after in pairwise(pieces):
        if np.linalg.norm(after[0] - before[-1]) > _JOIN * extent:
            raise ValueError("the segments of a curve do not join")
    return np.asarray(line)


def _without_repeats(points: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Drop points that lie on the one before, to a millionth of the curve's extent."""
    if len(points) < 2 or not np.isfinite(points).all():
        raise ValueError("a curve has no two points, or one that is not finite")
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    kept = points[np.concatenate([[True], steps > 1e-6 * np.ptp(points, axis=0).max()])]
    if len(kept) < 2:
        raise ValueError("a curve has no length")
    return np.asarray(kept)


def placement_matrix(placement: Any, depth: int = 0) -> Float64[ndarray, "4 4"]:
    """Return ``world_from_object`` of an IfcLocalPlacement, None being the world itself."""
    if placement is None:
        return np.eye(4)
    if depth > MAX_DEPTH or not placement.is_a("IfcLocalPlacement"):
        raise ValueError(f"the placement is a {placement.is_a()} or goes round in a circle")
    parent = placement_matrix(placement.PlacementRelTo, depth + 1)
    return np.asarray(parent @ axis_placement(placement.RelativePlacement))


def mapped_matrix(item: Any) -> tuple[Float64[ndarray, "4 4"], float]:
    """Return ``object_from_map`` of an IfcMappedItem and its scale; a mirror is one as it stands.

    The map's origin is placed as IfcOpenShell places it: target after origin. Raises ``ValueError`` where the
    three axes scale differently, since a disc would be none any more.
    """
    target = item.MappingTarget
    x_axis = _direction(target.Axis1, (1.0, 0.0, 0.0))
    third = getattr(target, "Axis3", None)
    z_axis = _direction(third, (0.0, 0.0, 1.0))
    matrix = _frame(_point(target.LocalOrigin), z_axis, x_axis)
    if matrix[:3, 1] @ _direction(target.Axis2, (0.0, 1.0, 0.0)) < 0:  # a mirror
        matrix[:3, 1] *= -1
    scale = 1.0 if target.Scale is None else float(target.Scale)
    others = [getattr(target, name, None) for name in ("Scale2", "Scale3")]
    if not scale > 0 or any(other is not None and abs(other - scale) > _SAME_SCALE * scale for other in others):
        raise ValueError(f"a map scales by {scale}, {others[0]}, {others[1]}, expected one factor above 0")
    matrix[:3, :3] *= scale
    return matrix @ axis_placement(item.MappingSource.MappingOrigin), scale


def axis_placement(placement: Any) -> Float64[ndarray, "4 4"]:
    """Return the matrix of an IfcAxis2Placement2D or 3D: its columns are x, y, z and the location."""
    z_axis = _direction(getattr(placement, "Axis", None), (0.0, 0.0, 1.0))
    x_axis = _direction(placement.RefDirection, (1.0, 0.0, 0.0))
    return _frame(_point(placement.Location), z_axis, x_axis)


def _frame(
    origin: tuple[float, float, float], z_axis: Float64[ndarray, " 3"], x_axis: Float64[ndarray, " 3"]
) -> Float64[ndarray, "4 4"]:
    """Return the right-handed frame with that z, and x as near to ``x_axis`` as it can be (IfcFirstProjAxis)."""
    x_axis = x_axis - (x_axis @ z_axis) * z_axis
    if np.linalg.norm(x_axis) < 1e-9:
        x_axis = np.eye(3)[0] - z_axis[0] * z_axis
        if np.linalg.norm(x_axis) < 1e-9:
            raise ValueError("the x and z axes of a placement are parallel")
    x_axis = x_axis / np.linalg.norm(x_axis)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis, origin])
    return matrix


def _direction(direction: Any, default: tuple[float, float, float] | None = None) -> Float64[ndarray, " 3"]:
    ratios = np.array(default if direction is None else _xyz(direction.DirectionRatios))
    length = np.linalg.norm(ratios)
    if not (np.isfinite(length) and length > 0):
        raise ValueError("a direction has no length")
    return np.asarray(ratios / length)


def _point(point: Any) -> tuple[float, float, float]:
    return _xyz(point.Coordinates)


def _xyz(coordinates: tuple[float, ...]) -> tuple[float, float, float]:
    """Return two or three coordinates as three."""
    x, y, *rest = coordinates
    if len(rest) > 1:
        raise ValueError(f"a point has {len(coordinates)} coordinates, expected 2 or 3")
    return float(x), float(y), float(rest[0]) if rest else 0.0
