"""IFC models: opening with checks of completeness, units, tessellation.

The parser skips what it cannot read and goes on, which could place a bar wrongly without an error. The instances
that the bars depend on are therefore compared with the file's text (``source_check``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from textwrap import shorten
from typing import Any

import ifcopenshell
import numpy as np
from ifcopenshell import geom
from ifcopenshell import ifcopenshell_wrapper as wrapper

from dataset_builder.scene.ifc_reader.source_check import Entity, SourceCheck
from dataset_builder.scene.ifc_reader.step_text import StepText, class_name
from rebar_depth_bench.errors import MeshError, escape_text

_LOGGED_REASON = re.compile(r"\] (?!Pars)[A-Za-z]")
"""Message in the parser's log that gives a reason, after severity and time; out of memory, it may be cut off."""
_PREFIXES: dict[str | None, float] = {
    None: 1.0,
    **dict(
        zip(
            ("DECI", "CENTI", "MILLI", "MICRO", "NANO", "PICO"), (1e-1, 1e-2, 1e-3, 1e-6, 1e-9, 1e-12), strict=True
        )
    ),
    **dict(zip(("DECA", "HECTO", "KILO", "MEGA", "GIGA"), (1e1, 1e2, 1e3, 1e6, 1e9), strict=True)),
}
_MAX_UNIT_DEPTH = 10
"""Largest number of units that are each defined by the next, such as an inch by a foot by a metre."""


@dataclass(frozen=True)
class Model:
    """IFC model: ifcopenshell's model, and the check of its instances against the file's text."""

    file: Any
    check: SourceCheck

    def by_type(self, name: str) -> list[Entity]:
        """Return the instances of a class and its subclasses, by number."""
        return sorted(self.file.by_type(name), key=lambda entity: int(entity.id()))


def open_model(content: bytes) -> Model:
    """Return the model of a STEP file's ``content``.

    Raises ``MeshError`` if the file is not a complete IFC file: truncated, of an unknown schema, with text that
    is not an instance, or with instances that the parser cannot read; ``MemoryError`` at the limit of memory.
    """
    text = content.decode("utf-8", errors="replace")
    step = StepText(text)
    try:
        file = ifcopenshell.file.from_string(text)
        schema = str(file.schema_identifier)
        read = np.array(sorted(file.entity_names()), np.int64)
    except MemoryError:
        raise
    except Exception as error:
        reason = shorten(str(error), 200) or type(error).__name__
        raise MeshError(f"not a readable IFC file ({reason})") from error
    unread = np.setdiff1d(step.numbers, read).tolist()
    if unread and not _LOGGED_REASON.search(ifcopenshell.get_log()):
        raise MemoryError  # The parser swallows a failed allocation; it logs any other reason.
    known = wrapper.schema_by_name(schema)
    _check_unread(step, unread, known)
    return Model(file, SourceCheck(known, step))


def _check_unread(step: StepText, unread: list[int], schema: Any) -> None:
    """Raise ``MeshError`` if the parser left out an instance that may be a bar.

    Some programs write classes of another version of IFC, which are left out. A name that no version has may be
    a damaged one.
    """
    others = [wrapper.schema_by_name(name) for name in wrapper.schema_names() if name.startswith("IFC")]
    for number in unread:
        name = class_name(step.instance(number))
        if _has_class(schema, name) or not any(_has_class(other, name) for other in others):
            raise MeshError(
                f"{len(unread)} of its instances cannot be read, first #{number} ({escape_text(name)}), expected "
                f"a complete {schema.name()} file"
            )


def _has_class(schema: Any, name: str) -> bool:
    try:
        schema.declaration_by_name(name)
    except RuntimeError:
        return False
    return True


def item_mesh(model: Model, number: int) -> tuple[Any, Any]:
    """Return vertices (flat, metres, frame of the item) and triangles (flat) of the solid ``number``.

    Raises ``RuntimeError`` if the geometry kernel cannot tessellate it. The kernel may also hang or crash.
    """
    settings = geom.settings()
    settings.set("mesher-linear-deflection", 1e-5)
    settings.set("mesher-angular-deflection", 0.15)
    mesh = geom.create_shape(settings, model.file.by_id(number))
    return mesh.verts, mesh.faces


def length_unit_m(model: Model) -> float:
    """Return the project's length unit in metres; raise ``MeshError`` if the file does not define a known one."""
    metres = _project_unit(model, "LENGTHUNIT", "METRE")
    if metres is None:
        raise MeshError("the project has no known length unit, expected for example metres or feet")
    return metres


def angle_unit_rad(model: Model) -> float:
    """Return the project's plane angle unit in radians, 1.0 if the file does not define a known one."""
    return _project_unit(model, "PLANEANGLEUNIT", "RADIAN") or 1.0


def _project_unit(model: Model, kind: str, base: str) -> float | None:
    """Return the project unit of a kind, expressed in the SI unit ``base``, or None."""
    for project in model.by_type("IfcProject"):
        model.check.attributes(project, "UnitsInContext")
        if project.UnitsInContext is None:
            continue
        model.check.attributes(project.UnitsInContext)
        for unit in project.UnitsInContext.Units:
            if unit.is_a("IfcNamedUnit"):
                model.check.attributes(unit, "UnitType")
                if unit.UnitType == kind:
                    model.check.tree(unit)
                    return _to_base_unit(unit, base)
    return None


def _to_base_unit(unit: Entity, base: str) -> float | None:
    """Return the factor from an IFC unit to the SI unit ``base``, or None if it is not such a unit."""
    factor = 1.0
    for _ in range(_MAX_UNIT_DEPTH):
        if not unit.is_a("IfcConversionBasedUnit"):  # For example, a foot defined as a number of metres.
            break
        factor *= float(unit.ConversionFactor.ValueComponent.wrappedValue)
        unit = unit.ConversionFactor.UnitComponent
    if not unit.is_a("IfcSIUnit") or unit.Name != base or unit.Prefix not in _PREFIXES or not factor > 0:
        return None
    return float(factor * _PREFIXES[unit.Prefix])
