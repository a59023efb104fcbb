"""Validation of users' scene files: all problems are reported at once, and no value is guessed."""

from __future__ import annotations

import re
import shutil
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.catalog.named_configs import CONFIGS, BuildRequest
from dataset_builder.catalog.scene_file import scene_name_of
from dataset_builder.specs.config_specs import DomeSpec, FormSpec, SurveySpec
from dataset_builder.user_files import scene_schema
from dataset_builder.user_files.cage_file import cage_file_spec, load_cage
from dataset_builder.user_files.rig_file import RigTable
from dataset_builder.user_files.scene_schema import read_scene_toml
from rebar_depth_bench.base.errors import InputError, MeshError
from tests.builder.catalog.scene_files import BAR, MM, scene_config, write_scene

ROW = "count = 3\nstep = [0, 50, 0]\n"
SURVEY = "[cameras]\nkind = 'survey'\n"
RING = "[cameras]\nkind = 'ring'\n"
DOME = "[cameras]\nkind = 'dome'\n"
SELECT = "ifc = 'a.ifc'\n[[select]]\n"
RING_RADIUS_AND_ELEVATION = "missing cameras.radius, missing cameras.elevation_deg"
INVALID_SCENES = [
    ("", "missing unit, missing"),
    (BAR, "missing unit"),
    ('unit = "yard"\n' + BAR, "invalid unit"),
    ("unit = 5\n" + BAR, "invalid unit"),
    (MM + "nmae = 'x'\n" + BAR, "unknown nmae"),
    (MM + "zzz = 1\n" + BAR, "unknown zzz"),
    (MM + "mesh = 'a.stl'\n" + BAR, "conflict"),
    (MM + "mesh = 'a.stl'\nifc = 'b.ifc'", "conflict"),
    (MM + "mesh = 3", "invalid mesh"),
    (MM + "mesh = ''", "invalid mesh"),
    (MM + "trust = 'geometry'\n" + BAR, "conflict trust"),
    ("ifc = 'a.ifc'\ntrust = 'me'\n", "invalid trust"),
    (MM + BAR + "[[select]]\nname = 'a'\n", "conflict select"),
    ("ifc = 'a.ifc'\nselect = []\n", "invalid select"),
    ("ifc = 'a.ifc'\nselect = 'a'\n", "invalid select"),
    (SELECT, "missing select 1"),
    (SELECT + "clas = 'a'\n", "unknown select 1: clas"),
    (SELECT + "name = ''\n", "invalid select 1: name"),
    (SELECT + "box = [[0, 0, 0]]\n", "invalid select 1: box"),
    (MM + "mesh = 'a.stl'\n[[select]]\nname = 'a'\nstorey = 'b'\n", "conflict select 1"),
    (MM + "bar = 3", "invalid bar"),
    (MM + "bar = []", "invalid bar"),
    (MM + "bar = [1]", "invalid bar 1"),
    (MM + "[bar]\ndiameter = 10", "invalid bar"),
    (MM + "cameras = 3\n" + BAR, "invalid cameras"),
    (MM + "[[bar]]\n", "missing bar 1: diameter, missing bar 1: points"),
    (MM + BAR + "id = 5\n" + BAR + "id = 5\n", "duplicate bar 2: id"),
    (MM + BAR + "id = 5\n" + BAR + ROW + "id = 3\n", "duplicate bar 2: id"),
    (MM + (BAR + ROW.replace("3", "40000")) * 2, "conflict bar 2"),
    ("unit = ", "syntax"),
    ("x = " + "[" * 5000, "size"),
    ("x = " + "9" * 5000, "syntax"),
    ("a = 1\na = 2\n", "syntax"),
    ("\x00", "syntax"),
]
INVALID_KEYS = [
    ("name = 'My Beam'", "invalid name"),
    ("name = 'lattice-dusk'", "invalid name"),
    ("name = 'lattice'", "conflict name"),
    ("name = 'meshes'", "conflict name"),
    ("name = 'crossings'", "conflict name"),
    ("name = 'scenes'", "conflict name"),
    ("name = '../x'", "invalid name"),
    ("name = ''", "invalid name"),
    (f"name = '{'a' * 64}'", "invalid name"),
    ("name = true", "invalid name"),
    ("up = 'x'", "invalid up"),
    ("origin = 'center'", "invalid origin"),
    ("rotate_deg = 361", "invalid rotate_deg"),
    ("translate = [1, 2]", "invalid translate"),
    ("translate = [1, 2, nan]", "invalid translate"),
    ("environment = 'moon'", "invalid environment"),
    ("board = true", "invalid board"),
    ("board = 7", "invalid board"),
    ("board = 6.0", "invalid board"),
    ("rig = 'Stereolabs ZED'", "invalid rig"),
]
INVALID_CAMERAS = [
    ("[cameras]\n", "missing cameras.kind"),
    ("[cameras]\nkind = 'x'\n", "invalid cameras.kind"),
    ("[cameras]\nkind = ['survey']\n", "invalid cameras.kind"),
    (SURVEY + "azimuths = 3\n", "unknown cameras.azimuths"),
    (SURVEY + "distances = []\n", "invalid cameras.distances"),
    (SURVEY + "distances = 500\n", "invalid cameras.distances"),
    (SURVEY + "distances = [500, 0]\n", "invalid cameras.distances 2"),
    (SURVEY + "views_per_distance = 0\n", "invalid cameras.views_per_distance"),
    (
        SURVEY + "views_per_distance = 2.0\nseed = -1\n",
        "invalid cameras.views_per_distance, invalid cameras.seed",
    ),
    (SURVEY + "views_per_distance = 2501\n", "conflict cameras"),
    (SURVEY + f"distances = {[500] * 80}\n", "conflict cameras"),
    (SURVEY + "views_per_distance = 10001\n", "invalid cameras.views_per_distance"),
    (SURVEY + "stations = []\n", "unknown cameras.stations"),
    (RING, f"missing cameras.azimuths, {RING_RADIUS_AND_ELEVATION}"),
    (RING + "radii = [1]\n", f"missing cameras.azimuths, {RING_RADIUS_AND_ELEVATION}, unknown cameras.radii"),
    (RING + "azimuths = 2.5\n", f"invalid cameras.azimuths, {RING_RADIUS_AND_ELEVATION}"),
    (RING + "azimuths = true\n", f"invalid cameras.azimuths, {RING_RADIUS_AND_ELEVATION}"),
    (DOME + "radii = []\nelevations_deg = [9]\nazimuths = 3\n", "invalid cameras.radii"),
    (
        DOME + "radii = [400, -1]\n",
        "missing cameras.azimuths, invalid cameras.radii 2, missing cameras.elevations_deg",
    ),
    (DOME + "radii = [400]\nelevations_deg = [90]\nazimuths = 3\n", "invalid cameras.elevations_deg 1"),
    (DOME + "radii = [400, 500]\nelevations_deg = [5, 9]\nazimuths = 3600\n", "conflict cameras"),
]
INVALID_BAR_KEYS = [
    ("dia = 3", "unknown bar 1: dia"),
    ("ribs = 1", "invalid bar 1: ribs"),
    ("id = 0", "invalid bar 1: id"),
    ("id = 65536", "invalid bar 1: id"),
    (f"id = 0x{'f' * 6000}", "invalid bar 1: id"),
    ("role = ''", "invalid bar 1: role"),
    ('role = "a\\nb"', "invalid bar 1: role"),
    (f"role = '{'x' * 61}'", "invalid bar 1: role"),
    ("bend_diameter = 9", "conflict bar 1: bend_diameter"),
    ("bend_diameter = -4", "invalid bar 1: bend_diameter"),
    ("count = 0\nstep = [0, 50, 0]", "invalid bar 1: count"),
    ("count = 2.0\nstep = [0, 50, 0]", "invalid bar 1: count"),
    ("count = 65536\nstep = [0, 50, 0]", "invalid bar 1: count"),
    ("count = 2", "missing bar 1: step"),
    ("step = [0, 50, 0]", "missing bar 1: count"),
    ("count = 2\nstep = [0, 0, 0]", "invalid bar 1: step"),
    ("count = 2\nstep = [0, 50]", "invalid bar 1: step"),
    ("count = 2\nstep = [0, 50, 0]\nid = 65535", "conflict bar 1: id"),
]
MANY_CONFLICTS = (
    f"{MM}name = 'pile'\nmesh = 'a.stl'\nboard = 7\n" + (BAR + "id = 5\nbend_diameter = 9\nrips = 1\n") * 2
    + DOME + "radii = [400, 50]\nelevations_deg = [5, 90]\nazimuths = 3600\nfoo = 1\n",
    "conflict, duplicate bar 2: id, invalid cameras.elevations_deg 2, "
    "unknown cameras.foo, conflict name, conflict bar 1: bend_diameter, unknown bar 1: rips, "
    "conflict bar 2: bend_diameter, unknown bar 2: rips, invalid board",
)  # fmt: skip
FORM = "[[form]]\npoint = [0, 0, 30]\nnormal = [0, 0, 1]\nsize = [300, 300]\n"
INVALID_FORMS = [
    ("[[form]]\n", "missing form 1: point, missing form 1: normal, missing form 1: size"),
    (FORM + "thickness = 18\n", "unknown form 1: thickness"),
    (FORM.replace("[0, 0, 1]", "[0, 0, 0]"), "invalid form 1: normal"),
    (FORM.replace("[0, 0, 1]", "[0, 0, 1, 0]"), "invalid form 1: normal"),
    (FORM.replace("300]", "9]"), "invalid form 1: size"),
    (FORM + "along = [0, 0, -2]\n", "conflict form 1: along"),
    (FORM + "name = 'deck'\n", "invalid form 1: name"),
    (FORM + "name = 'form-2'\n" + FORM, "duplicate form"),
    ("form = 3\n", "invalid form"),
]
INVALID_DIAMETERS = ("0", "nan", "inf", "'10'", "true", "1" + "0" * 400, "2020-01-01")
INVALID_POINTS = ("[100, 0]", "[100, 0, nan]", "[100, 0, '5']", "7", "[1e300, 0, 5]")
INVALID_SCENES += [MANY_CONFLICTS]
INVALID_SCENES += [(f"{MM}{key}\n{BAR}", problems) for key, problems in INVALID_KEYS]
INVALID_SCENES += [(MM + BAR + table, problems) for table, problems in INVALID_CAMERAS]
INVALID_SCENES += [(MM + forms + BAR, problems) for forms, problems in INVALID_FORMS]
INVALID_SCENES += [(MM + "board = 6\n" + BAR + FORM, "conflict board")]
INVALID_SCENES += [(f"{MM}{BAR}{key}\n", problems) for key, problems in INVALID_BAR_KEYS]
INVALID_SCENES += [
    (MM + BAR.replace("= 10", f"= {text}"), "invalid bar 1: diameter") for text in INVALID_DIAMETERS
]
INVALID_SCENES += [(MM + BAR.replace("[100, 0, 50]", text), "invalid bar 1: points 2") for text in INVALID_POINTS]
INVALID_SCENES += [(MM + BAR.replace(", [100, 0, 50]", ""), "invalid bar 1: points")]


