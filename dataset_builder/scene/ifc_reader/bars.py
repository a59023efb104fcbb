"""Shapes of the reinforcing bars of an IFC model, as modelled: world frame, metres.

Every IfcReinforcingBar is read, in the order of the instance numbers in the file. Each IfcSweptDiskSolid in its
Body, directly or through IfcMappedItem, is one bar, since some programs write a whole row of bars as one object.
The axis is the directrix (polylines, indexed curves of lines and arcs, composite curves of these and of trimmed
lines and circles), the diameter twice the disc's radius. An object with any other item in its Body is
tessellated as a whole. Other reinforcement (IfcReinforcingMesh, IfcTendon) and all other objects are left out.

The project's coordinates are world coordinates; a context's coordinate system and map projections are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from textwrap import shorten

import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.scene.ifc_reader.geometry import directrix, mapped_matrix, placement_matrix
from dataset_builder.scene.ifc_reader.model import Model, angle_unit_rad, length_unit_m, open_model, world_mesh
from dataset_builder.scene.ifc_reader.source_check import Entity
from rebar_depth_bench.errors import MeshError, escape_text

ROLES = {"LIGATURE": "stirrup"}
"""Roles of PredefinedType values whose lower-case name is not used as the role."""

_UNSPECIFIED_TYPES = ("USERDEFINED", "NOTDEFINED", None, "")
_MAX_BODY_ITEMS = 10_000
"""Largest number of items in one object's Body, with the items of nested maps counted at each use.

A short file with nested maps can expand to billions of items.
"""


class ShapeError(MeshError):
    """Object that the geometry kernel cannot tessellate; the message is the reason alone."""


@dataclass(frozen=True, eq=False)
class SweptBar:
    """Bar with an axis: name of its object, role, axis and diameter (world, metres)."""

    label: str
    role: str
    axis_m: Float64[ndarray, "n 3"]
    diameter_m: float


@dataclass(frozen=True, eq=False)
class Surface:
    """Tessellated object, of one or several bars: its name, vertices (world, metres) and triangles."""

    label: str
    vertices_m: Float64[ndarray, "v 3"]
    faces: Int32[ndarray, "f 3"]


def read_bars(
    content: bytes, before_kernel: Callable[[str, str], None] = lambda *_: None
) -> Iterator[SweptBar | Surface]:
    """Yield the shapes of an IFC file's ``content``, in its order.

    ``before_kernel`` is called with an object's name, and the reason why it has no axis, before the geometry
    kernel tessellates it, which may hang or crash.

    Raises ``MeshError`` if the file is not a complete IFC file, has no known length unit or no reinforcing bar, or
    if a bar depends on an instance that was not read as written; ``ShapeError`` if a bar has no usable geometry.
    """
    model = open_model(content)
    objects = model.by_type("IfcReinforcingBar")
    if not objects:
        raise MeshError(f"contains no IfcReinforcingBar{_unread_reinforcement_note(model)}, expected at least one")
    units = length_unit_m(model), angle_unit_rad(model)
    placements: dict[int, Float64[ndarray, "4 4"]] = {}
    for entity in objects:
        _check_object(model, entity)
    if any(_own_kind(entity) is None for entity in objects):
        for relation in model.by_type("IfcRelDefinesByType"):
            model.check.attributes(relation, "RelatedObjects", "RelatingType")
    for entity in objects:
        try:
            shapes = _swept_bars(model, entity, units, placements)
        except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            reason = shorten(str(error), 200) or type(error).__name__
            before_kernel(_label(entity), reason)
            yield _tessellated(model, entity)
        else:
            yield from shapes


def _unread_reinforcement_note(model: Model) -> str:
    """Return a note for the error message on reinforcement of classes that are not read, or an empty string."""
    unread_classes = [name for name in ("IfcReinforcingMesh", "IfcTendon") if model.by_type(name)]
    return f" ({' and '.join(unread_classes)} are not supported)" if unread_classes else ""


def _check_object(model: Model, entity: Entity) -> None:
    """Raise ``MeshError`` unless an object's name, placement and Body were read as written."""
    check = model.check
    try:
        names = (
            "GlobalId",
            "Name",
            "ObjectType",
            "ObjectPlacement",
            "Representation",
            "PredefinedType",
            "BarRole",
        )
        check.attributes(entity, *names)
        if entity.ObjectPlacement is not None:
            check.tree(entity.ObjectPlacement)
        if entity.Representation is not None:
            check.attributes(entity.Representation, "Representations")
            for representation in entity.Representation.Representations:
                check.attributes(representation, "RepresentationIdentifier")
            for body in _bodies(entity):
                check.tree(body)
    except MeshError as error:
        raise MeshError(f"{_label(entity)}: {error}") from error


