"""Objects of an IFC model: which are read, by class or by selection, the names they have by relations, and sizes.

The host of reinforcement is the element that it is a part of, or is connected with. The storey is the one that
contains the object, or the nearest of those that it is a part of. A layer is assigned to a shape, or to an item of
it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten

from dataset_builder.scene.ifc_reader.model import Entity, Model
from dataset_builder.scene.selection import Selection
from rebar_depth_bench.errors import MeshError, escape_text

CLASSES = ("IfcReinforcingBar", "IfcReinforcingMesh", "IfcTendon")
"""Classes of reinforcement, which is read without a selection."""

DAMAGE = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Exceptions of instances that are incomplete or not supported."""

MAX_NAME = 60
_NAMED_CLASSES = 5


@dataclass(frozen=True)
class LeftOut:
    """Object that is not read: GlobalId, and the reason, which begins with its class."""

    global_id: str
    reason: str


@dataclass(frozen=True)
class Chosen:
    """Object to read, and the tables that match its names; none without a selection."""

    entity: Entity
    tables: tuple[Selection, ...] = ()


def choose_objects(
    model: Model, relations: Relations, select: Sequence[Selection]
) -> tuple[list[Chosen], list[LeftOut]]:
    """Return the objects to read, by instance number, and those with a shape that are left out.

    Without ``select`` all reinforcement is read. Otherwise an object is read if one of the tables matches; tables
    that name no class choose among reinforcement. Raises ``MeshError`` if there is no object to read.
    """
    chosen: list[Chosen] = []
    left_out: list[LeftOut] = []
    for entity in model.by_type("IfcProduct"):
        is_reinforcement = any(map(entity.is_a, CLASSES))
        tables = [table for table in select if is_reinforcement or table.has_class]
        names = _names(relations, entity) if tables else {}
        matching = tuple(table for table in tables if table.matches(names))
        if matching or (is_reinforcement and not select):
            if is_reinforcement or _has_shape(entity):
                chosen.append(Chosen(entity, matching))
        elif _has_shape(entity):
            reason = "no [[select]] table matches" if select else "not reinforcement"
            left_out.append(left_out_object(entity, reason))
    if not chosen:
        raise _nothing_error(left_out, bool(select))
    return chosen, left_out


def left_out_object(entity: Entity, reason: str) -> LeftOut:
    """Return the record of an object that is left out."""
    return LeftOut(shown(entity.GlobalId), f"{entity.is_a()}: {reason}")


def shown(text: object) -> str:
    """Return a text of the file, which may have any length and any characters, for messages and answers."""
    return escape_text(shorten(str(text), MAX_NAME))


def _has_shape(entity: Entity) -> bool:
    try:
        return entity.Representation is not None
    except DAMAGE:
        return False


def _names(relations: Relations, entity: Entity) -> Mapping[str, Sequence[str]]:
    """Return the names of an object by the keys of a selection."""
    return {
        "class": (str(entity.is_a()),),
        "global_id": (str(entity.GlobalId),),
        "name": _texts(entity.Name),
        "host": _texts(*_name_and_id(relations.host(entity))),
        "storey": _texts(*_name_and_id(relations.storey(entity))),
        "layer": relations.layers(entity),
    }


def _name_and_id(entity: Entity | None) -> tuple[object, ...]:
    return () if entity is None else (entity.Name, entity.GlobalId)


def _texts(*values: object) -> tuple[str, ...]:
    return tuple(str(value) for value in values if value)


def _nothing_error(left_out: Sequence[LeftOut], is_selection: bool) -> MeshError:
    """Return the error of a model without an object to read."""
    classes = Counter(record.reason.partition(":")[0] for record in left_out).most_common(_NAMED_CLASSES)
    found = ", ".join(f"{count} {name}" for name, count in classes) or "no other object with a shape"
    if is_selection:
        return MeshError(
            f"no object is selected, expected [[select]] tables that match one or more; it has {found}"
        )
    return MeshError(
        f"contains no reinforcement, expected at least one object of {', '.join(CLASSES)}, or a scene TOML file "
        f"with [[select]] tables that name another class; it has {found}"
    )


_PART_RELATIONS = (
    ("IfcRelAggregates", "RelatingObject", "RelatedObjects"),
    ("IfcRelNests", "RelatingObject", "RelatedObjects"),
)
_CONTAINMENT = ("IfcRelContainedInSpatialStructure", "RelatingStructure", "RelatedElements")
_CONNECTION = ("IfcRelConnectsElements", "RelatingElement", "RelatedElement")
_MAX_DEPTH = 50
"""Largest number of wholes that an object is a part of, one in another; deeper nesting is taken to be a cycle."""