def codes_and_places(error: InputError) -> list[str]:
    return [f"{problem.code} {problem.where}".strip() for problem in error.problems]


@pytest.mark.parametrize(("content", "problems"), INVALID_SCENES)
def test_invalid_scene_file_is_rejected(tmp_path: Path, content: str, problems: str) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path}/my-beam.toml: [0-9]+ problem") as raised:
        scene_config(write_scene(tmp_path, content))
    assert ", ".join(codes_and_places(raised.value)) == problems


def test_all_problems_are_reported_together(tmp_path: Path) -> None:
    content = "unit = 'mmm'\nfoo = 1\nboard = 7\n" + BAR.replace("= 10", "= -1") + "rips = true\n"
    with pytest.raises(InputError) as raised:
        scene_config(write_scene(tmp_path, content))
    head, *lines = str(raised.value).splitlines()
    assert head == f"{tmp_path}/my-beam.toml: 5 problems"
    assert lines == [f"  - {problem}" for problem in raised.value.problems]
    in_bar = ["invalid bar 1: diameter", "unknown bar 1: rips"]
    assert codes_and_places(raised.value) == ["invalid unit", *in_bar, "invalid board", "unknown foo"]
    with pytest.raises(MeshError) as raised_by_cage:
        load_cage(cage_file_spec(write_scene(tmp_path, content)))
    assert raised_by_cage.value.problems == raised.value.problems
    with pytest.raises(InputError, match=r"40 problems(.|\n)*and 20 more"):
        scene_config(write_scene(tmp_path, MM + "[[bar]]\n" * 20))


