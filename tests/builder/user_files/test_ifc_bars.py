"""Bars of IFC models: placements, axes, diameters and roles."""

from __future__ import annotations

import math
import runpy
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from dataset_builder.user_files.cage_file import cage_file_spec, load_cage
from dataset_builder.user_files.ifc_file import ifc_cage
from tests.builder.user_files.ifc_writer import (
    COLUMN,
    Ifc,
    Numbers,
    extruded_circle,
    extruded_square,
)


@pytest.mark.slow
def test_example_column_equals_same_cage_in_toml(tmp_path: Path) -> None:
    script = runpy.run_path("examples/make_column_ifc.py")
    foot, head = script["FOOT"], script["HEAD"]
    lines = ['unit = "mm"']
    for x, y in script["UPRIGHTS"]:
        lines += ["[[bar]]", "role = 'main'", "diameter = 8", f"points = [[{x}, {y}, {foot}], [{x}, {y}, {head}]]"]
    for n, level in enumerate(script["LEVELS"]):
        corners = script["stirrup_corners"]() * ([1, 1, 1] if n % 2 == 0 else [-1, -1, 1]) + [0, 0, level]
        lines += ["[[bar]]", "role = 'stirrup'", "diameter = 5", f"points = {corners.tolist()}"]
    (tmp_path / "same.toml").write_text("\n".join(lines))
    from_ifc, from_toml = (load_cage(cage_file_spec(path)) for path in (COLUMN, tmp_path / "same.toml"))
    assert len(from_ifc.bars) == 13
    for a, b in zip(from_ifc.bars, from_toml.bars, strict=True):
        assert (a.bar_id, a.role, a.diameter_m) == (b.bar_id, b.role, b.diameter_m)
        np.testing.assert_allclose(a.axis_m, b.axis_m, rtol=0, atol=1e-9)
    for ifc_part, toml_part in zip(from_ifc.parts, from_toml.parts, strict=True):
        np.testing.assert_array_equal(ifc_part.mesh.faces, toml_part.mesh.faces)
        np.testing.assert_allclose(ifc_part.mesh.vertices_m, toml_part.mesh.vertices_m, rtol=0, atol=1e-7)


@pytest.mark.slow
def test_example_column_script_reproduces_file(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "examples/make_column_ifc.py", tmp_path / "a.ifc"], check=True)
    assert (tmp_path / "a.ifc").read_bytes() == COLUMN.read_bytes()


@pytest.mark.parametrize(
    ("prefix", "unit", "metres"),
    [
        ("MILLI", None, 0.001),
        (None, None, 1.0),
        ("CENTI", None, 0.01),
        (None, 0.3048, 0.3048),
        ("MILLI", 25.4, 0.0254),
    ],
)
def test_nested_placements_in_every_unit(prefix: str | None, unit: float | None, metres: float) -> None:
    ifc = Ifc(prefix=prefix, unit=unit)
    # The storey's z axis is the world's x, its x axis the world's y, as (3, 4, 0) is not orthogonal to z, and
    # therefore its y axis the world's z.
    storey = ifc.at((10, 20, 30), (2, 0, 0), (3, 4, 0))
    # The bar is rotated by 90 degrees about z: its x axis is the storey's y, its y axis the storey's -x.
    disc = ifc.disc(ifc.polyline((0, 0, 0), (5, 2, 1)), 0.25)
    ifc.bar(disc, at=ifc.at((1, 2, 3), None, (0, 1, 0), parent=storey))
    # (5, 2, 1) -> storey (1 - 2, 2 + 5, 3 + 1) = (-1, 7, 4) -> world (10 + 4, 20 - 1, 30 + 7).
    [cage_bar] = ifc.bars()
    np.testing.assert_allclose(cage_bar.bar.axis_m, np.array([(13, 21, 32), (14, 19, 37)]) * metres, atol=1e-11)
    assert cage_bar.bar.diameter_m == pytest.approx(0.5 * metres, abs=1e-12)


