"""An IFC file as a model: opened whole or refused, with its units. The only module that imports ifcopenshell.

The parser leaves out what it cannot read and goes on; a bar would then stand in the wrong place without a word.
So a file counts as whole only where every instance that its text defines is in the model and every reference leads
to one.
"""

from __future__ import annotations

import importlib
import re
from collections import Counter
from textwrap import shorten
from typing import Any

from rebar_depth_bench.errors import InputError, MeshError

Entity = Any
"""An ``ifcopenshell.entity_instance``: its attributes are those of its IFC class."""

Model = Any
"""An ``ifcopenshell.file``."""

_STRING_OR_COMMENT = re.compile(r"'(?:[^']|'')*'|/\*.*?\*/", flags=re.DOTALL)
_INSTANCE = re.compile(r"#(\d+)\s*=")
_REFERENCE = re.compile(r"#(\d+)(?!\d|\s*=)")
_PREFIXES = {"MILLI": 1e-3, "CENTI": 1e-2, "DECI": 1e-1, None: 1.0, "DECA": 1e1, "HECTO": 1e2, "KILO": 1e3}


def open_model(content: bytes, where: str) -> Model:
    """Return the model of a STEP file's ``content``.

    Raises ``InputError`` where ifcopenshell is not installed, ``MeshError`` where the file is not a whole IFC
    file: truncated, of no schema that is known, with unreadable instances or references that lead nowhere.
    """
    text = content.decode("utf-8", errors="replace")
    _check_text(text, where)
    try:
        model = ifcopenshell().file.from_string(text)
        schema = model.schema
        found = {entity.id() for entity in model}
    except InputError:
        raise
    except Exception as error:
        reason = shorten(str(error), 200) or type(error).__name__
        raise MeshError(f"{where}: not an IFC file that can be read ({reason})") from error
    lost = sorted(set(_instances(text)) - found)
    if lost:
        raise MeshError(
            f"{where}: {len(lost)} of its instances cannot be read, first #{lost[0]}, expected a whole "
            f"{schema} file"
        )
    return model


def ifcopenshell() -> Any:
    """Return the package; raise ``InputError`` that says how to install it where it is missing."""
    try:
        return importlib.import_module("ifcopenshell")
    except ImportError as error:
        raise InputError(
            "not installed: ifcopenshell; expected the ifc extra for IFC models: "
            "pip install 'rebar-depth-bench[ifc]'"
        ) from error


def world_meshes(model: Model, ids: list[int]) -> Any:
    """Yield vertices (flat, world, metres) and triangles (flat) of each instance that ``ids`` names.

    Raises ``RuntimeError`` where the geometry kernel can make nothing of one. It may also run for ever or crash:
    call it in a process of its own.
    """
    geom = importlib.import_module("ifcopenshell.geom")
    settings = geom.settings()
    settings.set("use-world-coords", True)
    settings.set("mesher-linear-deflection", 1e-5)
    settings.set("mesher-angular-deflection", 0.15)
    for number in ids:
        shape = geom.create_shape(settings, model.by_id(number))
        yield shape.geometry.verts, shape.geometry.faces


def length_unit_m(model: Model, where: str) -> float:
    """Return one of the project's length units in metres; raise ``MeshError`` where the file does not tell."""
    metres = _unit(model, "LENGTHUNIT", "METRE")
    if metres is None:
        raise MeshError(
            f"{where}: the project has no length unit that is known, expected metres, feet or the like"
        )
    return metres


def angle_unit_rad(model: Model) -> float:
    """Return one of the project's plane angle units in radians; the radian where the file does not tell."""
    return _unit(model, "PLANEANGLEUNIT", "RADIAN") or 1.0


def _unit(model: Model, kind: str, base: str) -> float | None:
    """Return one project unit of a kind in its SI base unit, or None."""
    for project in model.by_type("IfcProject"):
        for unit in getattr(project.UnitsInContext, "Units", None) or ():
            if getattr(unit, "UnitType", None) == kind:
                return _in_base(unit, base)
    return None


def _in_base(unit: Entity, base: str) -> float | None:
    factor = 1.0
    if unit.is_a("IfcConversionBasedUnit"):  # 1 ft is a number of some SI unit
        factor = float(unit.ConversionFactor.ValueComponent.wrappedValue)
        unit = unit.ConversionFactor.UnitComponent
    if not unit.is_a("IfcSIUnit") or unit.Name != base or unit.Prefix not in _PREFIXES or not factor > 0:
        return None
    return factor * _PREFIXES[unit.Prefix]


def _instances(text: str) -> list[int]:
    return [int(number) for number in _INSTANCE.findall(_STRING_OR_COMMENT.sub("''", text))]


def _check_text(text: str, where: str) -> None:
    """Raise ``MeshError`` unless the text begins and ends as STEP and every reference leads to one instance."""
    if not text.lstrip("\ufeff \t\r\n").startswith("ISO-10303-21"):
        raise MeshError(f"{where}: does not begin with ISO-10303-21, expected an IFC file in STEP format")
    if not re.search(r"END-ISO-10303-21\s*;\s*\Z", text):
        raise MeshError(
            f"{where}: does not end with END-ISO-10303-21, expected a whole IFC file: is it truncated?"
        )
    bare = _STRING_OR_COMMENT.sub("''", text)
    instances = [int(number) for number in _INSTANCE.findall(bare)]
    defined = set(instances)
    if len(defined) < len(instances):
        twice = next(number for number, times in Counter(instances).items() if times > 1)
        raise MeshError(f"{where}: instance #{twice} is defined twice, expected each once")
    lost = sorted({int(number) for number in _REFERENCE.findall(bare)} - defined)
    if lost:
        raise MeshError(
            f"{where}: {len(lost)} instances are referred to and not there, first #{lost[0]}, expected a whole "
            "file"
        )
