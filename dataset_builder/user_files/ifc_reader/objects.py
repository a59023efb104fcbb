"""Project and objects of an IFC model: units, which objects are read, and what they and their types declare.

The host of reinforcement is the element that it is a part of, or is connected with. The storey is the one that
contains the object, or the nearest of those that it is a part of. A layer is assigned to a shape, or to an item of
it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import shorten

from ifcopenshell.util.unit import get_prefix_multiplier

from dataset_builder.specs.file_specs import KEYS, Selection, nearest_names
from dataset_builder.user_files.ifc_reader.ifc_model import Entity, Model
from dataset_builder.user_files.ifc_records import LeftOutRecord, Source
from rebar_depth_bench.base.errors import MeshError, escape_text

CLASSES = ("IfcReinforcingBar", "IfcReinforcingMesh", "IfcTendon")
"""Classes of reinforcement, which is read without a selection."""

DAMAGE = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Exceptions of instances that are incomplete or not supported."""

DIAMETERS = ("NominalDiameter", "LongitudinalBarNominalDiameter", "TransverseBarNominalDiameter")
_UNSPECIFIED_TYPES = ("USERDEFINED", "NOTDEFINED", None, "")
_MAX_NAME = 60
_NAMED_CLASSES = 5

_PART = {"Decomposes": "RelatingObject", "Nests": "RelatingObject"}
_CONTENT = {"ContainedInStructure": "RelatingStructure"}
_CONNECTED = {"ConnectedFrom": "RelatingElement"}
"""Inverse attributes of an object, each with the name of the other end of the relations that it holds."""

_MAX_DEPTH = 50
"""Largest number of wholes that an object is a part of, one in another; deeper nesting is taken to be a cycle."""

_MAX_UNIT_DEPTH = 10
"""Largest number of units that are each defined by the next, such as an inch by a foot by a metre."""


@dataclass(frozen=True)
class Units:
    """Units of a project: length in metres, plane angle in radians."""

    length_m: float
    angle_rad: float


def project_units(model: Model) -> Units:
    """Return the units of the project; an unknown unit of plane angles is taken to be the radian.

    Raises ``MeshError`` if the file does not define a known length unit.
    """
    length_m = _project_unit(model, "LENGTHUNIT", "METRE")
    if length_m is None:
        raise MeshError("the project has no known length unit, expected for example metres or feet")
    return Units(length_m, _project_unit(model, "PLANEANGLEUNIT", "RADIAN") or 1.0)


def _project_unit(model: Model, kind: str, base: str) -> float | None:
    """Return the project unit of a kind, expressed in the SI unit ``base``, or None."""
    for project in model.by_type("IfcProject"):
        for unit in project.UnitsInContext.Units if project.UnitsInContext else ():
            if getattr(unit, "UnitType", None) == kind:
                model.check_tree(unit)
                return _in_base_unit(unit, base)
    return None


def _in_base_unit(unit: Entity, base: str) -> float | None:
    """Return the factor from an IFC unit to the SI unit ``base``, or None if it is not such a unit."""
    factor = 1.0
    for _ in range(_MAX_UNIT_DEPTH):
        if not unit.is_a("IfcConversionBasedUnit"):  # For example, a foot defined as a number of metres.
            break
        factor *= float(unit.ConversionFactor.ValueComponent.wrappedValue)
        unit = unit.ConversionFactor.UnitComponent
    if not unit.is_a("IfcSIUnit") or unit.Name != base:
        return None
    factor *= float(get_prefix_multiplier(unit.Prefix))
    return factor if 0 < factor < math.inf else None


def choose_objects(
    model: Model, select: Sequence[Selection]
) -> tuple[list[tuple[Entity, Sequence[Selection]]], list[LeftOutRecord]]:
    """Return the objects to read, by instance number, and those with a shape that are left out.

    Without ``select`` all reinforcement is read. Otherwise an object is read if one of the tables matches its
    names; tables that name no class choose among reinforcement. The matching tables are returned with each object.
    Raises ``MeshError`` if there is no object to read.
    """
    chosen: list[tuple[Entity, Sequence[Selection]]] = []
    left_out: list[LeftOutRecord] = []
    known: dict[str, set[str]] = {key: set() for key in KEYS}
    for entity in model.by_type("IfcProduct"):
        is_reinforcement = any(map(entity.is_a, CLASSES))
        tables = [table for table in select if is_reinforcement or table.has_class]
        names = _names(entity) if tables else {}
        for key, values in names.items():
            known[key].update(values)
        matching = [table for table in tables if table.matches(names)]
        if matching or (is_reinforcement and not select):
            if is_reinforcement or _has_shape(entity):
                chosen.append((entity, matching))
        elif _has_shape(entity):
            reason = "no [[select]] table matches" if select else "not reinforcement"
            left_out.append(left_out_record(entity, reason))
    if not chosen:
        raise _nothing_error(left_out, bool(select), nearest_names(select, known))
    return chosen, left_out


def left_out_record(entity: Entity, reason: str) -> LeftOutRecord:
    """Return the record of an object that is left out."""
    return LeftOutRecord(global_id=_shown(entity.GlobalId), reason=f"{entity.is_a()}: {reason}")


def _shown(text: object) -> str:
    """Return a text of the file, which may have any length and any characters, for messages and answers."""
    return escape_text(shorten(str(text), _MAX_NAME))


def _has_shape(entity: Entity) -> bool:
    try:
        return entity.Representation is not None
    except DAMAGE:
        return False