def test_documented_example_is_valid() -> None:
    example = (scene_schema.__doc__ or "").split("```")[1].removeprefix("toml")
    scene = read_scene_toml(example.encode(), "example")
    assert (scene.name, scene.board, scene.rig) == ("my-beam", 6, RigTable(camera="Intel RealSense D455"))
    assert scene.cameras == DomeSpec((0.3, 0.4), (15.0, 45.0), 12)
    corners_m = ((-0.15, 0.0, 0.005), (0.15, 0.0, 0.005), (0.15, 0.0, 0.08))
    [bar] = scene.bar
    assert (bar.count, bar.step_m) == (4, (0.0, 0.05, 0.0))
    assert (bar.bar_id, bar.role, bar.diameter_m, bar.mandrel_m, bar.ribs) == (7, "main", 0.01, 0.04, True)
    assert bar.corners_m == corners_m
    example = (scene_schema.__doc__ or "").split("```")[5].removeprefix("toml")
    assert read_scene_toml((MM + BAR + example).encode(), "example").forms == (
        FormSpec("side", (0.0, 0.06, 0.1), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.5, 0.2)),
    )


def test_survey_has_defaults_in_metres_and_distances_in_the_unit() -> None:
    for unit, keys, expected in (
        ("mm", "", SurveySpec((0.5, 0.75, 1.0, 1.5), 126, 0)),
        ("ft", "", SurveySpec()),
        ("ft", "distances = [5, 10]\n", SurveySpec((1.524, 3.048))),
        ("mm", "views_per_distance = 2500\nseed = 7\n", SurveySpec(views_per_distance=2500, seed=7)),
    ):
        content = f'unit = "{unit}"\n{BAR}{SURVEY}{keys}'
        assert read_scene_toml(content.encode(), "a").cameras == expected


