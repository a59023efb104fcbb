"""IFC curves and placements as points and matrices, in the file's own length unit.

Implements the definitions of IFC4 (ISO 16739-1): IfcSweptDiskSolid and its directrix, IfcLocalPlacement,
IfcMappedItem. Anything else raises ``ValueError``; the caller then uses the tessellated surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.shapes.bending import bent_line_m, without_repeats

ARC_STEP_DEG = 6.0
"""Largest angle between sampled points of an arc, degrees, as in ``bent_line_m``."""

MAX_PLACEMENT_DEPTH = 50
"""Largest nesting depth of placements; deeper nesting is taken to be a cycle."""

_JOIN_TOLERANCE = 1e-3
"""Largest gap between two joined segments, relative to the extent of the composite curve."""

_SCALE_TOLERANCE = 1e-6
"""Largest relative difference between the scales of a map's axes."""


def directrix(solid: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    """Return the sampled axis of an IfcSweptDiskSolid, including both ends.

    ``angle_rad`` is the project's plane angle unit, in which circles are trimmed. Raises ``ValueError`` if the
    curve is not supported, is swept in part only or is degenerate.
    """
    points = _sample_curve(solid.Directrix, angle_rad)
    if solid.is_a("IfcSweptDiskSolidPolygonal") and solid.FilletRadius:
        points = bent_line_m(points, solid.FilletRadius, ARC_STEP_DEG)
    _check_whole_curve(solid)
    return _drop_repeated_points(points)


def _check_whole_curve(solid: Any) -> None:
    """Raise ``ValueError`` if the disc is swept along a part of the directrix only.

    The whole curve is given by no parameters, by 0 to the number of segments, or by 0 to 1, which is also the
    interpretation of IfcOpenShell.
    """
    curve = solid.Directrix
    segment_attributes = {
        "IfcPolyline": "Points",
        "IfcCompositeCurve": "Segments",
        "IfcIndexedPolyCurve": "Segments",
    }
    parts = getattr(curve, segment_attributes.get(curve.is_a(), ""), None)
    end = None if parts is None else len(parts) - (curve.is_a() == "IfcPolyline")
    if solid.StartParam not in (None, 0.0) or solid.EndParam not in (None, 1.0, end):
        raise ValueError(
            f"the disc is swept from {solid.StartParam} to {solid.EndParam}, expected the whole curve"
        )


def _sample_curve(curve: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    """Return points on an IFC curve; raise ``ValueError`` if its class is not supported."""
    if curve.is_a() not in _CURVE_SAMPLERS:
        raise ValueError(f"a curve is a {curve.is_a()}, expected lines and arcs")
    return _CURVE_SAMPLERS[curve.is_a()](curve, angle_rad)


def _polyline_points(curve: Any, _angle_rad: float) -> Float64[ndarray, "n 3"]:
    return np.array([_point(point) for point in curve.Points])


def _indexed_curve_points(curve: Any, _angle_rad: float) -> Float64[ndarray, "n 3"]:
    points = np.array([_xyz(row) for row in curve.Points.CoordList])
    pieces = []
    for segment in curve.Segments or ():
        index = np.array(segment.wrappedValue) - 1
        if index.min() < 0 or index.max() >= len(points):
            raise ValueError("a segment refers to a point that does not exist")
        corners = points[index]
        pieces.append(arc_through(*corners) if segment.is_a("IfcArcIndex") else corners)
    return _join_segments(pieces) if pieces else points


def _composite_curve_points(curve: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    pieces = []
    for segment in curve.Segments:
        if not segment.is_a("IfcCompositeCurveSegment"):
            raise ValueError(f"a segment is a {segment.is_a()}, expected an IfcCompositeCurveSegment")
        if segment.ParentCurve.is_a("IfcCompositeCurve"):
            raise ValueError("a composite curve contains composite curves")
        points = _sample_curve(segment.ParentCurve, angle_rad)
        pieces.append(points if segment.SameSense else points[::-1])
    return _join_segments(pieces)


def _trimmed_curve_points(curve: Any, angle_rad: float) -> Float64[ndarray, "n 3"]:
    basis = curve.BasisCurve
    if basis.is_a("IfcLine"):
        start = np.array(_point(basis.Pnt))
        along = _unit_vector(basis.Dir.Orientation) * basis.Dir.Magnitude
        ends = [
            _trim_parameter(curve, trim, lambda point: float((point - start) @ along / (along @ along)), 1.0)
            for trim in "12"
        ]
        return np.asarray(start + np.array(ends)[:, None] * along)
    if not basis.is_a("IfcCircle"):
        raise ValueError(f"a {basis.is_a()} is trimmed, expected a line or a circle")
    frame = axis_placement(basis.Position)

    def angle(point: Float64[ndarray, " 3"]) -> float:
        x, y, _ = frame[:3, :3].T @ (point - frame[:3, 3])
        return float(np.arctan2(y, x))

    first, last = (_trim_parameter(curve, trim, angle, angle_rad) for trim in "12")
    turn = (last - first) % (2 * np.pi) if curve.SenseAgreement else -((first - last) % (2 * np.pi))
    angles_rad = first + turn * np.linspace(0.0, 1.0, _sample_count(abs(turn)))[:, None]
    x_axis, y_axis = frame[:3, 0], frame[:3, 1]
    return np.asarray(frame[:3, 3] + basis.Radius * (np.cos(angles_rad) * x_axis + np.sin(angles_rad) * y_axis))


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
        return of_point(np.array(_point(trims_by_class["IfcCartesianPoint"])))
    return float(trims_by_class["IfcParameterValue"].wrappedValue) * unit


_CURVE_SAMPLERS: Mapping[str, Callable[[Any, float], Float64[ndarray, "n 3"]]] = {
    "IfcPolyline": _polyline_points,
    "IfcIndexedPolyCurve": _indexed_curve_points,
    "IfcCompositeCurve": _composite_curve_points,
    "IfcTrimmedCurve": _trimmed_curve_points,
}


def arc_through(
    start: Float64[ndarray, " 3"], middle: Float64[ndarray, " 3"], end: Float64[ndarray, " 3"]
) -> Float64[ndarray, "k 3"]:
    """Return points on the circular arc from ``start`` through ``middle`` to ``end``, with both ends exact.

    The centre c solves |c - start|^2 = |c - end|^2 = |c - middle|^2 in the plane of the three points. Collinear
    points are returned as a line.
    """
    to_middle, to_end = middle - start, end - start
    normal = np.cross(to_middle, to_end)
    if np.linalg.norm(normal) <= 1e-9 * np.linalg.norm(to_middle) * np.linalg.norm(to_end):
        return np.array([start, middle, end])
    x_axis = to_end / np.linalg.norm(to_end)
    y_axis = np.cross(normal, x_axis) / np.linalg.norm(normal)
    half = float(np.linalg.norm(to_end)) / 2
    x, y = float(to_middle @ x_axis), float(to_middle @ y_axis)
    centre_y = (x * x + y * y - 2 * half * x) / (2 * y)
    centre, radius = start + half * x_axis + centre_y * y_axis, float(np.hypot(half, centre_y))
    # By the choice of y_axis the middle has negative y, so the arc runs anticlockwise from start to end.
    first = float(np.arctan2(-centre_y, -half))
    turn = (float(np.arctan2(-centre_y, half)) - first) % (2 * np.pi)
    angles_rad = first + turn * np.linspace(0.0, 1.0, _sample_count(turn))[:, None]
    points = centre + radius * (np.cos(angles_rad) * x_axis + np.sin(angles_rad) * y_axis)
    points[0], points[-1] = start, end
    return np.asarray(points)


def _sample_count(turn_rad: float) -> int:
    """Return the number of points for an arc of ``turn_rad``, including both ends."""
    return max(2, int(np.ceil(np.rad2deg(turn_rad) / ARC_STEP_DEG - 1e-6)) + 1)


def _join_segments(pieces: list[Float64[ndarray, "n 3"]]) -> Float64[ndarray, "k 3"]:
    """Return the pieces as one line; raise ``ValueError`` if the end of one is not the start of the next."""
    line = np.concatenate(pieces)
    extent = float(np.ptp(line, axis=0).max())
    for before, after in pairwise(pieces):
        if np.linalg.norm(after[0] - before[-1]) > _JOIN_TOLERANCE * extent:
            raise ValueError("the segments of a curve are not connected")
    return np.asarray(line)


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


def placement_matrix(
    placement: Any, known: dict[int, Float64[ndarray, "4 4"]], depth: int = 0
) -> Float64[ndarray, "4 4"]:
    """Return ``world_from_object`` of an IfcLocalPlacement; None is the world frame.

    ``known`` holds matrices by instance number and is added to, since objects share the placements of storeys.
    Raises ``ValueError`` if a placement has another class or the nesting is too deep.
    """
    if placement is None:
        return np.eye(4)
    if depth > MAX_PLACEMENT_DEPTH or not placement.is_a("IfcLocalPlacement"):
        raise ValueError(f"the placement is a {placement.is_a()} or is circular")
    number = placement.id()
    if number not in known:
        parent = placement_matrix(placement.PlacementRelTo, known, depth + 1)
        known[number] = parent @ axis_placement(placement.RelativePlacement)
    return known[number]


def mapped_matrix(item: Any) -> tuple[Float64[ndarray, "4 4"], float]:
    """Return ``object_from_map`` of an IfcMappedItem and its scale; mirrored targets are kept mirrored.

    The order is that of IfcOpenShell: the mapping target is applied after the mapping origin. Raises
    ``ValueError`` if the three axes scale differently, since a disc would not remain one.
    """
    target = item.MappingTarget
    x_axis = _unit_vector(target.Axis1, (1.0, 0.0, 0.0))
    target_z = getattr(target, "Axis3", None)
    z_axis = _unit_vector(target_z, (0.0, 0.0, 1.0))
    matrix = _frame_matrix(_point(target.LocalOrigin), z_axis, x_axis)
    if matrix[:3, 1] @ _unit_vector(target.Axis2, (0.0, 1.0, 0.0)) < 0:  # The target is a reflection.
        matrix[:3, 1] *= -1
    scale = 1.0 if target.Scale is None else float(target.Scale)
    other_scales = [getattr(target, name, None) for name in ("Scale2", "Scale3")]
    if not scale > 0 or any(
        other is not None and abs(other - scale) > _SCALE_TOLERANCE * scale for other in other_scales
    ):
        raise ValueError(
            f"a map scales by {scale}, {other_scales[0]}, {other_scales[1]}, expected one factor above 0"
        )
    matrix[:3, :3] *= scale
    return matrix @ axis_placement(item.MappingSource.MappingOrigin), scale


def axis_placement(placement: Any) -> Float64[ndarray, "4 4"]:
    """Return the matrix of an IfcAxis2Placement2D or 3D, with the columns x, y, z and location."""
    z_axis = _unit_vector(getattr(placement, "Axis", None), (0.0, 0.0, 1.0))
    x_axis = _unit_vector(placement.RefDirection, (1.0, 0.0, 0.0))
    return _frame_matrix(_point(placement.Location), z_axis, x_axis)


def _frame_matrix(
    origin: tuple[float, float, float], z_axis: Float64[ndarray, " 3"], x_axis: Float64[ndarray, " 3"]
) -> Float64[ndarray, "4 4"]:
    """Return the right-handed frame with that z axis, and x as close to ``x_axis`` as possible (IfcFirstProjAxis).

    Raises ``ValueError`` if no x axis perpendicular to z can be derived.
    """
    x_axis = x_axis - (x_axis @ z_axis) * z_axis
    if np.linalg.norm(x_axis) < 1e-9:
        x_axis = np.eye(3)[0] - z_axis[0] * z_axis
        if np.linalg.norm(x_axis) < 1e-9:
            raise ValueError("the x and z axes of a placement are parallel")
    x_axis = x_axis / np.linalg.norm(x_axis)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([x_axis, np.cross(z_axis, x_axis), z_axis, origin])
    return matrix


def _unit_vector(direction: Any, default: tuple[float, float, float] | None = None) -> Float64[ndarray, " 3"]:
    """Return an IfcDirection, or ``default`` for None, as a unit vector.

    Raises ``ValueError`` if it has no length.
    """
    ratios = np.array(default if direction is None else _xyz(direction.DirectionRatios))
    length = np.linalg.norm(ratios)
    if not (np.isfinite(length) and length > 0):
        raise ValueError("a direction has no length")
    return np.asarray(ratios / length)


def _point(point: Any) -> tuple[float, float, float]:
    return _xyz(point.Coordinates)


def _xyz(coordinates: tuple[float, ...]) -> tuple[float, float, float]:
    """Return two or three coordinates as three, with z = 0 for two; raise ``ValueError`` for more than three."""
    x, y, *rest = coordinates
    if len(rest) > 1:
        raise ValueError(f"a point has {len(coordinates)} coordinates, expected 2 or 3")
    return float(x), float(y), float(rest[0]) if rest else 0.0