def _swept_bars(
    model: Model, entity: Entity, units: tuple[float, float], placements: dict[int, Float64[ndarray, "4 4"]]
) -> list[SweptBar]:
    """Return the bar of each swept disc of an object.

    ``units`` are the length unit in metres and the plane angle unit in radians; ``placements`` holds the matrices
    of placements that are known, and is added to.

    Raises ``ValueError`` if its Body is empty or holds other items, and other exceptions if it is incomplete.
    """
    unit_m, angle_rad = units
    world_from_object = placement_matrix(entity.ObjectPlacement, placements)
    label, role = _label(entity), ""
    bars = []
    for solid, object_from_solid, scale in _swept_solids(
        [item for body in _bodies(entity) for item in body.Items]
    ):
        matrix = world_from_object @ object_from_solid
        axis = directrix(solid, angle_rad) @ matrix[:3, :3].T + matrix[:3, 3]
        role = role or _role(model, entity)
        bars.append(SweptBar(label, role, axis * unit_m, 2 * float(solid.Radius) * scale * unit_m))
    if not bars:
        raise ValueError("the body is empty")
    return bars


def _bodies(entity: Entity) -> list[Entity]:
    """Return the object's representations named Body, or all of them if there is none."""
    representations = list(entity.Representation.Representations)
    return [
        representation for representation in representations if representation.RepresentationIdentifier == "Body"
    ] or representations


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


def _tessellated(model: Model, entity: Entity) -> Surface:
    """Return the surface of an object; raise ``ShapeError`` if it cannot be tessellated."""
    try:
        vertices, faces = world_mesh(model, entity.id())
    except RuntimeError as error:
        if "bad_alloc" in str(error):
            raise MemoryError from error
        raise ShapeError(str(error) or "the geometry kernel failed") from error
    if not len(faces):
        raise ShapeError("has no surface")
    return Surface(
        _label(entity), np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int32).reshape(-1, 3)
    )


def _label(entity: Entity) -> str:
    """Return the object's name in error messages: GlobalId and instance number."""
    return f"IfcReinforcingBar {escape_text(str(entity.GlobalId))} (#{entity.id()})"


def _own_kind(source: Entity) -> str | None:
    """Return the PredefinedType (BarRole in IFC2x3) of an object or a type, or None if it has none."""
    kind = getattr(source, "PredefinedType", None) or getattr(source, "BarRole", None)
    return None if kind in _UNSPECIFIED_TYPES else str(kind)


def _role(model: Model, entity: Entity) -> str:
    """Return the role of a bar: its or its type's PredefinedType (BarRole in IFC2x3), else ObjectType or Name."""
    kind = _own_kind(entity)
    for type_object in () if kind else _type_objects(entity):
        model.check.attributes(type_object, "PredefinedType", "BarRole")
        kind = kind or _own_kind(type_object)
    if kind:
        return ROLES.get(kind, kind.lower())
    description = " ".join(str(entity.ObjectType or entity.Name or "").split())
    return description[:60] or "bar"


def _type_objects(entity: Entity) -> list[Entity]:
    """Return the IfcTypeObjects that define an object."""
    relations = [*(getattr(entity, "IsTypedBy", None) or ()), *(getattr(entity, "IsDefinedBy", None) or ())]
    return [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]