class Relations:
    """Relations of a model's objects; each is compared with the file's text when it is used."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._wholes = _by_part(model, *_PART_RELATIONS)
        self._containers = _by_part(model, _CONTAINMENT)
        self._connections = _by_part(model, _CONNECTION)
        self._layers: dict[int, list[Entity]] = {}
        for layer in model.by_type("IfcPresentationLayerAssignment"):
            for item in layer.AssignedItems or ():
                self._layers.setdefault(item.id(), []).append(layer)

    def host(self, entity: Entity) -> Entity | None:
        """Return the element that an object is a part of, or else is connected with, or None."""
        for relations in (self._wholes, self._connections):
            whole = self._relating(relations, entity)
            if whole is not None and whole.is_a("IfcElement"):
                return whole
        return None

    def storey(self, entity: Entity) -> Entity | None:
        """Return the storey of an object, or None."""
        for _ in range(_MAX_DEPTH):
            if entity is None or entity.is_a("IfcBuildingStorey"):
                return entity
            entity = self._relating(self._containers, entity) or self._relating(self._wholes, entity)
        return None

    def layers(self, entity: Entity) -> tuple[str, ...]:
        """Return the names of the layers of an object's shapes and their items."""
        shape = entity.Representation
        shapes = [] if shape is None else list(shape.Representations or ())
        items = [item for representation in shapes for item in representation.Items or ()]
        maps = [item.MappingSource.MappedRepresentation for item in items if item.is_a("IfcMappedItem")]
        assigned = [layer for item in (*shapes, *items, *maps) for layer in self._layers.get(item.id(), ())]
        return tuple(dict.fromkeys(name for layer in assigned for name in self._names(layer)))

    def _names(self, layer: Entity) -> Iterator[str]:
        self._model.check.attributes(layer, "Name")
        if layer.Name:
            yield str(layer.Name)

    def _relating(self, relations: dict[int, tuple[Entity, str, str]], entity: Entity) -> Entity | None:
        """Return the other end of an object's relation, or None; raise ``MeshError`` unless it is as written."""
        relation, relating, related = relations.get(entity.id(), (None, "", ""))
        if relation is None:
            return None
        self._model.check.attributes(relation, relating, related)
        return getattr(relation, relating)


def _by_part(model: Model, *kinds: tuple[str, str, str]) -> dict[int, tuple[Entity, str, str]]:
    """Return the first relation of each object, with the names of its two ends, by the object's id."""
    relations: dict[int, tuple[Entity, str, str]] = {}
    for kind, relating, related in kinds:
        for relation in model.by_type(kind):
            parts = getattr(relation, related) or ()
            for part in parts if isinstance(parts, tuple) else (parts,):
                relations.setdefault(part.id(), (relation, relating, related))
    return relations


ROLES = {"LIGATURE": "stirrup"}
"""Roles of PredefinedType values whose lower-case name is not used as the role."""

_CLASS_ROLES = {"IfcReinforcingMesh": "mesh", "IfcTendon": "tendon"}
"""Roles of the classes whose objects have one role."""

_DIAMETERS = ("NominalDiameter", "LongitudinalBarNominalDiameter", "TransverseBarNominalDiameter")
_UNSPECIFIED_TYPES = ("USERDEFINED", "NOTDEFINED", None, "")


@dataclass(frozen=True)
class Declared:
    """Declared nominal diameters (two for a mesh, none if unknown), and the bars' length or None, metres."""

    diameters_m: tuple[float, ...]
    length_m: float | None


def declared_sizes(model: Model, entity: Entity, types: Sequence[Entity], unit_m: float) -> Declared:
    """Return what an object declares, or what its types declare where it does not.

    Raises ``MeshError`` if one of the attributes was not read as written.
    """
    sources = [entity, *types]
    for source in sources:
        model.check.attributes(source, *_DIAMETERS, "BarLength")
    diameters = next(filter(None, (_positive(source, _DIAMETERS, unit_m) for source in sources)), ())
    lengths = next(filter(None, (_positive(source, ("BarLength",), unit_m) for source in sources)), ())
    return Declared(diameters, lengths[0] if lengths else None)


def _positive(source: Entity, names: Sequence[str], unit_m: float) -> tuple[float, ...]:
    """Return the attributes of these names that are finite numbers above 0, in metres."""
    values = (getattr(source, name, None) for name in names)
    return tuple(
        float(value) * unit_m for value in values if isinstance(value, int | float) and 0 < value < math.inf
    )


def role(entity: Entity, types: Sequence[Entity]) -> str:
    """Return the role of an object's bars.

    It is "mesh" or "tendon" by class, else the PredefinedType (BarRole in IFC2x3) of the object or of its type,
    else its ObjectType or Name, else "bar".
    """
    for class_name, class_role in _CLASS_ROLES.items():
        if entity.is_a(class_name):
            return class_role
    kind = next(filter(None, map(_own_kind, [entity, *types])), None)
    if kind:
        return ROLES.get(kind, kind.lower())
    description = " ".join(str(entity.ObjectType or entity.Name or "").split())
    return description[:60].strip() or "bar"


def _own_kind(source: Entity) -> str | None:
    """Return the PredefinedType (BarRole in IFC2x3) of an object or a type, or None if it has none."""
    kind = getattr(source, "PredefinedType", None) or getattr(source, "BarRole", None)
    return None if kind in _UNSPECIFIED_TYPES else str(kind)
