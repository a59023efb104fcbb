"""Attributes that an IFC object or its type declares about its bars: role, diameters and length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dataset_builder.scene.ifc_reader.model import Model
from dataset_builder.scene.ifc_reader.source_check import Entity

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
