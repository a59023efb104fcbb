"""Generator of ``column.ifc``: a small IFC4 model of a column cage for ``rebar-build --scene``.

python examples/make_column_ifc.py [FILE]      (needs pip install '.[ifc]')

The cage has eight upright bars and five stirrups. Each upright bar has its own swept disc along a polyline. The
stirrups share one swept disc along a curve of lines and arcs through mapped items; every second stirrup is rotated
by 180 degrees, so that the hooks alternate between corners. The output is deterministic. All lengths are in
millimetres.
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
"""Bend radius of the stirrups' centreline. EN 1992: mandrel of four bar diameters for bars up to 16 mm."""

STIRRUP_HALF_WIDTH = 55.0
"""Distance of the stirrups' centrelines from the column's axis."""

FOOT, HEAD = 0.1, 200.0
"""Heights of the lower and upper ends of the upright bars."""

UPRIGHT_OFFSET = STIRRUP_HALF_WIDTH - 9.0
"""Offset of the upright bars from the column's axis in x and y; the bars with ribs do not touch the stirrups."""

UPRIGHTS = [
    (x, y)
    for x in (-UPRIGHT_OFFSET, 0.0, UPRIGHT_OFFSET)
    for y in (-UPRIGHT_OFFSET, 0.0, UPRIGHT_OFFSET)
    if (x, y) != (0.0, 0.0)
]
LEVELS = [20.0, 60.0, 100.0, 140.0, 180.0]
"""Heights of the stirrups."""

NAMESPACE = uuid.UUID("6f1d9a50-3f1c-4c53-9d8e-5a1f0c7b2d10")
"""Namespace of the UUIDs from which the GlobalIds are derived."""


def stirrup_corners(climb: float = 6.0, tail: float = 34.0) -> np.ndarray:
    """Return the corner points (n x 3, relative to the stirrup's centre) of a stirrup with two 135-degree hooks.

    Both ends bend round the corner at (-x, +y), and the second passes ``climb`` above the first;
    ``tail`` is the straight length behind the bend. For the same bend radius, the intersection point of the
    tangents of a 135-degree bend lies 1.41 radii further out than that of a 90-degree bend.
    """
    outer = STIRRUP_HALF_WIDTH + BEND_RADIUS * (np.tan(np.deg2rad(67.5)) - 1)
    hook = (tail + BEND_RADIUS * np.tan(np.deg2rad(67.5))) / np.sqrt(2)
    path = np.array(
        [
            (-STIRRUP_HALF_WIDTH + hook, outer - hook),
            (-STIRRUP_HALF_WIDTH, outer),
            (-STIRRUP_HALF_WIDTH, -STIRRUP_HALF_WIDTH),
            (STIRRUP_HALF_WIDTH, -STIRRUP_HALF_WIDTH),
            (STIRRUP_HALF_WIDTH, STIRRUP_HALF_WIDTH),
            (-outer, STIRRUP_HALF_WIDTH),
            (-outer + hook, STIRRUP_HALF_WIDTH - hook),
        ]
    )
    path_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    loop_length = 8 * STIRRUP_HALF_WIDTH
    return np.column_stack([path, climb * (path_length - path_length[-1] / 2) / loop_length])


def lines_and_arcs(
    corners: np.ndarray, radius: float
) -> tuple[list[tuple[float, ...]], list[tuple[str, list[int]]]]:
    """Return the points of a path with rounded corners, and its segments as (type, 1-based point indices)."""
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
    """IFC4 model under construction, with helpers that add its entities."""

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
        self.project = self.add_rooted(
            "IfcProject",
            "Column cage",
            RepresentationContexts=[self.context],
            UnitsInContext=new("IfcUnitAssignment", [length, angle]),
        )

    def add_rooted(self, kind: str, name: str, **attributes: object) -> ifcopenshell.entity_instance:
        """Add an object with a GlobalId that is derived from its type and name."""
        guid = ifcopenshell.guid.compress(uuid.uuid5(NAMESPACE, f"{kind}/{name}").hex)
        return self.file.create_entity(kind, GlobalId=guid, Name=name, **attributes)

    def point(self, *coordinates: float) -> ifcopenshell.entity_instance:
        """Add and return a Cartesian point."""
        return self.file.create_entity("IfcCartesianPoint", coordinates)

    def placement3d(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> ifcopenshell.entity_instance:
        """Add and return an axis placement at (x, y, z) with the axes of its parent."""
        return self.file.create_entity("IfcAxis2Placement3D", self.point(x, y, z))

    def local_placement(
        self, parent: ifcopenshell.entity_instance | None, z: float = 0.0
    ) -> ifcopenshell.entity_instance:
        """Add and return an object placement at height ``z`` above its parent's."""
        return self.file.create_entity("IfcLocalPlacement", parent, self.placement3d(z=z))

    def shape(self, kind: str, item: ifcopenshell.entity_instance) -> ifcopenshell.entity_instance:
        """Add and return a body representation with one item."""
        return self.file.create_entity("IfcShapeRepresentation", self.body, "Body", kind, [item])

    def add_bar(self, name: str, role: str, diameter: float, placement: object, shape: object) -> object:
        """Add and return a reinforcing bar."""
        return self.add_rooted(
            "IfcReinforcingBar",
            name,
            ObjectPlacement=placement,
            Representation=self.file.create_entity("IfcProductDefinitionShape", Representations=[shape]),
            NominalDiameter=diameter,
            PredefinedType=role,
        )

    def write(self, path: Path) -> None:
        """Write the IFC file to ``path``."""
        self.file.write(str(path))


def column() -> ColumnModel:
    """Return the complete model of the column cage."""
    model = ColumnModel()
    new = model.file.create_entity
    site = model.add_rooted("IfcSite", "Site", ObjectPlacement=model.local_placement(None))
    building = model.add_rooted(
        "IfcBuilding", "Building", ObjectPlacement=model.local_placement(site.ObjectPlacement)
    )
    storey = model.add_rooted(
        "IfcBuildingStorey", "Ground", ObjectPlacement=model.local_placement(building.ObjectPlacement)
    )
    for n, (whole, part) in enumerate([(model.project, site), (site, building), (building, storey)]):
        model.add_rooted("IfcRelAggregates", f"Spatial {n}", RelatingObject=whole, RelatedObjects=[part])

    bars = []
    for n, (x, y) in enumerate(UPRIGHTS, start=1):
        line = new("IfcPolyline", [model.point(x, y, FOOT), model.point(x, y, HEAD)])
        solid = new("IfcSweptDiskSolid", line, UPRIGHT_DIAMETER / 2)
        shape = model.shape("AdvancedSweptSolid", solid)
        bars.append(
            model.add_bar(
                f"Upright {n}", "MAIN", UPRIGHT_DIAMETER, model.local_placement(storey.ObjectPlacement), shape
            )
        )

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
        placement = model.local_placement(storey.ObjectPlacement, level)
        bars.append(model.add_bar(f"Stirrup {n + 1}", "LIGATURE", STIRRUP_DIAMETER, placement, shape))
    model.add_rooted("IfcRelContainedInSpatialStructure", "Bars", RelatedElements=bars, RelatingStructure=storey)
    return model


if __name__ == "__main__":
    column().write(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("column.ifc")))
