"""Damaged IFC models: an error that names the instance, instead of wrong bars."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.user_files.cage_file import cage_file_spec, mesh_file_spec
from rebar_depth_bench.base.errors import MeshError
from rebar_depth_bench.data.bars import Bar
from tests.builder.scene.cages import assembly_of
from tests.builder.user_files.ifc_writer import Ifc, bars_in_process, extruded_square

COLUMN = Path("examples/column.ifc")


def assert_rejected(content: str, words: str) -> None:
    with pytest.raises(MeshError, match=f"^a.ifc: .*{words}"):
        bars_in_process(content.encode())


def bars_of(content: str) -> list[Bar]:
    return [cage_bar.bar for cage_bar in bars_in_process(content.encode())]


@pytest.fixture(scope="module")
def sound() -> list[Bar]:
    return bars_of(COLUMN.read_text())


def column_with(old: str, new: str) -> str:
    text = COLUMN.read_text()
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "does not begin with ISO-10303-21"),
        ("solid cage", "does not begin with ISO-10303-21"),
        (COLUMN.read_text()[:5000], "does not end with END-ISO-10303-21.*truncated"),
        (column_with("'IFC4'", "'IFC9'"), "not a readable IFC file"),
        (column_with("'IFC4'", "''"), "the name of the schema"),
        (column_with("FILE_SCHEMA", "FILE_SCHEMB"), "the name of the schema is missing"),
        (column_with("DATA;", "DATB;"), "no complete header"),
        (column_with("IFCLOCALPLACEMENT(", "IFCLOCALPLAZEMENT("), "1 of its instances .* first #11"),
        (column_with("=IFCREINFORCINGBAR(", "=IFCREINFORCINGBAT("), "1 of its instances .* first #33"),
        (column_with("#31=", "#9031="), "IfcReinforcingBar .*#33.*: ObjectPlacement is #31, which cannot be read"),
        (column_with("#31=", "#30="), "#30 is defined twice"),
        (COLUMN.read_text().replace("IFCREINFORCINGBAR", "IFCBEAM"), "contains no reinforcement"),
        (column_with(".LENGTHUNIT.,.MILLI.,.METRE.", ".AREAUNIT.,.MILLI.,.SQUARE_METRE."), "no known length unit"),
    ],
)  # fmt: skip
def test_damaged_files_are_rejected(content: str, words: str) -> None:
    assert_rejected(content, words)


def test_texts_of_windows_and_pointers_of_git_lfs(tmp_path: Path) -> None:
    """A byte order mark is no part of the text; names of an older program are Latin-1."""
    text = COLUMN.read_text()
    assert len(bars_in_process(b"\xef\xbb\xbf" + text.encode())) == 13
    assert len(bars_in_process(text.replace("('')", "('B\xfcro')", 1).encode("latin-1"))) == 13
    with pytest.raises(MeshError, match=r"^a.ifc: the text is UTF-16, expected UTF-8 text"):
        bars_in_process(text.encode("utf-16"))
    for name, spec in (("a.ifc", cage_file_spec), ("a.obj", partial(mesh_file_spec, unit="m"))):
        (tmp_path / name).write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:4d4d\nsize 12\n")
        with pytest.raises(MeshError, match="it is a pointer of git LFS"):
            spec(tmp_path / name)


POINT = "#24=IFCCARTESIANPOINT((-46.,-46.,0.1));"
UNREAD = "which cannot be read"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # ifcopenshell turns each of these into null or leaves it out; the stirrup was moved by 100 mm.
        ("$,$,#135,#136", "$,$,c135,#136", "#137 is .*c135.*, expected 14 readable"),
        ("#135=IFCLOCALPLACEMENT(#19,", "#135=IFCLOCALPLACEMENT(c19,", "#135 is .*, expected 2 readable"),
        ("#135=IFCLOCALPLACEMENT(#19,", "#135=IFCLOCALPLACEMENT(#99999,", f"PlacementRelTo is #99999, {UNREAD}"),
        ("#135=IFCLOCALPLACEMENT(#19,", "#135=IFCLOCALPLACEMENT(,", f"PlacementRelTo is '', {UNREAD}"),
        ("#135=IFCLOCALPLACEMENT(#19,", "#135=IFCLOCALPLACEMENT(19,", "#135 .*PlacementRelTo is 19, expected"),
        ("#135=IFCLOCALPLACEMENT(#19,", "#135=IFCLOCALPLACEMENT(#18,", "PlacementRelTo is #18=.*, expected"),
        ("#135=IFCLOCALPLACEMENT(#19,#134)", "#135=IFCLOCALPLACEMENT(#19)", "#135 is .* expected . readable"),
        ("#26=IFCPOLYLINE((#24,#25))", "#26=IFCPOLYLINE((#24,c25))", "#26 is .* expected . readable"),
        ("#26=IFCPOLYLINE((#24,#25))", "#26=IFCPOLYLINE(#24)", "#26 .*Points is #24=.*, expected <list"),
        ("#26=IFCPOLYLINE((#24,#25))", "#26=IFCPOLYLINE(())", "#26 .*Points is .*, expected <list .2"),
        ("#26=IFCPOLYLINE((#24,#25))", "#26=IFCPOLYLINE((#24))", "#26 .*Points is .*, expected <list .2"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,nan));", "#24 is .*nan.* expected . readable"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,));", f"#24 .*Coordinates is .*, {UNREAD}"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,$));", f"#24 .*Coordinates is .*, {UNREAD}"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-4 6.,0.1));", f"#24 .*Coordinates is .*, {UNREAD}"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,1.E999));", "instances cannot be read, first #24"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.));", "#24 .*has 1 coordinates, expected 2 or 3"),
        (POINT, "#24=IFCCARTESIANPOINT(());", "#24 .*Coordinates is .*, expected <list .1:3. of"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,0,1));", "#24 .*Coordinates is .*, expected <list .1:3. of"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.));", "#26 .*refers to points of 2 and 3 coordinates"),
        (POINT, "#24=IFCCARTESIANPOINT($);", "#24 .*Coordinates is null"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,0.1)));", "#24 is .* expected . readable"),
        ("#133=IFCCARTESIANPOINT((0.,0.,100.))", "#133=IFCCARTESIANPOINT((0.,0.))", "#134 .*points of 2 coord"),
        ("#26,4.,$,$,$)", "#26,4 5.,$,$,$)", f"#27 .*Radius is 45., {UNREAD}"),
        ("#26,4.,$,$,$)", "#26,'4',$,$,$)", "#27 .*Radius is 4, expected"),
        ("#26,4.,$,$,$)", "#26,0.,$,$,$)", "#33.* a circle has the radius 0, expected above 0"),
        ("#26,4.,$,$,$)", "#26,4.)", "#27 is .*, expected 5 readable attributes of IfcSweptDiskSolid"),
        (".MAIN.", ".MAIX.", f"#33 .*PredefinedType is .MAIX., {UNREAD}"),
        ("#6=IFCSIUNIT(*,.PLANEANGLEUNIT.", "#6=IFCSIUNIT(*,.PLANEANGLEUNIX.", f"#6 .*UnitType is .*, {UNREAD}"),
        ("(#5,#6)", "(#5,c6)", "#7 is .* expected . readable"),
        # Text that hides the instances that follow it.
        ("'Upright 1'", "'Upright 1", "the text after #32 .* is #33=IFC"),
        ("'Site'", "Site'", "the text after #11 .* is #12=IFC"),
        (POINT, POINT[:-1], "the text after #23 .* is #24=IFC"),
        (POINT, POINT.replace("#24=", "24="), "the text after #23 .* is 24=IFC"),
        (POINT, POINT.replace("=", "-"), "the text after #23 .* is #24-IFC"),
    ],
)  # fmt: skip
def test_attribute_that_is_not_read_as_written_is_refused(old: str, new: str, words: str) -> None:
    assert_rejected(column_with(old, new), words)


@pytest.mark.parametrize(
    "instances",
    [
        "#900=IFCDOOR('x',c5,#99999,nan,$,$,$,$,$,$);",
        "#900=IFCCARTESIANPOINT((nan));\n#901=IFCLOCALPLACEMENT(c1,#900);",
        "#900=IFCDOORSTANDARDCASE('x',$,$,$,$,$,$,$,$,$,$,$,$);\n#901=IFCOFFSETCURVEBYDISTANCES(#24,(#1),$);",
        "#900=IFCPROPERTYSINGLEVALUE('a;b''#1',$,IFCLABEL('/* c'),$); /* 'comment'; */",
        "/* #900=IFCREINFORCINGBAR(); */\r\n #901 =\n ifcWall ( 'x',$,$,$,$,$,$,$,$ ) ;",
    ],
)
def test_damage_and_unknown_classes_beside_the_bars_are_accepted(instances: str, sound: list[Bar]) -> None:
    assert bars_of(column_with("DATA;", f"DATA;\n{instances}")) == sound


def test_other_spellings_of_the_same_values_are_accepted(sound: list[Bar]) -> None:
    text = column_with(POINT, "#24 = IfcCartesianPoint ( ( -4.60E+001 , /* y */ -46,\n +0.10 ) ) ;")
    text = text.replace("(0.,0.,0.)", "(-.0,0,0.E0)").replace("#26,4.,", "#26,+.4e1,")
    text = text.replace("'Upright 2'", r"'\X2\00FC\X0\'")
    assert bars_of(text) == sound


def test_last_attribute_of_another_version_of_ifc_is_accepted() -> None:
    short, long = "(500.,100.,0.)))", "(500.,100.,0.)),$)"
    for schema, end, other in (("IFC4", short, long), ("IFC4X3_ADD2", long, short)):
        ifc = Ifc(schema)
        points = ifc.new("IfcCartesianPointList3D", [(0.0, 100.0, 0.0), (500.0, 100.0, 0.0)])
        ifc.bar(ifc.disc(ifc.new("IfcIndexedPolyCurve", points)))
        text = ifc.file.to_string()
        assert end in text
        [bar] = bars_of(text.replace(end, other))
        assert bar.axis_m == ((0.0, 0.1, 0.0), (0.5, 0.1, 0.0))


def test_nulls_that_ifc2x3_forbids_and_two_dimensional_points_are_accepted() -> None:
    ifc = Ifc("IFC2X3")
    ifc.bar(ifc.disc(ifc.polyline((0, 0), (500, 100))), Name="Foot")
    [cage_bar] = ifc.bars()
    assert cage_bar.bar.role == "Foot"
    np.testing.assert_allclose(cage_bar.bar.axis_m, [(0, 0, 0), (0.5, 0.1, 0)], atol=1e-12)


def test_lost_type_relation_is_refused() -> None:
    ifc = Ifc()
    bar = ifc.bar(ifc.disc(ifc.polyline((0, 0, 0), (500, 0, 0))))
    kind = ifc.rooted("IfcReinforcingBarType", PredefinedType="SHEAR")
    ifc.rooted("IfcRelDefinesByType", RelatedObjects=[bar], RelatingType=kind)
    assert ifc.bars()[0].bar.role == "shear"
    text = ifc.file.to_string()
    unread = text.replace(f"(#{bar.id()})", f"(c{bar.id()})")
    assert_rejected(unread, "expected 6 readable attributes of IfcRelDefinesByType")
    assert_rejected(text.replace(".SHEAR.", ".SHEAX."), "PredefinedType is .SHEAX., which cannot be read")


@pytest.mark.slow
def test_damaged_instances_of_tessellated_objects_are_refused() -> None:
    ifc = Ifc()
    ifc.bar(extruded_square(ifc), at=ifc.at((100, 200, 300)))
    text = ifc.file.to_string()
    for old, new, words in [
        ("((100.,200.,300.))", "((100.,200.,nan))", "IfcReinforcingBar .*expected . readable"),
        ("((100.,200.,300.))", "((100.,200.))", "points of 2 and 3 coordinates|points of 2 coordinates"),
        ("((0.,0.,1.))", "((0.,0.,c1))", "IfcReinforcingBar .*expected . readable"),
        ("((0.,0.,1.))", "((1.,0.))", "IfcExtrudedAreaSolid.* refers to points of 2 and 3 coordinates"),
        ("IFCRECTANGLEPROFILEDEF(.AREA.,$,#", "IFCRECTANGLEPROFILEDEF(.AREA.,$,c", "expected . readable"),
    ]:
        assert old in text
        assert_rejected(text.replace(old, new), words)


@pytest.mark.slow
def test_exponential_maps_and_placement_cycles_are_refused() -> None:
    ifc = Ifc()
    origin = ifc.axes((0, 0, 0))
    identity = ifc.new("IfcCartesianTransformationOperator3D", LocalOrigin=ifc.point((0, 0, 0)))
    item = ifc.mapped(identity, origin, ifc.disc(ifc.polyline((0, 0, 0), (500, 0, 0))))
    for _ in range(40):  # Each map contains the previous one twice: 2^40 bars.
        item = ifc.mapped(identity, origin, item, item)
    ifc.bar(item)
    assert_rejected(ifc.file.to_string(), "more than 10000 items")
    ifc = Ifc()
    placement = ifc.at((0, 0, 0))
    placement.PlacementRelTo = placement
    ifc.bar(ifc.disc(ifc.polyline((0, 0, 0), (500, 0, 0))), at=placement)
    assert_rejected(ifc.file.to_string(), "is circular")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (".MILLI.", ".KILO.", "IfcReinforcingBar .* diameter is 8000 m, expected .* is the unit right"),
        ("(-46.,-46.,0.1)", "(-46.,-46.,1.E9)", "bar 1, .* extends 1e.06 m from the world's origin"),
    ],
)
def test_implausible_dimensions_are_rejected(old: str, new: str, words: str) -> None:
    with pytest.raises(MeshError, match=words):
        assembly_of(bars_in_process(column_with(old, new).encode()), "a.ifc")