BAR_1 = "bar 1 (bar, diameter 0.01 m)"


@pytest.mark.parametrize(
    ("content", "problem", "words"),
    [
        (BAR.replace("[100, 0, 50]", "[-100, 0, 50]"), f"invalid {BAR_1}", "none repeated in a row"),
        (BAR.replace("50]]", "50], [100, 0, 60]]"), f"invalid {BAR_1}", "leg 2 is 0.0100 m .* need 0.0250 m"),
        (BAR.replace("50]]", "50], [0, 0, 50]]"), f"invalid {BAR_1}", "turns straight back on itself"),
        (BAR.replace("= 10", "= 1000"), "invalid bar 1 (bar, diameter 1 m)", "diameter is 1 m"),
        (BAR.replace("= 10", "= 0.0001"), "invalid bar 1 (bar, diameter 1e-07 m)", "diameter is 1e-07 m"),
        (BAR.replace("100", "1e6"), f"invalid {BAR_1}", "extends 1000 m"),
        (BAR + BAR.replace("10\n", "12\n"), "duplicate bar 2 (bar, diameter 0.012 m)", "same axis as bar 1"),
        ("[[bar]]\ndiameter = 1\npoints = [[0, 0, 5], [0.5, 0, 5]]\n", "invalid", "cage is 0.0005 m long"),
    ],
)
def test_impossible_bar_geometry_is_rejected(tmp_path: Path, content: str, problem: str, words: str) -> None:
    with pytest.raises(MeshError, match=f"^{tmp_path}/my-beam.toml: 1 problem(.|\n)*{words}") as raised:
        scene_config(write_scene(tmp_path, MM + content))
    assert codes_and_places(raised.value) == [problem]