def test_nested_mapped_items() -> None:
    ifc = Ifc()
    disc = ifc.disc(ifc.polyline((0, 0, 0), (100, 0, 10)))
    rotation = ifc.new(
        "IfcCartesianTransformationOperator3D",
        ifc.direction((0, 1, 0)), ifc.direction((-1, 0, 0)), ifc.point((5, 6, 7)), 2.0, ifc.direction((0, 0, 1)),
    )  # fmt: skip
    inner = ifc.mapped(rotation, ifc.axes((50, 0, 0)), disc)
    translation = ifc.new("IfcCartesianTransformationOperator3D", LocalOrigin=ifc.point((0, 0, 1000)))
    ifc.bar(ifc.mapped(translation, ifc.axes((0, 0, 0)), inner, disc))
    first, second = ifc.bars()
    # x + 50, scaled by 2, rotated by 90 degrees about z, translated: (5 - 2 y, 6 + 2 (x + 50), 7 + 2 z + 1000).
    np.testing.assert_allclose(np.array(first.bar.axis_m) * 1000, [(5, 106, 1007), (5, 306, 1027)], atol=1e-9)
    assert (first.bar.diameter_m, second.bar.diameter_m) == (0.032, 0.016)
    np.testing.assert_allclose(np.array(second.bar.axis_m) * 1000, [(0, 0, 1000), (100, 0, 1010)], atol=1e-9)
    assert (first.bar.bar_id, second.bar.bar_id) == (1, 2)


def test_mirrored_mapped_item() -> None:
    ifc = Ifc()
    mirror = ifc.new("IfcCartesianTransformationOperator3D", None, ifc.direction((0, -1, 0)), ifc.point((0, 0, 0)))
    ifc.bar(ifc.mapped(mirror, ifc.axes((0, 0, 0)), ifc.disc(ifc.polyline((0, 0, 0), (100, 30, 10)))))
    np.testing.assert_allclose(ifc.axis_m()[1], (0.1, -0.03, 0.01), atol=1e-12)


def trimmed_bend(ifc: Ifc, kind: str) -> tuple[Any, bool]:
    """Return a quarter circle from (200, 0) to (240, 40), and whether it runs in the direction of the bar."""
    up, down = (ifc.new("IfcCircle", ifc.axes((200, 40, 0), (0, 0, z), (0, -1, 0)), 40.0) for z in (1, -1))
    start, end = ifc.point((200, 0, 0)), ifc.point((240, 40, 0))
    parameters = {degrees: ifc.parameter(degrees) for degrees in (0.0, 90.0, 270.0)}
    arguments = {
        "parameters": (up, [parameters[0.0]], [parameters[90.0]], True, "PARAMETER"),
        "points": (up, [start], [end], True, "CARTESIAN"),
        "both": (up, [start, parameters[0.0]], [end, parameters[90.0]], True, "PARAMETER"),
        "backwards": (down, [parameters[270.0]], [parameters[0.0]], True, "PARAMETER"),
        "sense": (up, [end], [start], False, "CARTESIAN"),
    }
    return ifc.new("IfcTrimmedCurve", *arguments[kind]), kind not in ("backwards", "sense")


def composite_curve(ifc: Ifc, kind: str) -> Any:
    """Return a line, a bend and a reversed line."""
    line = ifc.new("IfcLine", ifc.point((0, 0, 0)), ifc.new("IfcVector", ifc.direction((2, 0, 0)), 10.0))
    first = ifc.new("IfcTrimmedCurve", line, [ifc.parameter(0.0)], [ifc.parameter(20.0)], True, "PARAMETER")
    curves = [(first, True), trimmed_bend(ifc, kind), (ifc.polyline((240, 140, 0), (240, 40, 0)), False)]
    segments = [ifc.new("IfcCompositeCurveSegment", "CONTINUOUS", sense, curve) for curve, sense in curves]
    return ifc.new("IfcCompositeCurve", segments, False)


