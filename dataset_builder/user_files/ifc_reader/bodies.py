"""Bodies of IFC objects: the items of an object's or its type's Body, with nested maps resolved, and placements.

Placements and maps are matrices, points and directions are numbers, in the file's own length unit, as IFC4 (ISO
16739-1) defines them: IfcLocalPlacement, IfcAxis2Placement, IfcMappedItem.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.user_files.ifc_reader.ifc_model import Entity, Model

MAX_PLACEMENT_DEPTH = 50
"""Largest nesting depth of placements; deeper nesting is taken to be a cycle."""

_SCALE_TOLERANCE = 1e-6
"""Largest relative difference between the scales of a map's axes."""

_MAX_BODY_ITEMS = 10_000
"""Largest number of items in one object's Body, with the items of nested maps counted at each use.

A short file with nested maps can expand to billions of items.
"""


def placement_matrix(
    placement: Any, known: dict[int, Float64[ndarray, "4 4"]], depth: int = 0
) -> Float64[ndarray, "4 4"]:
    """Return ``world_from_object`` of an IfcLocalPlacement; None is the world frame.

    ``known`` holds matrices by instance number and is added to, since objects share the placements of storeys.
    Raises ``ValueError`` if a placement has another class or the nesting is too deep.
    """
    if placement is None:
        return np.eye(4)
    if not placement.is_a("IfcLocalPlacement"):
        raise ValueError(f"the placement is a {placement.is_a()}, expected an IfcLocalPlacement")
    if depth > MAX_PLACEMENT_DEPTH:
        raise ValueError(
            f"placements are nested more than {MAX_PLACEMENT_DEPTH} times, or the nesting is circular"
        )
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
    x_axis = unit_vector(target.Axis1, (1.0, 0.0, 0.0))
    target_z = getattr(target, "Axis3", None)
    z_axis = unit_vector(target_z, (0.0, 0.0, 1.0))
    matrix = _frame_matrix(point_xyz(target.LocalOrigin), z_axis, x_axis)
    if matrix[:3, 1] @ unit_vector(target.Axis2, (0.0, 1.0, 0.0)) < 0:  # The target is a reflection.
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
    z_axis = unit_vector(getattr(placement, "Axis", None), (0.0, 0.0, 1.0))
    x_axis = unit_vector(placement.RefDirection, (1.0, 0.0, 0.0))
    return _frame_matrix(point_xyz(placement.Location), z_axis, x_axis)


def _frame_matrix(
    origin: tuple[float, float, float], z_axis: Float64[ndarray, " 3"], x_axis: Float64[ndarray, " 3"]
) -> Float64[ndarray, "4 4"]:
    """Return the right-handed frame with that z axis, and x as close to ``x_axis`` as possible (IfcFirstProjAxis).

    Raises ``ValueError`` if no x axis perpendicular to z can be derived.
    """
    x_axis = x_axis - (x_axis @ z_axis) * z_axis
    if _length(x_axis) < 1e-9:
        x_axis = np.eye(3)[0] - z_axis[0] * z_axis
        if _length(x_axis) < 1e-9:
            raise ValueError("the x and z axes of a placement are parallel")
    x_axis = x_axis / _length(x_axis)
    (x0, x1, x2), (z0, z1, z2) = x_axis.tolist(), z_axis.tolist()
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    px, py, pz = origin
    return np.array([(x0, y0, z0, px), (x1, y1, z1, py), (x2, y2, z2, pz), (0.0, 0.0, 0.0, 1.0)])


def _length(vector: Float64[ndarray, " 3"]) -> float:
    """Return the length of a vector; ``numpy.linalg.norm`` takes several times longer for a single one."""
    return math.sqrt(vector @ vector)


def unit_vector(direction: Any, default: tuple[float, float, float] | None = None) -> Float64[ndarray, " 3"]:
    """Return an IfcDirection, or ``default`` for None, as a unit vector.

    Raises ``ValueError`` if it has no length.
    """
    ratios = np.array(default if direction is None else xyz(direction.DirectionRatios))
    length = _length(ratios)
    if not (math.isfinite(length) and length > 0):
        raise ValueError("a direction has no length")
    return np.asarray(ratios / length)


def point_xyz(point: Any) -> tuple[float, float, float]:
    """Return the coordinates of an IfcCartesianPoint as ``xyz`` does."""
    return xyz(point.Coordinates)


def xyz(coordinates: tuple[float, ...]) -> tuple[float, float, float]:
    """Return two or three coordinates as three, with z = 0 for two; raise ``ValueError`` for more than three."""
    x, y, *rest = coordinates
    if len(rest) > 1:
        raise ValueError(f"a point has {len(coordinates)} coordinates, expected 2 or 3")
    return float(x), float(y), float(rest[0]) if rest else 0.0


@dataclass(frozen=True, eq=False)
class BodyItem:
    """Item of a body, its ``object_from_item``, the factor by which that scales lengths, and its map's use.

    ``use`` is the number of the IfcMappedItem that shows the item, 0 for none: a map is shown several times.
    """

    item: Entity
    object_from_item: Float64[ndarray, "4 4"]
    scale: float
    use: int = 0


def body_items(model: Model, entity: Entity, types: list[Entity]) -> list[BodyItem]:
    """Return the items of an object's Body, or of the Body of its type if it has none, in order.

    Raises ``MeshError`` if an instance below the Body is not as its class says, and ``ValueError`` if there is no
    Body, if a map is not one of a uniform scale, or if there are more than ``_MAX_BODY_ITEMS`` items.
    """
    shape = entity.Representation
    if shape is not None:
        model.check(shape, "Representations")
    bodies = [] if shape is None else _bodies(model, shape.Representations)
    pending = [BodyItem(item, np.eye(4), 1.0) for body in bodies for item in body.Items]
    if not pending:
        pending = [item for type_object in types for item in _type_items(model, type_object)]
    if not pending:
        raise ValueError("the body is empty")
    return _resolved(pending)


def _type_items(model: Model, type_object: Entity) -> list[BodyItem]:
    maps = getattr(type_object, "RepresentationMaps", None) or ()
    bodies = _bodies(model, [source.MappedRepresentation for source in maps])
    for source in maps:
        model.check(source)
        model.check_tree(source.MappingOrigin)
    return [
        BodyItem(item, axis_placement(source.MappingOrigin), 1.0)
        for source in maps
        if source.MappedRepresentation in bodies
        for item in source.MappedRepresentation.Items
    ]


def _bodies(model: Model, representations: Sequence[Entity]) -> list[Entity]:
    """Return the representations named Body, or all of them if there is none, with everything below checked."""
    for representation in representations:
        model.check(representation, "RepresentationIdentifier")
    named = [one for one in representations if one.RepresentationIdentifier == "Body"]
    for body in named or representations:
        model.check_tree(body)
    return named or list(representations)


def _resolved(items: list[BodyItem]) -> list[BodyItem]:
    """Return the items with each IfcMappedItem replaced by the items of its map."""
    pending = items[::-1]
    resolved: list[BodyItem] = []
    for use in range(1, _MAX_BODY_ITEMS + 1):
        if not pending:
            return resolved
        outer = pending.pop()
        if not outer.item.is_a("IfcMappedItem"):
            resolved.append(outer)
            continue
        mapped, factor = mapped_matrix(outer.item)
        matrix, scale = outer.object_from_item @ mapped, outer.scale * factor
        inside = outer.item.MappingSource.MappedRepresentation.Items
        pending += [BodyItem(item, matrix, scale, use) for item in reversed(inside)]
    raise ValueError(f"the body has more than {_MAX_BODY_ITEMS} items, or circular maps")
