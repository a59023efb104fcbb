"""IFC model of a wall and a column of life size at site coordinates, with objects that are no reinforcement.

The bars of the wall are parts of it (as Tekla writes them), those of the column are contained in a storey (as
Revit does), and a fitting is a proxy whose body is extruded circles (as precast suppliers write reinforcement).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from tests.builder.user_files.ifc_writer import Ifc, Numbers, extruded_circle

SITE_MM = (4_512_345_678.0, 5_432_109_876.0, 215_000.0)
SITE_TURN_DEG = 31.0
WALL_BARS, COLUMN_BARS, FITTING_BARS = 120, 4 + 20, 2


def site_from_world_m() -> Float64[ndarray, "4 4"]:
    """Return the transform from the project's frame to that of the site, both in metres."""
    cosine, sine = np.cos(np.deg2rad(SITE_TURN_DEG)), np.sin(np.deg2rad(SITE_TURN_DEG))
    matrix = np.eye(4)
    matrix[:2, :2] = [[cosine, sine], [-sine, cosine]]
    matrix[:3, 3] = -matrix[:3, :3] @ (np.array(SITE_MM) / 1000)
    return matrix


def write_site_model(path: Path, schema: str = "IFC4") -> Path:
    """Write the model; the bars' ids are those of the wall, the column and the fitting, in this order."""
    ifc = Ifc(schema)
    turn = np.deg2rad(SITE_TURN_DEG)
    placement = ifc.at(SITE_MM, (0, 0, 1), (np.cos(turn), np.sin(turn), 0))
    ground, upper = (
        ifc.rooted("IfcBuildingStorey", Name=name, ObjectPlacement=ifc.at((0, 0, z), parent=placement))
        for name, z in (("EG Erdgeschoss", 0), ("Level 1", 4000))
    )
    wall = _wall(ifc, ground)
    column = _column(ifc, upper)
    fitting = _fitting(ifc, ground)
    slab = _product(ifc, "IfcSlab", "Slab", ground, [_block(ifc, (8000, 8000, 200))], "SweptSolid")
    for storey, parts in ((ground, [wall, slab, fitting]), (upper, column)):
        ifc.rooted("IfcRelContainedInSpatialStructure", RelatedElements=parts, RelatingStructure=storey)
    ifc.file.write(str(path))
    return path


def _wall(ifc: Ifc, storey: Any) -> Any:
    wall = _product(ifc, "IfcWall", "W-1", storey, [_block(ifc, (6000, 250, 3000))], "SweptSolid")
    bars = []
    for y, inward in ((41, 12), (209, -12)):
        uprights = [((x, y, 40), (x, y, 2960)) for x in range(75, 6000, 150)]
        flat = [((40, y - inward, z), (5960, y - inward, z)) for z in range(75, 3000, 150)]
        bars += [_bar(ifc, ends, 12, storey) for ends in (*uprights, *flat)]
    ifc.rooted("IfcRelAggregates", RelatingObject=wall, RelatedObjects=bars)
    return wall


def _column(ifc: Ifc, storey: Any) -> list[Any]:
    """Return the bars of a column of 0.4 x 0.4 x 3 m whose middle is at x = 7 m, y = 1 m."""
    corners = [(7000 + x, 1000 + y) for x, y in ((-150, -150), (150, -150), (150, 150), (-150, 150))]
    bars = [_bar(ifc, ((x, y, 20), (x, y, 3020)), 25, storey) for x, y in corners]
    for z in range(70, 3000, 150):
        around = [(7000 + x, 1000 + y, z) for x, y in ((-168, -168), (168, -168), (168, 168), (-168, 168))]
        bars.append(_bar(ifc, around, 10, storey))
    shapes = [bar.Representation.Representations[0] for bar in bars[4:]]
    ifc.new("IfcPresentationLayerAssignment", "Stirrups", None, shapes, None)
    return bars


def _fitting(ifc: Ifc, storey: Any) -> Any:
    circles = [extruded_circle(ifc, 8.0, x) for x in (3000.0, 3100.0)]
    return _product(ifc, "IfcBuildingElementProxy", "Rebar fitting", storey, circles, "SweptSolid")


def _bar(ifc: Ifc, points: Sequence[Numbers], diameter_mm: float, storey: Any) -> Any:
    disc = ifc.disc(ifc.polyline(*points), diameter_mm / 2)
    bar = _product(ifc, "IfcReinforcingBar", f"Bar {diameter_mm:g}", storey, [disc], "AdvancedSweptSolid")
    bar.NominalDiameter = float(diameter_mm)
    return bar


def _product(ifc: Ifc, kind: str, name: str, storey: Any, items: list[Any], shape: str) -> Any:
    body = ifc.new("IfcProductDefinitionShape", Representations=[ifc.shape(*items, kind=shape)])
    place = ifc.at((0, 0, 0), parent=storey.ObjectPlacement)
    return ifc.rooted(kind, Name=name, ObjectPlacement=place, Representation=body)


def _block(ifc: Ifc, sides: Numbers) -> Any:
    middle = ifc.new("IfcAxis2Placement2D", ifc.point((sides[0] / 2, sides[1] / 2)))
    profile = ifc.new("IfcRectangleProfileDef", "AREA", None, middle, float(sides[0]), float(sides[1]))
    return ifc.new("IfcExtrudedAreaSolid", profile, ifc.axes((0, 0, 0)), ifc.direction((0, 0, 1)), float(sides[2]))