def indexed_curve(ifc: Ifc, points: Sequence[Numbers], *pieces: tuple[int, ...]) -> Any:
    """Return lines and arcs through points, whose numbers start at 1."""
    coordinates = ifc.new("IfcCartesianPointList3D", [tuple(map(float, point)) for point in points])
    segments = [ifc.new("IfcLineIndex" if len(piece) == 2 else "IfcArcIndex", piece) for piece in pieces]
    return ifc.new("IfcIndexedPolyCurve", coordinates, segments, False)


@pytest.mark.parametrize("kind", ["parameters", "points", "both", "backwards", "sense", "indexed"])
def test_all_encodings_of_bend_give_same_axis(kind: str) -> None:
    ifc = Ifc()
    angles = np.linspace(0, math.pi / 2, 16)
    bend = [(200 + 40 * math.sin(a), 40 - 40 * math.cos(a), 0) for a in angles]
    if kind == "indexed":
        middle = (200 + 40 * math.sin(math.pi / 4), 40 - 40 * math.cos(math.pi / 4), 0)
        points = [(0, 0, 0), (200, 0, 0), middle, (240, 40, 0), (240, 140, 0)]
        curve = indexed_curve(ifc, points, (1, 2), (2, 3, 4), (4, 5))
    else:
        curve = composite_curve(ifc, kind)
    ifc.bar(ifc.disc(curve))
    np.testing.assert_allclose(ifc.axis_m() * 1000, [(0, 0, 0), *bend, (240, 140, 0)], atol=1e-9)


def test_arc_of_three_quarters_of_a_circle_is_on_the_side_of_its_middle() -> None:
    ifc = Ifc()
    start, middle, end, *expected = (
        (100 * math.cos(angle), 100 * math.sin(angle), 0) for angle in np.radians([0, 50, 270, *range(0, 271, 6)])
    )
    ifc.bar(ifc.disc(indexed_curve(ifc, (start, middle, end), (1, 2, 3))))
    np.testing.assert_allclose(ifc.axis_m() * 1000, expected, atol=1e-6)


def test_arc_of_collinear_points_is_line() -> None:
    ifc = Ifc()
    points = [(0, 0, 0), (100, 100, 0), (300, 300, 0)]
    ifc.bar(ifc.disc(indexed_curve(ifc, points, (1, 2, 3))))
    np.testing.assert_allclose(ifc.axis_m() * 1000, points, atol=1e-9)


def test_bars_keep_their_order_and_take_roles_from_types_and_names() -> None:
    ifc = Ifc()
    expected = [
        ("main", {"PredefinedType": "MAIN"}),
        ("stirrup", {"PredefinedType": "LIGATURE", "Name": "x"}),
        ("Top layer", {"PredefinedType": "USERDEFINED", "ObjectType": " Top \n layer "}),
        ("Bügel 7", {"Name": "Bügel 7"}),
        ("bar", {}),
    ]
    entities = [
        ifc.bar(ifc.disc(ifc.polyline((0, 100 * n, 0), (500, 100 * n, 0))), **attributes)
        for n, (_, attributes) in enumerate(expected)
    ]
    ifc.rooted(
        "IfcRelDefinesByType",
        RelatedObjects=[entities[-1]],
        RelatingType=ifc.rooted("IfcReinforcingBarType", PredefinedType="SHEAR"),
    )
    bars = [bar.bar for bar in ifc.bars()]
    assert [bar.role for bar in bars] == [*(role for role, _ in expected[:-1]), "shear"]
    assert [bar.axis_m[0][1] for bar in bars] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert [bar.bar_id for bar in bars] == [1, 2, 3, 4, 5]


def test_extruded_circles_are_exact_bars() -> None:
    ifc = Ifc()
    at = ifc.at((100, 200, 300), (1, 0, 0), (0, 0, 1))
    ifc.bar(extruded_circle(ifc), extruded_circle(ifc, 6.0, x=50.0), at=at)
    first, second = ifc.bars()
    np.testing.assert_allclose(first.bar.axis_m, [(0.1, 0.2, 0.3), (0.6, 0.2, 0.3)], atol=1e-12)
    np.testing.assert_allclose(second.bar.axis_m, [(0.1, 0.2, 0.35), (0.6, 0.2, 0.35)], atol=1e-12)
    assert (first.bar.diameter_m, second.bar.diameter_m) == (0.016, 0.012)
    assert first.mesh is None


