"""Reinforcing bars of an IFC model: axes and diameters as modelled, world frame, metres.

Every IfcReinforcingBar is read, in the order of the instance numbers in the file; bar ids start at 1. Each
IfcSweptDiskSolid in its Body, directly or through IfcMappedItem, is one bar, since some programs write a whole
row of bars as one object. The axis is the directrix (polylines, indexed curves of lines and arcs, composite
curves of these and of trimmed lines and circles), the diameter twice the disc's radius. An object with any other
item in its Body is tessellated; each connected surface is then a bar with the straight axis and the diameter of
``estimate_bar`` and the role "imported". Other reinforcement (IfcReinforcingMesh, IfcTendon) and all other
objects are left out.

The project's coordinates are world coordinates; a context's coordinate system and map projections are ignored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import shorten

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage_assembly import CageBar
from dataset_builder.scene.assemblies.ifc.geometry import directrix, mapped_matrix, placement_matrix
from dataset_builder.scene.assemblies.ifc.model import Entity, Model, angle_unit_rad, length_unit_m, open_model
from dataset_builder.scene.assemblies.ifc.tessellation import tessellate
from dataset_builder.scene.assemblies.mesh_file import estimate_bar
from dataset_builder.scene.assemblies.mesh_import import connected_components
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS, Mesh, axis_of
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import MeshError

ROLES = {"LIGATURE": "stirrup"}
"""Roles of PredefinedType values whose lower-case name is not used as the role."""

_UNSPECIFIED_TYPES = ("USERDEFINED", "NOTDEFINED", None, "")
_MAX_BODY_ITEMS = 10_000
"""Largest number of items in one object's Body, with the items of nested maps counted at each use.

A short file with nested maps can expand to billions of items.
"""


@dataclass(frozen=True, eq=False)
class _BarGeometry:
    """Geometry of a bar without its id: axis (world, metres) and diameter, or else its surface (world, metres)."""

    entity: Entity
    axis_m: Float64[ndarray, "n 3"] | None = None
    diameter_m: float = 0.0
    mesh: Mesh | None = None


def ifc_bars(content: bytes, where: str) -> list[CageBar]:
    """Return the bars of an IFC file's ``content``; ``where`` names the file in error messages.

    Raises ``MeshError`` if the file is not a complete IFC file, has no known length unit, no reinforcing bar or
    one without usable geometry (with its GlobalId); ``InputError`` if ifcopenshell is not installed.
    """
    model = open_model(content, where)
    objects = sorted(model.by_type("IfcReinforcingBar"), key=lambda entity: int(entity.id()))
    if not objects:
        raise MeshError(
            f"{where}: contains no IfcReinforcingBar{_unread_reinforcement_note(model)}, expected at least one"
        )
    unit_m, angle_rad = length_unit_m(model, where), angle_unit_rad(model)
    shapes: dict[int, list[_BarGeometry]] = {}
    reasons: dict[int, str] = {}
    for entity in objects:
        try:
            shapes[entity.id()] = _swept_shapes(entity, unit_m, angle_rad)
        except Exception as error:  # Incomplete instances raise various exceptions on attribute access.
            reasons[entity.id()] = shorten(str(error), 200) or type(error).__name__
    shapes |= _tessellated_shapes(
        content, where, [entity for entity in objects if entity.id() in reasons], reasons
    )
    all_shapes = [shape for entity in objects for shape in shapes[entity.id()]]
    if len(all_shapes) > MAX_BARS:
        raise MeshError(f"{where}: {len(all_shapes)} bars found, expected at most {MAX_BARS}")
    return [_cage_bar(bar_id, shape, where) for bar_id, shape in enumerate(all_shapes, start=1)]


def _unread_reinforcement_note(model: Model) -> str:
    """Return a note for the error message on reinforcement of classes that are not read, or an empty string."""
    unread_classes = [name for name in ("IfcReinforcingMesh", "IfcTendon") if model.by_type(name)]
    return f" ({' and '.join(unread_classes)} are not supported)" if unread_classes else ""


def _swept_shapes(entity: Entity, unit_m: float, angle_rad: float) -> list[_BarGeometry]:
    """Return the geometry of each swept disc of an object.

    Raises ``ValueError`` if its Body is empty or holds other items, and other exceptions if it is incomplete.
    """
    world_from_object = placement_matrix(entity.ObjectPlacement)
    shapes = []
    for solid, object_from_solid, scale in _swept_solids(_body_items(entity)):
        matrix = world_from_object @ object_from_solid
        axis = directrix(solid, angle_rad) @ matrix[:3, :3].T + matrix[:3, 3]
        diameter_m = round(2 * float(solid.Radius) * scale * unit_m, METRE_DECIMALS)
        shapes.append(_BarGeometry(entity, np.round(axis * unit_m, METRE_DECIMALS), diameter_m))
    if not shapes:
        raise ValueError("the body is empty")
    return shapes


def _body_items(entity: Entity) -> list[Entity]:
    """Return the items of the object's Body, or of all its representations if there is no Body."""
    representations = entity.Representation.Representations
    bodies = [
        representation for representation in representations if representation.RepresentationIdentifier == "Body"
    ] or representations
    return [item for body in bodies for item in body.Items]


