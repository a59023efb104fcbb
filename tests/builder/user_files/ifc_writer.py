"""Writer of small IFC models for tests."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import Any

import ifcopenshell
import numpy as np
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.user_files.cage_file import raise_problems
from dataset_builder.user_files.ifc_file import Answer
from dataset_builder.user_files.ifc_reader.__main__ import write_answer

Numbers = Sequence[float]


def bars_in_process(content: bytes) -> list[CageBar]:
    """Return the bars of an IFC file, read without the process that ``ifc_cage`` starts."""
    stream = io.BytesIO()
    write_answer(content, stream)
    stream.seek(0)
    return checked_bars(Answer(stream, "a.ifc"))


def checked_bars(answer: Answer) -> list[CageBar]:
    """Return the bars of an answer; raise ``MeshError`` for the problems of its cage."""
    cage = answer.cage()
    raise_problems(cage.problems, "a.ifc")
    return list(cage.bars)


class Ifc:
    """IFC model under construction; lengths are in the unit of the model."""

    def __init__(self, schema: str = "IFC4", prefix: str | None = "MILLI", unit: Any = None) -> None:
        self.file = ifcopenshell.file(schema=schema)
        self.new = self.file.create_entity
        self.context = self.new("IfcGeometricRepresentationContext", None, "Model", 3, 1e-6, self.axes((0, 0, 0)))
        metre = self.new("IfcSIUnit", UnitType="LENGTHUNIT", Prefix=prefix, Name="METRE")
        radian = self.new("IfcSIUnit", UnitType="PLANEANGLEUNIT", Name="RADIAN")
        length = self.conversion("LENGTHUNIT", "FOOT", "IfcLengthMeasure", unit, metre) if unit else metre
        degree = self.conversion("PLANEANGLEUNIT", "DEGREE", "IfcPlaneAngleMeasure", math.pi / 180, radian)
        units = self.new("IfcUnitAssignment", [length, degree])
        self.rooted("IfcProject", RepresentationContexts=[self.context], UnitsInContext=units)

    def rooted(self, kind: str, **attributes: Any) -> Any:
        return self.new(kind, GlobalId=ifcopenshell.guid.new(), **attributes)

    def conversion(self, kind: str, name: str, measure: str, factor: float, base: Any) -> Any:
        dimensions = self.new("IfcDimensionalExponents", 0, 0, 0, 0, 0, 0, 0)
        with_unit = self.new("IfcMeasureWithUnit", self.new(measure, factor), base)
        return self.new("IfcConversionBasedUnit", dimensions, kind, name, with_unit)

    def point(self, coordinates: Numbers) -> Any:
        return self.new("IfcCartesianPoint", tuple(map(float, coordinates)))

    def direction(self, ratios: Numbers | None) -> Any:
        return None if ratios is None else self.new("IfcDirection", tuple(map(float, ratios)))

    def axes(self, origin: Numbers, z: Numbers | None = None, x: Numbers | None = None) -> Any:
        return self.new("IfcAxis2Placement3D", self.point(origin), self.direction(z), self.direction(x))

    def at(self, *axes: Any, parent: Any = None) -> Any:
        return self.new("IfcLocalPlacement", parent, self.axes(*axes))

    def polyline(self, *points: Numbers) -> Any:
        return self.new("IfcPolyline", [self.point(point) for point in points])

    def disc(self, curve: Any, radius: float = 8.0) -> Any:
        return self.new("IfcSweptDiskSolid", curve, radius)

    def parameter(self, value: float) -> Any:
        return self.new("IfcParameterValue", value)

    def shape(self, *items: Any, kind: str = "AdvancedSweptSolid") -> Any:
        return self.new("IfcShapeRepresentation", self.context, "Body", kind, list(items))

    def mapped(self, target: Any, origin: Any, *items: Any) -> Any:
        return self.new("IfcMappedItem", self.new("IfcRepresentationMap", origin, self.shape(*items)), target)

    def bar(self, *items: Any, at: Any = None, **attributes: Any) -> Any:
        body = self.new("IfcProductDefinitionShape", Representations=[self.shape(*items)])
        return self.rooted("IfcReinforcingBar", ObjectPlacement=at, Representation=body, **attributes)

    def bars(self) -> list[CageBar]:
        return bars_in_process(self.file.to_string().encode())

    def axis_m(self) -> ndarray:
        [cage_bar] = self.bars()
        return np.array(cage_bar.bar.axis_m)


def extruded_circle(ifc: Ifc, radius: float = 8.0, x: float = 0.0) -> Any:
    circle = ifc.new(
        "IfcCircleProfileDef", "AREA", None, ifc.new("IfcAxis2Placement2D", ifc.point((x, 0))), radius
    )
    return ifc.new("IfcExtrudedAreaSolid", circle, ifc.axes((0, 0, 0)), ifc.direction((0, 0, 1)), 500.0)


def extruded_square(ifc: Ifc, side: float = 14.0, length: float = 500.0) -> Any:
    square = ifc.new(
        "IfcRectangleProfileDef", "AREA", None, ifc.new("IfcAxis2Placement2D", ifc.point((0, 0))), side, side
    )
    return ifc.new("IfcExtrudedAreaSolid", square, ifc.axes((0, 0, 0)), ifc.direction((0, 0, 1)), length)
