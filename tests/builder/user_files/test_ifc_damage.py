"""Damaged IFC models: an error that names the instance, instead of wrong bars."""

from __future__ import annotations

import re
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.user_files.cage_file import cage_file_spec, mesh_file_spec
from rebar_depth_bench.base.errors import MeshError
from rebar_depth_bench.data.bars import Bar
from tests.builder.scene.cages import assembly_of
from tests.builder.user_files.ifc_writer import COLUMN, Ifc, bars_in_process, column_with, extruded_square


def assert_rejected(content: str, words: str) -> None:
    with pytest.raises(MeshError, match=f"^a.ifc: .*{words}"):
        bars_in_process(content.encode())


def bars_of(content: str) -> list[Bar]:
    return [cage_bar.bar for cage_bar in bars_in_process(content.encode())]


@pytest.fixture(scope="module")
def sound() -> list[Bar]:
    return bars_of(COLUMN.read_text())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "does not begin with ISO-10303-21"),
        ("solid cage", "does not begin with ISO-10303-21"),
        (COLUMN.read_text()[:5000], "does not end with END-ISO-10303-21.*truncated"),
        (column_with("'IFC4'", "'IFC9'"), "not a readable IFC file"),
        (column_with("FILE_SCHEMA", "FILE_SCHEMB"), "not a readable IFC file .*FILE_SCHEMA"),
        (column_with("DATA;", "DATB;"), "instances are written, but 152 different ones can be read"),
        (column_with("IFCLOCALPLACEMENT(", "IFCLOCALPLAZEMENT("), "'IFCLOCALPLAZEMENT' not found"),
        (column_with("#31=", "#9031="), "Instance reference #31 used by instance #33 .* not found"),
        (column_with("#152=", "#151="), "152 instances are written, but 151 different ones can be read"),
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
LINE, DISC, PLACE = "#26=IFCPOLYLINE((#24,#25))", "#26,4.,$,$,$)", "#135=IFCLOCALPLACEMENT(#19,#134)"
NOT_ALL = "not all of it can be read: "


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # The parser turns each of these into null or leaves it out, and says so; the stirrup was moved by 100 mm.
        ("$,$,#135,#136", "$,$,c135,#136", f"{NOT_ALL}Entity with name 'c135' not found"),
        (PLACE, "#135=IFCLOCALPLACEMENT(#99999,#134)", f"{NOT_ALL}Instance reference #99999 used by"),
        (LINE, "#26=IFCPOLYLINE((#24,c25))", f"{NOT_ALL}Entity with name 'c25' not found"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,1.E999));", f"{NOT_ALL}token 1.E999"),
        (".MAIN.", ".MAIX.", f"{NOT_ALL}An enumeration literal 'MAIX' is not valid"),
        ("'Upright 1'", "'Upright 1", NOT_ALL),
        (POINT, POINT.replace("#24=", "24="), f"{NOT_ALL}Instance reference #24 used by instance #26"),
        # It warns of another number of attributes.
        (PLACE, "#135=IFCLOCALPLACEMENT(#19)", "#135 .* has another number of attributes, expected 2"),
        (DISC, "#26,4.)", "#27 .* has another number of attributes, expected 5"),
        # It says nothing of the others.
        (PLACE, "#135=IFCLOCALPLACEMENT(19,#134)", "#135 .*PlacementRelTo is 19, expected"),
        (PLACE, "#135=IFCLOCALPLACEMENT(#18,#134)", "#135 .*PlacementRelTo is #18=.*, expected"),
        (LINE, "#26=IFCPOLYLINE(#24)", "#26 .*Points is #24=.*, expected <list"),
        (LINE, "#26=IFCPOLYLINE((#24))", "#26 .*Points is .*, expected <list .2"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.));", "#26 .*points of 1 or 3 coordinates, expected 2 or 3"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,0,1));", "#26 .*points of 3 or 4 coordinates, expected 2 or 3"),
        (POINT, "#24=IFCCARTESIANPOINT($);", "#24 .*Coordinates is null"),
        ("#133=IFCCARTESIANPOINT((0.,0.,100.))", "#133=IFCCARTESIANPOINT((0.,0.))", "#134 .*points of 2 .*3$"),
        (DISC, "#26,'4',$,$,$)", "#27 .*Radius is 4, expected"),
        (DISC, "#26,0.,$,$,$)", "#33.* a circle has the radius 0, expected above 0"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,,0.1));", "#24=.* has ,,, expected values"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,));", r"#24=.* has ,\), expected values"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-4 6.,0.1));", "#24=.* has  6, expected values"),
        (POINT, "#24=IFCCARTESIANPOINT((-46.,-46.,0.1=));", "152 instances are written"),
        (POINT, POINT[:-1], "151 instances are written, but 152 different ones can be read"),
        (DISC, "#26,4.,$,$5.,$)", r"#27=.* has \$5, expected values"),
        (LINE, "#26=IFCPOLYLINE((#24,$,#25))", "#26=.* expected values"),
        (LINE, "#26=IFCPOLYLINE(((),#24,#25))", "#26=.* expected values"),
    ],
)  # fmt: skip
def test_instance_that_is_not_read_as_written_is_refused(old: str, new: str, words: str) -> None:
    assert_rejected(column_with(old, new), words)


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["#99999", "c{}", "{}", ""])
def test_damaged_reference_moves_no_bar(damage: str, sound: list[Bar]) -> None:
    text = COLUMN.read_text()
    for reference in list(re.finditer(r"(?<=[(,])#(\d+)", text))[::9]:
        content = text[: reference.start()] + damage.format(reference[1]) + text[reference.end() :]
        with suppress(MeshError):
            assert bars_of(content) == sound, reference


