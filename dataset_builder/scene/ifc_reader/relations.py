"""Names of IFC objects that come from relations: the host of reinforcement, its storey and its layers.

The host is the element that an object is a part of, or is connected with. The storey is the one that contains the
object, or the nearest of those that it is a part of. A layer is assigned to a shape, or to an item of it.
"""

from __future__ import annotations

from collections.abc import Iterator

from dataset_builder.scene.ifc_reader.model import Model
from dataset_builder.scene.ifc_reader.source_check import Entity

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