def _names(entity: Entity) -> Mapping[str, Sequence[str]]:
    """Return the names of an object by the keys of a selection."""
    return {
        "class": (str(entity.is_a()),),
        "global_id": (str(entity.GlobalId),),
        "name": _texts(entity, "Name"),
        "host": _texts(_host(entity), "Name", "GlobalId"),
        "storey": _texts(_storey(entity), "Name", "GlobalId"),
        "layer": _layers(entity),
    }


def _texts(entity: Entity | None, *names: str) -> list[str]:
    """Return the attributes of these names that an object has, none for None."""
    values = [] if entity is None else [getattr(entity, name) for name in names]
    return [str(value) for value in values if value]


def _host(entity: Entity) -> Entity | None:
    """Return the element that an object is a part of, or else is connected with, or None."""
    for kinds in (_PART, _CONNECTED):
        whole = _relating(entity, kinds)
        if whole is not None and whole.is_a("IfcElement"):
            return whole
    return None


def _storey(entity: Entity) -> Entity | None:
    """Return the storey of an object, or None."""
    for _ in range(_MAX_DEPTH):
        if entity is None or entity.is_a("IfcBuildingStorey"):
            return entity
        entity = _relating(entity, _CONTENT) or _relating(entity, _PART)
    return None


def _relating(entity: Entity, kinds: Mapping[str, str]) -> Entity | None:
    """Return the other end of an object's first relation of some kinds, or None."""
    for inverse, relating in kinds.items():
        if relations := getattr(entity, inverse, None):
            return getattr(min(relations, key=lambda relation: int(relation.id())), relating)
    return None


def _layers(entity: Entity) -> list[str]:
    """Return the names of the layers of an object's shapes and their items."""
    shape = entity.Representation
    shapes = [] if shape is None else list(shape.Representations or ())
    items = [item for representation in shapes for item in representation.Items or ()]
    maps = [item.MappingSource.MappedRepresentation for item in items if item.is_a("IfcMappedItem")]
    names: list[str] = []
    for item in (*shapes, *items, *maps):
        # The name of the inverse attribute depends on the version of IFC.
        for layer in getattr(item, "LayerAssignments", None) or getattr(item, "LayerAssignment", None) or ():
            names += _texts(layer, "Name")
    return names


def _nothing_error(left_out: Sequence[LeftOutRecord], is_selection: bool, nearest: str) -> MeshError:
    """Return the error of a model without an object to read; ``nearest`` are the ``nearest_names``."""
    classes = Counter(record.reason.partition(":")[0] for record in left_out).most_common(_NAMED_CLASSES)
    found = ", ".join(f"{count} {name}" for name, count in classes) or "no other object with a shape"
    if is_selection:
        return MeshError(
            f"no object is selected, expected [[select]] tables that match one or more; it has {found}{nearest}"
        )
    return MeshError(
        f"contains no reinforcement, expected at least one object of {', '.join(CLASSES)}, or a scene TOML file "
        f"with [[select]] tables that name another class; it has {found}"
    )


def object_label(entity: Entity) -> str:
    """Return the object's name in error messages: class, GlobalId and instance number."""
    return f"{entity.is_a()} {_shown(entity.GlobalId)} (#{entity.id()})"


def type_objects(entity: Entity) -> list[Entity]:
    """Return the IfcTypeObjects that define an object."""
    relations = [*(getattr(entity, "IsTypedBy", None) or ()), *(getattr(entity, "IsDefinedBy", None) or ())]
    return [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]


def source_record(entity: Entity, types: Sequence[Entity], unit_m: float) -> Source:
    """Return the record of an object: its names, and the sizes of bars that it, or else its types, declare."""
    sources = [entity, *types]
    return Source(
        global_id=_shown(entity.GlobalId),
        label=object_label(entity),
        host=_name(_host(entity)),
        storey=_name(_storey(entity)),
        diameters_m=next(filter(None, (_positive(source, DIAMETERS, unit_m) for source in sources)), []),
        length_m=next((size for source in sources for size in _positive(source, ["BarLength"], unit_m)), None),
    )


def _name(entity: Entity | None) -> str | None:
    """Return the name of a host or storey, or its GlobalId if it has no name."""
    return None if entity is None else _shown(entity.Name or entity.GlobalId)


def _positive(source: Entity, names: Sequence[str], unit_m: float) -> list[float]:
    """Return the attributes of these names that are finite numbers above 0, in metres."""
    values = (getattr(source, name, None) for name in names)
    return [float(value) * unit_m for value in values if isinstance(value, int | float) and 0 < value < math.inf]


def role(entity: Entity, types: Sequence[Entity]) -> str:
    """Return the role of an object's bars.

    It is "mesh" or "tendon" by class, else the PredefinedType (BarRole in IFC2x3) of the object or of its type,
    else its ObjectType or Name, else "bar".
    """
    if entity.is_a("IfcReinforcingMesh"):
        return "mesh"
    if entity.is_a("IfcTendon"):
        return "tendon"
    kind = next(filter(None, map(_own_kind, [entity, *types])), None)
    if kind:
        return "stirrup" if kind == "LIGATURE" else kind.lower()
    description = " ".join(str(entity.ObjectType or entity.Name or "").split())
    return description[:_MAX_NAME].strip() or "bar"


def _own_kind(source: Entity) -> str | None:
    """Return the PredefinedType (BarRole in IFC2x3) of an object or a type, or None if it has none."""
    kind = getattr(source, "PredefinedType", None) or getattr(source, "BarRole", None)
    return None if kind in _UNSPECIFIED_TYPES else str(kind)
