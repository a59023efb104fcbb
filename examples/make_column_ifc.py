"""Writes ``column.ifc``: a small IFC4 model of a column cage, which ``rebar-build --scene`` reads.

python examples/make_column_ifc.py [FILE]      (needs pip install 'rebar-depth-bench[ifc]')

Eight upright bars carry five stirrups. Each upright bar has its own swept disc along a polyline. The stirrups
share one swept disc, which is a curve of lines and arcs, through mapped items; every second one is turned by half
a turn, so that the hooks change corners. The same bytes come out each time. All lengths are millimetres.
"""

from __future__ import annotations

import sys
import uuid
from pathlib import Path

import ifcopenshell
import ifcopenshell.guid
import numpy as np

UPRIGHT_DIAMETER, STIRRUP_DIAMETER = 8.0, 5.0
BEND_RADIUS = 2.5 * STIRRUP_DIAMETER
"""Of the centreline: EN 1992 bends bars of up to 16 mm round a mandrel of four diameters."""
HALF = 55.0
"""From the column's middle to the stirrups' centrelines."""
FOOT, HEAD = 0.1, 200.0
UPRIGHT = HALF - 9.0
"""From the column's middle to the upright bars: clear of the stirrups, ribs included."""
UPRIGHTS = [(x, y) for x in (-UPRIGHT, 0.0, UPRIGHT) for y in (-UPRIGHT, 0.0, UPRIGHT) if (x, y) != (0.0, 0.0)]
LEVELS = [20.0, 60.0, 100.0, 140.0, 180.0]
NAMESPACE = uuid.UUID("6f1d9a50-3f1c-4c53-9d8e-5a1f0c7b2d10")


def stirrup_corners(climb: float = 6.0, tail: float = 34.0) -> np.ndarray:
    """Return the corners (n x 3, about the stirrup's middle) of a hoop that ends in two hooks of 135 degrees.

    Both ends turn round the corner at -x, +y, and the second passes ``climb`` above the first. The corner of a
    turn of 135 degrees round the same mandrel lies further out than one of 90 degrees, by 1.41 radii.
    """
    out = HALF + BEND_RADIUS * (np.tan(np.deg2rad(67.5)) - 1)
    back = (tail + BEND_RADIUS * np.tan(np.deg2rad(67.5))) / np.sqrt(2)
    path = np.array(
        [
            (-HALF + back, out - back),
            (-HALF, out),
            (-HALF, -HALF),
            (HALF, -HALF),
            (HALF, HALF),
            (-out, HALF),
            (-out + back, HALF - back),
        ]
    )
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    turn = 8 * HALF
    return np.column_stack([path, climb * (along - along[-1] / 2) / turn])


def lines_and_arcs(
    corners: np.ndarray, radius: float
) -> tuple[list[tuple[float, ...]], list[tuple[str, list[int]]]]:
    """Return the points of a path with rounded corners, and its segments as 1-based indices into them."""
    points, segments = [corners[0]], []
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        a, b = before - corner, after - corner
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        half_angle = np.arccos(a @ b) / 2
        to_middle = (a + b) / np.linalg.norm(a + b)
        centre = corner + to_middle * radius / np.sin(half_angle)
        points += [corner + a * radius / np.tan(half_angle), centre - to_middle * radius]
        points += [corner + b * radius / np.tan(half_angle)]
        n = len(points)
        segments += [("IfcLineIndex", [n - 3, n - 2]), ("IfcArcIndex", [n - 2, n - 1, n])]
    points.append(corners[-1])
    segments.append(("IfcLineIndex", [len(points) - 1, len(points)]))
    return [tuple(float(round(value, 9)) for value in point) for point in points], segments