def test_steel_below_board_or_around_cameras_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"extends down to z = -0\.0"):
        scene_config(write_scene(tmp_path, MM + BAR.replace("50]", "-50]")))
    near = '[cameras]\nkind = "ring"\nradius = 130\nelevation_deg = 35\nazimuths = 20\n'
    with pytest.raises(MeshError, match=r"extends 0\.2\d* m from its centre, expected less than 0\.13 m"):
        scene_config(write_scene(tmp_path, MM + BAR.replace("100", "200") + near))


def test_unreadable_or_misnamed_files_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unsupported scene file type '.yaml'"):
        scene_config(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="cannot be read: No such file"):
        scene_config(tmp_path / "a.toml")
    with pytest.raises(InputError) as raised:
        scene_config(write_scene(tmp_path, b"\xff\xfe"))
    assert codes_and_places(raised.value) == ["syntax"]
    with pytest.raises(MeshError, match=r"my-beam.toml: ifc: .*gone.ifc: 1 problem\n  - cannot be read"):
        scene_config(write_scene(tmp_path, 'ifc = "gone.ifc"'))
    assert scene_config(write_scene(tmp_path, "\ufeff" + (MM + BAR).replace("\n", "\r\n"))).name == "my-beam"


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("IfcReinforcingBar.ifc", "ifcreinforcingbar"),
        ("My Beam.toml", "my-beam"),
        ("(Rev. 3) Säule_B25.0  neu!.ifc", "rev-3-saule-b25-0-neu"),
        ("Stra\u00dfe \u2116 1.IFC", "strasse-no-1"),
        ("bewehrung.v2.toml", "bewehrung-v2"),
        ("\u9244\u7b4b.ifc", ""),
        ("\u9244\u7b4b 7.ifc", "7"),
    ],
)
def test_scene_names_come_from_file_names(file: str, name: str) -> None:
    assert scene_name_of(Path(file)) == name
    assert scene_name_of(Path(unicodedata.normalize("NFD", file))) == name


@settings(max_examples=50)
@given(st.text(min_size=1))
def test_derived_scene_names_are_valid_or_refused(stem: str) -> None:
    name = scene_name_of(Path("folder", f"a{stem.replace('/', '')}.ifc"))
    assert re.fullmatch("[a-z0-9]+(-[a-z0-9]+)*", name)
    assert scene_name_of(Path(f"{name}.ifc")) == name


def test_file_names_without_a_scene_name_are_refused(tmp_path: Path) -> None:
    for file, name in (
        ("\u9244\u7b4b.toml", ""),
        ("Lattice Orbit.toml", "lattice-orbit"),
        (f"{next(iter(CONFIGS))}.toml", next(iter(CONFIGS))),
        (f"{'x' * 64}.toml", "x" * 64),
        ("Beam Dusk.toml", "beam-dusk"),
    ):
        with pytest.raises(InputError, match=f"would be named '{name}', expected a name.*rename the file"):
            scene_config(write_scene(tmp_path, MM + BAR, file))


@pytest.mark.slow
def test_ifc_file_may_have_a_name_that_a_scene_file_cannot_name(tmp_path: Path) -> None:
    """A path in a scene file must not begin with a tilde, but an IFC file that is the scene itself may."""
    path = tmp_path / "~x.ifc"
    shutil.copy("examples/column.ifc", path)
    assert scene_config(path).name == "x"


def test_files_that_give_the_same_scene_name_are_refused(tmp_path: Path) -> None:
    files = [write_scene(tmp_path, MM + BAR, name) for name in ("My Beam.toml", "my_beam.toml")]
    scenes = tuple(map(scene_config, files))
    assert scenes[0].name == "my-beam"
    with pytest.raises(InputError, match="more than one config is named my-beam"):
        BuildRequest(configs=(), scenes=scenes).config_specs()
