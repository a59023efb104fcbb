"""IFC models: opening with a completeness check, units, tessellation. The only module that imports ifcopenshell.

The parser silently skips what it cannot read, which could place a bar wrongly without an error. A file is
therefore accepted only if every instance that its text defines is in the model and every reference leads to a
defined instance.
"""

from __future__ import annotations

import importlib
import re
from collections import Counter
from textwrap import shorten
from typing import Any

from rebar_depth_bench.errors import InputError, MeshError

Entity = Any
"""An ``ifcopenshell.entity_instance``, with the attributes of its IFC class."""

Model = Any
"""An ``ifcopenshell.file``."""

_STRING_OR_COMMENT = re.compile(r"'(?:[^']|'')*'|/\*.*?\*/", flags=re.DOTALL)
_INSTANCE = re.compile(r"#(\d+)\s*=")
_REFERENCE = re.compile(r"#(\d+)(?!\d|\s*=)")
_PREFIXES = {"MILLI": 1e-3, "CENTI": 1e-2, "DECI": 1e-1, None: 1.0, "DECA": 1e1, "HECTO": 1e2, "KILO": 1e3}


def open_model(content: bytes, where: str) -> Model:
    """Return the model of a STEP file's ``content``; ``where`` names the file in error messages.

    Raises ``InputError`` if ifcopenshell is not installed, and ``MeshError`` if the file is not a complete IFC
    file: truncated, of an unknown schema, with unreadable instances or dangling references.
    """
    text = content.decode("utf-8", errors="replace")
    defined_ids = _check_text(text, where)
    try:
        model = import_ifcopenshell().file.from_string(text)
        schema = model.schema
        read_ids = {entity.id() for entity in model}
    except InputError:
        raise
    except Exception as error:
        reason = shorten(str(error), 200) or type(error).__name__
        raise MeshError(f"{where}: not a readable IFC file ({reason})") from error
    unread = sorted(defined_ids - read_ids)
    if unread:
        raise MeshError(
            f"{where}: {len(unread)} of its instances cannot be read, first #{unread[0]}, expected a complete "
            f"{schema} file"
        )
    return model


def import_ifcopenshell() -> Any:
    """Return the package ``ifcopenshell``; raise ``InputError`` with the install command if it is missing."""
    try:
        return importlib.import_module("ifcopenshell")
    except ImportError as error:
        raise InputError(
            "not installed: ifcopenshell; expected the ifc extra for IFC models: "
            "pip install 'rebar-depth-bench[ifc]'"
        ) from error


def world_mesh(model: Model, number: int) -> tuple[Any, Any]:
    """Return vertices (flat, world, metres) and triangles (flat) of the instance ``number``.

    Raises ``RuntimeError`` if the geometry kernel cannot tessellate it. The kernel may also hang or
    crash, so call this in a separate process.
    """
    geom = importlib.import_module("ifcopenshell.geom")
    settings = geom.settings()
    settings.set("use-world-coords", True)
    settings.set("mesher-linear-deflection", 1e-5)
    settings.set("mesher-angular-deflection", 0.15)
    geometry = geom.create_shape(settings, model.by_id(number)).geometry
    return geometry.verts, geometry.faces


def length_unit_m(model: Model, where: str) -> float:
    """Return the project's length unit in metres; raise ``MeshError`` if the file does not define a known one."""
    metres = _project_unit(model, "LENGTHUNIT", "METRE")
    if metres is None:
        raise MeshError(f"{where}: the project has no known length unit, expected for example metres or feet")
    return metres


def angle_unit_rad(model: Model) -> float:
    """Return the project's plane angle unit in radians, 1.0 if the file does not define a known one."""
    return _project_unit(model, "PLANEANGLEUNIT", "RADIAN") or 1.0


def _project_unit(model: Model, kind: str, base: str) -> float | None:
    """Return the project unit of a kind, expressed in the SI unit ``base``, or None."""
    for project in model.by_type("IfcProject"):
        for unit in getattr(project.UnitsInContext, "Units", None) or ():
            if getattr(unit, "UnitType", None) == kind:
                return _to_base_unit(unit, base)
    return None


def _to_base_unit(unit: Entity, base: str) -> float | None:
    """Return the factor from an IFC unit to the SI unit ``base``, or None if it is not such a unit."""
    factor = 1.0
    if unit.is_a("IfcConversionBasedUnit"):  # For example, a foot defined as a number of metres.
        factor = float(unit.ConversionFactor.ValueComponent.wrappedValue)
        unit = unit.ConversionFactor.UnitComponent
    if not unit.is_a("IfcSIUnit") or unit.Name != base or unit.Prefix not in _PREFIXES or not factor > 0:
        return None
    return factor * _PREFIXES[unit.Prefix]


def _check_text(text: str, where: str) -> set[int]:
    """Return the instance numbers that a STEP text defines.

    Raises ``MeshError`` unless it begins and ends as STEP and each reference has exactly one instance.
    """
    if not text.lstrip("\ufeff \t\r\n").startswith("ISO-10303-21"):
        raise MeshError(f"{where}: does not begin with ISO-10303-21, expected an IFC file in STEP format")
    if not re.search(r"END-ISO-10303-21\s*;\s*\Z", text):
        raise MeshError(
            f"{where}: does not end with END-ISO-10303-21, expected a complete IFC file: is it truncated?"
        )
    bare = _STRING_OR_COMMENT.sub("''", text)
    instances = [int(number) for number in _INSTANCE.findall(bare)]
    defined = set(instances)
    if len(defined) < len(instances):
        duplicate = next(number for number, times in Counter(instances).items() if times > 1)
        raise MeshError(f"{where}: instance #{duplicate} is defined twice, expected once")
    undefined = sorted({int(number) for number in _REFERENCE.findall(bare)} - defined)
    if undefined:
        raise MeshError(
            f"{where}: {len(undefined)} referenced instances are not defined, first #{undefined[0]}, "
            "expected a complete file"
        )
    return defined