class ColumnModel:
    """The IFC file as it grows."""

    def __init__(self) -> None:
        self.file = ifcopenshell.file(schema="IFC4")
        header = self.file.header
        header.file_description.description = ("ViewDefinition [ReferenceView_V1.2]",)
        header.file_name.name = "column.ifc"
        header.file_name.time_stamp = "2025-01-01T00:00:00"
        header.file_name.author = header.file_name.organization = ("rebar-depth-bench",)
        header.file_name.preprocessor_version = header.file_name.originating_system = "make_column_ifc.py"
        header.file_name.authorization = ""
        self.world = self.placement3d()
        new = self.file.create_entity
        self.context = new(
            "IfcGeometricRepresentationContext", None, "Model", 3, 1e-6, WorldCoordinateSystem=self.world
        )
        self.body = new(
            "IfcGeometricRepresentationSubContext",
            "Body",
            "Model",
            ParentContext=self.context,
            TargetView="MODEL_VIEW",
        )
        length = new("IfcSIUnit", UnitType="LENGTHUNIT", Prefix="MILLI", Name="METRE")
        angle = new("IfcSIUnit", UnitType="PLANEANGLEUNIT", Name="RADIAN")
        self.project = self.rooted(
            "IfcProject",
            "Column cage",
            RepresentationContexts=[self.context],
            UnitsInContext=new("IfcUnitAssignment", [length, angle]),
        )

    def rooted(self, kind: str, name: str, **attributes: object) -> ifcopenshell.entity_instance:
        """Add an object whose GlobalId follows from its kind and name."""
        guid = ifcopenshell.guid.compress(uuid.uuid5(NAMESPACE, f"{kind}/{name}").hex)
        return self.file.create_entity(kind, GlobalId=guid, Name=name, **attributes)

    def point(self, *coordinates: float) -> ifcopenshell.entity_instance:
        """Return a new point."""
        return self.file.create_entity("IfcCartesianPoint", coordinates)

    def placement3d(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> ifcopenshell.entity_instance:
        """Return a new placement there, its axes those of what it stands in."""
        return self.file.create_entity("IfcAxis2Placement3D", self.point(x, y, z))

    def at(self, parent: ifcopenshell.entity_instance | None, z: float = 0.0) -> ifcopenshell.entity_instance:
        """Return a new object placement ``z`` above its parent's."""
        return self.file.create_entity("IfcLocalPlacement", parent, self.placement3d(z=z))

    def shape(self, kind: str, item: ifcopenshell.entity_instance) -> ifcopenshell.entity_instance:
        """Return a new body of one item."""
        return self.file.create_entity("IfcShapeRepresentation", self.body, "Body", kind, [item])

    def bar(self, name: str, role: str, diameter: float, placement: object, shape: object) -> object:
        """Add a reinforcing bar."""
        return self.rooted(
            "IfcReinforcingBar",
            name,
            ObjectPlacement=placement,
            Representation=self.file.create_entity("IfcProductDefinitionShape", Representations=[shape]),
            NominalDiameter=diameter,
            PredefinedType=role,
        )

    def write(self, path: Path) -> None:
        """Write the file."""
        self.file.write(str(path))


def column() -> ColumnModel:
    """Return the whole model."""
    model = ColumnModel()
    new = model.file.create_entity
    site = model.rooted("IfcSite", "Site", ObjectPlacement=model.at(None))
    building = model.rooted("IfcBuilding", "Building", ObjectPlacement=model.at(site.ObjectPlacement))
    storey = model.rooted("IfcBuildingStorey", "Ground", ObjectPlacement=model.at(building.ObjectPlacement))
    for n, (whole, part) in enumerate([(model.project, site), (site, building), (building, storey)]):
        model.rooted("IfcRelAggregates", f"Spatial {n}", RelatingObject=whole, RelatedObjects=[part])

    bars = []
    for n, (x, y) in enumerate(UPRIGHTS, start=1):
        line = new("IfcPolyline", [model.point(x, y, FOOT), model.point(x, y, HEAD)])
        solid = new("IfcSweptDiskSolid", line, UPRIGHT_DIAMETER / 2)
        shape = model.shape("AdvancedSweptSolid", solid)
        bars.append(model.bar(f"Upright {n}", "MAIN", UPRIGHT_DIAMETER, model.at(storey.ObjectPlacement), shape))

    points, segments = lines_and_arcs(stirrup_corners(), BEND_RADIUS)
    indices = [model.file.create_entity(kind, tuple(numbers)) for kind, numbers in segments]
    curve = new("IfcIndexedPolyCurve", new("IfcCartesianPointList3D", points), indices, False)
    solid = new("IfcSweptDiskSolid", curve, STIRRUP_DIAMETER / 2)
    shared = new("IfcRepresentationMap", model.placement3d(), model.shape("AdvancedSweptSolid", solid))
    x_axis, y_axis = (new("IfcDirection", ratios) for ratios in ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))
    turns = [
        new("IfcCartesianTransformationOperator3D", LocalOrigin=model.point(0.0, 0.0, 0.0)),
        new("IfcCartesianTransformationOperator3D", x_axis, y_axis, model.point(0.0, 0.0, 0.0)),
    ]
    for n, level in enumerate(LEVELS):
        shape = model.shape("MappedRepresentation", new("IfcMappedItem", shared, turns[n % 2]))
        placement = model.at(storey.ObjectPlacement, level)
        bars.append(model.bar(f"Stirrup {n + 1}", "LIGATURE", STIRRUP_DIAMETER, placement, shape))
    model.rooted("IfcRelContainedInSpatialStructure", "Bars", RelatedElements=bars, RelatingStructure=storey)
    return model


if __name__ == "__main__":
    column().write(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("column.ifc")))
