"""Writer of small IFC models for tests."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ifcopenshell
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.specs.file_specs import Trust
from dataset_builder.user_files.cage_file import raise_problems
from dataset_builder.user_files.ifc_file import Answer
from dataset_builder.user_files.ifc_reader.__main__ import write_answer

Numbers = Sequence[float]
COLUMN = Path("examples/column.ifc")
SITE_MM = (4_512_345_678.0, 5_432_109_876.0, 215_000.0)
SITE_TURN_DEG = 31.0


def bars_in_process(content: bytes, trust: Trust = "declared") -> list[CageBar]:
    """Return the bars of an IFC file, read without the process that ``ifc_cage`` starts."""
    stream = io.BytesIO()
    write_answer(content, stream)
    stream.seek(0)
    cage = Answer(stream, "a.ifc", trust).cage()
    raise_problems(cage.problems, "a.ifc")
    return list(cage.bars)


def column_with(old: str, new: str) -> str:
    """Return the text of the example column with its first ``old`` replaced."""
    text = COLUMN.read_text()
    assert old in text
    return text.replace(old, new, 1)


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


def site_from_world_m() -> Float64[ndarray, "4 4"]:
    """Return the transform from the project's frame to that of the site, both in metres."""
    cosine, sine = np.cos(np.deg2rad(SITE_TURN_DEG)), np.sin(np.deg2rad(SITE_TURN_DEG))
    matrix = np.eye(4)
    matrix[:2, :2] = [[cosine, sine], [-sine, cosine]]
    matrix[:3, 3] = -matrix[:3, :3] @ (np.array(SITE_MM) / 1000)
    return matrix


def write_site_model(path: Path, schema: str = "IFC4") -> Path:
    """Write a wall, a column and a fitting of life size at site coordinates, with a slab.

    The bars of the wall are parts of it (as Tekla writes them), those of the column are contained in a storey (as
    Revit does), and the fitting is a proxy whose body is extruded circles (as precast suppliers write them).
    """
    ifc = Ifc(schema)
    turn = np.deg2rad(SITE_TURN_DEG)
    placement = ifc.at(SITE_MM, (0, 0, 1), (np.cos(turn), np.sin(turn), 0))
    ground, upper = (
        ifc.rooted("IfcBuildingStorey", Name=name, ObjectPlacement=ifc.at((0, 0, z), parent=placement))
        for name, z in (("EG Erdgeschoss", 0), ("Level 1", 4000))
    )
    wall = _product(ifc, "IfcWall", "W-1", ground, [_block(ifc, (6000, 250, 3000))])
    ifc.rooted("IfcRelAggregates", RelatingObject=wall, RelatedObjects=_bars_of_wall(ifc, ground))
    column = _bars_of_column(ifc, upper)
    circles = [extruded_circle(ifc, 8.0, x) for x in (3000.0, 3100.0)]
    fitting = _product(ifc, "IfcBuildingElementProxy", "Rebar fitting", ground, circles)
    slab = _product(ifc, "IfcSlab", "Slab", ground, [_block(ifc, (8000, 8000, 200))])
    for storey, parts in ((ground, [wall, slab, fitting]), (upper, column)):
        ifc.rooted("IfcRelContainedInSpatialStructure", RelatedElements=parts, RelatingStructure=storey)
    ifc.file.write(str(path))
    return path


def _bars_of_wall(ifc: Ifc, storey: Any) -> list[Any]:
    bars = []
    for y, inward in ((41, 12), (209, -12)):
        uprights = [((x, y, 40), (x, y, 2960)) for x in range(75, 6000, 300)]
        flat = [((40, y - inward, z), (5960, y - inward, z)) for z in range(75, 3000, 300)]
        bars += [_bar(ifc, ends, 12, storey) for ends in (*uprights, *flat)]
    return bars


def _bars_of_column(ifc: Ifc, storey: Any) -> list[Any]:
    """Return the bars of a column of 0.4 x 0.4 x 3 m whose middle is at x = 7 m, y = 1 m."""
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    corners = [(7000 + 150 * x, 1000 + 150 * y) for x, y in signs]
    uprights = [_bar(ifc, ((x, y, 20), (x, y, 3020)), 25, storey) for x, y in corners]
    around = [[(7000 + 168 * x, 1000 + 168 * y, z) for x, y in signs] for z in range(70, 3000, 300)]
    stirrups = [_bar(ifc, points, 10, storey) for points in around]
    shapes = [bar.Representation.Representations[0] for bar in stirrups]
    ifc.new("IfcPresentationLayerAssignment", "Stirrups", None, shapes, None)
    return [*uprights, *stirrups]


def _bar(ifc: Ifc, points: Sequence[Numbers], diameter_mm: float, storey: Any) -> Any:
    disc = ifc.disc(ifc.polyline(*points), diameter_mm / 2)
    bar = _product(ifc, "IfcReinforcingBar", f"Bar {diameter_mm:g}", storey, [disc], shape="AdvancedSweptSolid")
    bar.NominalDiameter = float(diameter_mm)
    return bar


def _product(ifc: Ifc, kind: str, name: str, storey: Any, items: list[Any], shape: str = "SweptSolid") -> Any:
    body = ifc.new("IfcProductDefinitionShape", Representations=[ifc.shape(*items, kind=shape)])
    place = ifc.at((0, 0, 0), parent=storey.ObjectPlacement)
    return ifc.rooted(kind, Name=name, ObjectPlacement=place, Representation=body)


def _block(ifc: Ifc, sides: Numbers) -> Any:
    middle = ifc.new("IfcAxis2Placement2D", ifc.point((sides[0] / 2, sides[1] / 2)))
    profile = ifc.new("IfcRectangleProfileDef", "AREA", None, middle, float(sides[0]), float(sides[1]))
    return ifc.new("IfcExtrudedAreaSolid", profile, ifc.axes((0, 0, 0)), ifc.direction((0, 0, 1)), float(sides[2]))