@pytest.mark.slow
def test_other_solids_are_tessellated_and_placed() -> None:
    ifc = Ifc(prefix=None)
    solid = extruded_square(ifc, 0.008, 0.5)
    ifc.bar(ifc.disc(ifc.polyline((0, 0, 0), (0.5, 0, 0)), 0.008))
    mirror = ifc.new("IfcCartesianTransformationOperator3D", None, ifc.direction((0, -1, 0)), ifc.point((0, 1, 0)))
    placed = ifc.at((0.1, 0.2, 0.3), (1, 0, 0), (0, 0, 1))
    ifc.bar(solid, ifc.mapped(mirror, ifc.axes((0, 0, 0)), solid), at=placed)
    swept, first, second = ifc_cage(ifc.file.to_string().encode(), "a.ifc").bars
    assert (swept.bar.role, first.bar.role, second.bar.role) == ("bar", "imported", "imported")
    assert not first.bar.has_axis  # A square section is no round bar.
    assert first.mesh is not None
    assert second.mesh is not None
    np.testing.assert_allclose(first.mesh.vertices_m.mean(axis=0), (0.35, 0.2, 0.3), atol=1e-6)
    np.testing.assert_allclose(second.mesh.vertices_m.mean(axis=0), (0.35, -0.8, 0.3), atol=1e-6)
    for mesh in (first.mesh, second.mesh):  # The faces of the mirrored one look outward, too.
        assert trimesh.Trimesh(mesh.vertices_m, mesh.faces).volume == pytest.approx(0.008**2 * 0.5, rel=1e-6)
    assert [bar.bar.bar_id for bar in (swept, first, second)] == [1, 2, 3]


@pytest.mark.slow
def test_tessellated_bodies_get_bent_axis_or_none() -> None:
    """A U-bar and a plate in one Body are two bars; the kernel tessellates the bends of 30 mm."""
    ifc = Ifc()
    sine = 30 * (1 - 0.5**0.5)
    points = [(0, 400, 0), (0, 30, 0), (sine, sine, 0), (30, 0, 0), (170, 0, 0)]
    points += [(200 - sine, sine, 0), (200, 30, 0), (200, 400, 0)]
    curve = indexed_curve(ifc, points, (1, 2), (2, 3, 4), (4, 5), (5, 6, 7), (7, 8))
    section = ifc.new("IfcRectangleProfileDef", "AREA", None, None, 100.0, 20.0)
    plate = ifc.new("IfcExtrudedAreaSolid", section, ifc.axes((100, 200, 50)), ifc.direction((0, 0, 1)), 100.0)
    ifc.bar(ifc.disc(curve, 6.0), plate)
    bent, other = (cage_bar.bar for cage_bar in ifc.bars())
    assert bent.diameter_m == pytest.approx(0.012, rel=0.001)
    assert bent.length_m == pytest.approx(2 * 0.37 + 0.14 + math.pi * 0.03, rel=0.001)
    assert not other.has_axis


def test_host_is_a_whole_or_a_connected_element() -> None:
    ifc = Ifc()
    part, connected, other = (ifc.bar(ifc.disc(ifc.polyline((0, y, 0), (500, y, 0)))) for y in (0, 100, 200))
    wall, slab = ifc.rooted("IfcWall", Name="W"), ifc.rooted("IfcSlab", Name="S")
    ifc.rooted("IfcRelNests", RelatingObject=wall, RelatedObjects=[part])
    for bar in (part, connected):
        ifc.rooted("IfcRelConnectsWithRealizingElements", RelatingElement=slab, RelatedElement=bar,
                   RealizingElements=[bar])  # fmt: skip
    storey = ifc.rooted("IfcBuildingStorey", Name="EG")
    ifc.rooted("IfcRelContainedInSpatialStructure", RelatedElements=[wall, other], RelatingStructure=storey)
    assert [(bar.host, bar.storey) for bar in ifc.bars()] == [("W", "EG"), ("S", None), (None, "EG")]
