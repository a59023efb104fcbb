"""Bodies of IFC objects: the items of an object's or its type's Body, with nested maps resolved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.ifc_reader.model import Model
from dataset_builder.scene.ifc_reader.placements import axis_placement, mapped_matrix
from dataset_builder.scene.ifc_reader.source_check import Entity

_MAX_BODY_ITEMS = 10_000
"""Largest number of items in one object's Body, with the items of nested maps counted at each use.

A short file with nested maps can expand to billions of items.
"""


@dataclass(frozen=True, eq=False)
class BodyItem:
    """Item of a body, its ``object_from_item`` and the factor by which that scales lengths."""

    item: Entity
    object_from_item: Float64[ndarray, "4 4"]
    scale: float


def type_objects(model: Model, entity: Entity) -> list[Entity]:
    """Return the IfcTypeObjects that define an object; raise ``MeshError`` if one was not read as written."""
    relations = [*(getattr(entity, "IsTypedBy", None) or ()), *(getattr(entity, "IsDefinedBy", None) or ())]
    types = [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]
    for type_object in types:
        model.check.attributes(type_object, "PredefinedType", "BarRole", "RepresentationMaps")
    return types


def body_items(model: Model, entity: Entity, types: list[Entity]) -> list[BodyItem]:
    """Return the items of an object's Body, or of the Body of its type if it has none, in order.

    Raises ``MeshError`` if an instance below the Body was not read as written, and ``ValueError`` if there is no
    Body, if a map is not one of a uniform scale, or if there are more than ``_MAX_BODY_ITEMS`` items.
    """
    pending = [BodyItem(item, np.eye(4), 1.0) for body in _own_bodies(model, entity) for item in body.Items]
    if not pending:
        pending = [item for type_object in types for item in _type_items(model, type_object)]
    if not pending:
        raise ValueError("the body is empty")
    return _resolved(pending)


def _own_bodies(model: Model, entity: Entity) -> list[Entity]:
    if entity.Representation is None:
        return []
    model.check.attributes(entity.Representation, "Representations")
    return _checked_bodies(model, list(entity.Representation.Representations))


def _type_items(model: Model, type_object: Entity) -> list[BodyItem]:
    maps = list(getattr(type_object, "RepresentationMaps", None) or ())
    for source in maps:
        model.check.attributes(source)
        model.check.tree(source.MappingOrigin)
    bodies = {body.id() for body in _checked_bodies(model, [source.MappedRepresentation for source in maps])}
    return [
        BodyItem(item, axis_placement(source.MappingOrigin), 1.0)
        for source in maps
        if source.MappedRepresentation.id() in bodies
        for item in source.MappedRepresentation.Items
    ]


def _checked_bodies(model: Model, representations: list[Entity]) -> list[Entity]:
    """Return the representations named Body, or all of them if there is none, with everything below checked."""
    for representation in representations:
        model.check.attributes(representation, "RepresentationIdentifier")
    named = [
        representation for representation in representations if representation.RepresentationIdentifier == "Body"
    ]
    for body in named or representations:
        model.check.tree(body)
    return named or representations


def _resolved(items: list[BodyItem]) -> list[BodyItem]:
    """Return the items with each IfcMappedItem replaced by the items of its map."""
    maps: dict[int, tuple[Float64[ndarray, "4 4"], float, list[Entity]]] = {}
    pending = items[::-1]
    resolved: list[BodyItem] = []
    for _ in range(_MAX_BODY_ITEMS):
        if not pending:
            return resolved
        outer = pending.pop()
        item = outer.item
        if not item.is_a("IfcMappedItem"):
            resolved.append(outer)
            continue
        if item.id() not in maps:
            inside = item.MappingSource.MappedRepresentation.Items
            maps[item.id()] = (*mapped_matrix(item), list(reversed(inside)))
        mapped, factor, inner = maps[item.id()]
        matrix, scale = outer.object_from_item @ mapped, outer.scale * factor
        pending += [BodyItem(inner_item, matrix, scale) for inner_item in inner]
    raise ValueError(f"the body has more than {_MAX_BODY_ITEMS} items, or circular maps")