def _swept_solids(items: list[Entity]) -> Iterator[tuple[Entity, Float64[ndarray, "4 4"], float]]:
    """Yield each swept disc with its ``object_from_solid`` and scale, in order, including nested maps.

    Raises ``ValueError`` if there is another item or there are more than ``_MAX_BODY_ITEMS``.
    """
    maps: dict[int, tuple[Float64[ndarray, "4 4"], float, list[Entity]]] = {}
    pending = [(item, np.eye(4), 1.0) for item in reversed(items)]
    for _ in range(_MAX_BODY_ITEMS):
        if not pending:
            return
        item, matrix, scale = pending.pop()
        if item.is_a("IfcMappedItem"):
            if item.id() not in maps:
                inside = item.MappingSource.MappedRepresentation.Items
                maps[item.id()] = (*mapped_matrix(item), list(reversed(inside)))
            mapped, factor, inner = maps[item.id()]
            pending += [(mapped_item, matrix @ mapped, scale * factor) for mapped_item in inner]
        elif item.is_a("IfcSweptDiskSolid"):
            yield item, matrix, scale
        else:
            raise ValueError(f"the body is a {item.is_a()}")
    raise ValueError(f"the body has more than {_MAX_BODY_ITEMS} items, or circular maps")


def _tessellated_shapes(
    content: bytes, where: str, objects: list[Entity], reasons: dict[int, str]
) -> dict[int, list[_BarGeometry]]:
    """Return the connected surfaces of ``objects`` by instance number.

    ``reasons`` are the errors with which their swept discs could not be read. Raises ``MeshError`` if an object
    cannot be tessellated.
    """
    surfaces: dict[int, list[_BarGeometry]] = {}
    if not objects:
        return surfaces
    ids = [entity.id() for entity in objects]
    for entity, mesh in zip(objects, tessellate(content, where, ids), strict=False):
        if isinstance(mesh, str):
            raise MeshError(
                f"{where}: {_label(entity)} has no readable shape: {reasons[entity.id()]}; "
                f"tessellation: {mesh}; expected an IfcSweptDiskSolid along lines and arcs, or another solid"
            )
        surfaces[entity.id()] = [_BarGeometry(entity, mesh=part) for part in connected_components(mesh)]
    return surfaces


def _cage_bar(bar_id: int, shape: _BarGeometry, where: str) -> CageBar:
    """Return the bar with its id; raise ``MeshError`` if its surface has no area."""
    label = f"bar {bar_id}, {_label(shape.entity)}"
    if shape.mesh is not None:
        try:
            return CageBar(label, estimate_bar(bar_id, shape.mesh), mesh=shape.mesh)
        except ValueError as error:
            raise MeshError(f"{where}: {label}: is not a solid ({error}), expected a bar") from error
    assert shape.axis_m is not None
    return CageBar(label, Bar(bar_id, _role(shape.entity), shape.diameter_m, axis_of(shape.axis_m)))


def _label(entity: Entity) -> str:
    """Return the object's name in error messages: GlobalId and instance number."""
    return f"IfcReinforcingBar {entity.GlobalId} (#{entity.id()})"


def _role(entity: Entity) -> str:
    """Return the role of a bar: its or its type's PredefinedType (BarRole in IFC2x3), else ObjectType or Name."""
    for source in (entity, *_type_objects(entity)):
        kind = getattr(source, "PredefinedType", None) or getattr(source, "BarRole", None)
        if kind not in _UNSPECIFIED_TYPES:
            return ROLES.get(kind, str(kind).lower())
    description = " ".join(str(entity.ObjectType or entity.Name or "").split())
    return description[:60] or "bar"


def _type_objects(entity: Entity) -> list[Entity]:
    """Return the IfcTypeObjects that define an object."""
    relations = [*(getattr(entity, "IsTypedBy", None) or ()), *(getattr(entity, "IsDefinedBy", None) or ())]
    return [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]