@pytest.mark.parametrize("missing", ["origin", "direction"])
def test_line_of_points_and_directions_of_other_dimensions_is_refused(missing: str) -> None:
    ifc = Ifc()
    vector = ifc.new("IfcVector", ifc.direction((1, 0) if missing == "direction" else (1, 0, 0)), 1.0)
    line = ifc.new("IfcLine", ifc.point((5, 5) if missing == "origin" else (5, 5, 100)), vector)
    ifc.bar(ifc.new("IfcSweptDiskSolid", line, 8.0, None, 0.0, 500.0))
    assert_rejected(ifc.file.to_string(), "a curve has points of 2 and of 3 coordinates")


@pytest.mark.parametrize(
    "instances",
    [
        "#900=IFCDOORSTANDARDCASE('x',$,$,$,$,$,$,$,$,$,$,$,$);\n#901=IFCLOCALPLACEMENT(#18);",
        "#900=IFCPROPERTYSINGLEVALUE('a;b''#1',$,IFCLABEL('/* c'),$); /* 'comment'; */",
        "/* #900=IFCREINFORCINGBAR(); */\r\n #901 =\n ifcWall ( 'x',$,$,$,$,$,$,$,$ ) ;",
    ],
)
def test_comments_and_other_numbers_of_attributes_beside_the_bars_are_accepted(
    instances: str, sound: list[Bar]
) -> None:
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
    relation = f"(#{bar.id()}),#{kind.id()}"
    assert relation in text
    assert_rejected(
        text.replace(relation, relation.replace("(", "").replace(")", "")),
        r"IfcRelDefinesByType.*RelatedObjects is \[",
    )


@pytest.mark.slow
def test_damaged_instances_of_tessellated_objects_are_refused() -> None:
    ifc = Ifc()
    ifc.bar(extruded_square(ifc), at=ifc.at((100, 200, 300)))
    text = ifc.file.to_string()
    for old, new, words in [
        ("((100.,200.,300.))", "((100.,200.,nan))", NOT_ALL),
        ("((100.,200.,300.))", "((100.,200.))", "points of 2 coordinates"),
        ("((0.,0.,1.))", "((1.,0.))", "IfcExtrudedAreaSolid.* refers to points of 2 coordinates"),
        (
            "IFCRECTANGLEPROFILEDEF(.AREA.,$,#",
            "IFCRECTANGLEPROFILEDEF(.AREA.,$,",
            "IfcReinforcingBar .*Position is ",
        ),
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
