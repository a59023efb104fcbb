"""Choice of the objects of an IFC model that are read, by class or by selection, and those that are left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten

from dataset_builder.scene.ifc_reader.model import Model
from dataset_builder.scene.ifc_reader.relations import Relations
from dataset_builder.scene.ifc_reader.source_check import Entity
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
