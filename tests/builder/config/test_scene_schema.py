"""Validation of users' scene files: all problems are reported at once, and no value is guessed."""

from __future__ import annotations

from pathlib import Path

import pytest

from dataset_builder.config.catalog import CONFIGS
from dataset_builder.config.scene_file import scene_config
from rebar_depth_bench.errors import InputError, MeshError
from tests.builder.config.scene_files import BAR, MM, write_scene

INVALID_SCENES = [
    ("", "unit is missing.*found none of them, expected exactly one of"),
    (BAR, r'unit is missing, expected "m", "cm", "mm", "in" or "ft"'),
    ('unit = "yard"\n' + BAR, "unit: got 'yard', expected"),
    ("unit = 5\n" + BAR, "unit: got 5, expected"),
    (MM + "nmae = 'x'\n" + BAR, "'nmae' is not a known key, did you mean name"),
    (MM + "zzz = 1\n" + BAR, "'zzz' is not a known key, expected only name, unit, bar"),
    (MM + "name = 'My Beam'\n" + BAR, "name: got 'My Beam', expected a name of lower-case letters"),
    (MM + "name = 'lattice-dusk'\n" + BAR, "name: got 'lattice-dusk', .* does not end in a variant's name"),
    (MM + "name = 'lattice'\n" + BAR, "name: got 'lattice', .* is not one of .*lattice"),
    (MM + "name = 'meshes'\n" + BAR, "name: got 'meshes'"),
    (MM + "name = 'scenes'\n" + BAR, "name: got 'scenes'"),
    (MM + "name = '../x'\n" + BAR, "name: got '../x'"),
    (MM + "name = ''\n" + BAR, "name: got ''"),
    (MM + "name = '" + "a" * 64 + "'\n" + BAR, "name: got 'aaa"),
    (MM + "name = true\n" + BAR, "name: got True"),
    (MM + "mesh = 'a.stl'\n" + BAR, "found bar and mesh, expected exactly one"),
    (MM + "mesh = 'a.stl'\nifc = 'b.ifc'", "found mesh and ifc, expected exactly one"),
    (MM + "mesh = 3", "mesh: got 3, expected a path"),
    (MM + "mesh = ''", "mesh: got '', expected a path"),
    (MM + "bar = 3", r"bar: got 3, expected 1 to 65535 tables, each under \[\[bar\]\]"),
    (MM + "bar = []", "bar: got a list of 0, expected"),
    (MM + "bar = [1]", "bar: bar 1: got 1, expected"),
    (MM + "[bar]\ndiameter = 10", "bar: got {'diameter': 10}, expected"),
    (MM + "environment = 'moon'\n" + BAR, 'environment: got \'moon\', expected "laboratory" or "outdoors"'),
    (MM + "board = true\n" + BAR, "board: got True, expected 6, 12 or false"),
    (MM + "board = 7\n" + BAR, "board: got 7"),
    (MM + "board = 6.0\n" + BAR, r"board: got 6\.0"),
    (MM + "cameras = 3\n" + BAR, "cameras: got 3, expected a table"),
    (MM + BAR + "[cameras]\n", 'cameras.kind is missing, expected "dome" or "ring"'),
    (MM + BAR + "[cameras]\nkind = 'x'\n", "cameras.kind: got 'x'"),
    (
        MM + BAR + "[cameras]\nkind = 'ring'\n",
        "3 problems.*cameras.radius is missing.*cameras.azimuths is missing",
    ),
    (
        MM + BAR + "[cameras]\nkind = 'ring'\nradii = [1]\n",
        "cameras.'radii' is not a known key, did you mean radius",
    ),
    (MM + BAR + "[cameras]\nkind = 'dome'\nradii = []\n", "cameras.radii: got a list of 0, expected"),
    (MM + BAR + "[cameras]\nkind = 'dome'\nradii = [400, -1]\n", "cameras.radii: radius 2: got -1, expected"),
    (
        MM + BAR + "[cameras]\nkind = 'dome'\nelevations_deg = [90]\n",
        "elevations_deg: elevation 1: got 90, expected",
    ),
    (
        MM + BAR + "[cameras]\nkind = 'ring'\nazimuths = 2.5\n",
        r"cameras.azimuths: got 2\.5, expected a whole number",
    ),
    (MM + BAR + "[cameras]\nkind = 'ring'\nazimuths = true\n", "cameras.azimuths: got True"),
    (
        MM + BAR + "[cameras]\nkind = 'ring'\nradius = 50\nelevation_deg = 9\nazimuths = 3\n",
        r"nearest cameras are 0\.05 m from the aim point, expected at least the rig's baseline, 0\.12 m",
    ),
    (
        MM + BAR + "[cameras]\nkind = 'dome'\nradii = [400, 500]\nelevations_deg = [5, 9]\nazimuths = 3600\n",
        "cameras: 14400 views requested, expected at most 10000",
    ),
    (MM + "[[bar]]\n", r"\[\[bar\]\] 1: diameter is missing, expected a length above 0.*1: points is missing"),
    (MM + BAR + "dia = 3\n", r"\[\[bar\]\] 1: 'dia' is not a known key"),
    (MM + BAR + "ribs = 1\n", "ribs: got 1, expected true or false"),
    (MM + BAR + "id = 0\n", "id: got 0, expected a whole number from 1 to 65535"),
    (MM + BAR + "id = 65536\n", "id: got 65536"),
    (
        MM + BAR + "id = 5\n" + BAR + "id = 5\n",
        r"\[\[bar\]\] 2: id 5 is already used by \[\[bar\]\] 1, expected a unique id",
    ),
    (MM + BAR + "role = ''\n", "role: got '', expected a name of up to 60"),
    (MM + BAR + 'role = "a\\nb"\n', r"role: got 'a\\nb'"),
    (MM + BAR + "role = '" + "x" * 61 + "'\n", "role: got 'xxx"),
    (MM + BAR + "bend_diameter = 9\n", "bend_diameter: got 9, expected at least the bar's diameter, 10"),
    (MM + BAR + "bend_diameter = -4\n", "bend_diameter: got -4, expected a length above 0"),
    (MM + BAR.replace("= 10", "= 0"), "diameter: got 0, expected a length above 0"),
    (MM + BAR.replace("= 10", "= nan"), "diameter: got nan"),
    (MM + BAR.replace("= 10", "= inf"), "diameter: got a number with a magnitude above"),
    (MM + BAR.replace("= 10", "= '10'"), "diameter: got '10'"),
    (MM + BAR.replace("= 10", "= true"), "diameter: got True"),
    (MM + BAR.replace("= 10", "= 1" + "0" * 400), "diameter: got a number with a magnitude above"),
    (MM + BAR.replace("= 10", "= 2020-01-01"), "diameter: got datetime.date"),
    (
        MM + BAR.replace("[100, 0, 50]", "[100, 0]"),
        r"points: point 2: got \[100, 0\], expected two or more points",
    ),
    (MM + BAR.replace("[100, 0, 50]", "[100, 0, nan]"), r"points: point 2: got \[100, 0, nan\]"),
    (MM + BAR.replace("[100, 0, 50]", "[100, 0, '5']"), "points: point 2: got"),
    (MM + BAR.replace("[100, 0, 50]", "7"), "points: point 2: got 7"),
    (MM + BAR.replace("[100, 0, 50]", "[1e300, 0, 5]"), "points: point 2: got a number with a magnitude above"),
    (MM + BAR.replace(", [100, 0, 50]", ""), "points: got a list of 1, expected two or more"),
    ("unit = ", "not a TOML file: Invalid value"),
    ("x = " + "[" * 5000, "not a TOML file"),
    ("x = " + "9" * 5000, "not a TOML file"),
    ("a = 1\na = 2\n", "not a TOML file: Cannot overwrite a value"),
    ("\x00", "not a TOML file"),
]


@pytest.mark.parametrize(("content", "words"), INVALID_SCENES)
def test_invalid_scene_file_is_rejected(tmp_path: Path, content: str, words: str) -> None:
    with pytest.raises(InputError, match=f"(?s)^{tmp_path}/my-beam.toml: .*{words}"):
        scene_config(write_scene(tmp_path, content))


def test_all_problems_are_reported_together(tmp_path: Path) -> None:
    content = "unit = 'mmm'\nfoo = 1\nboard = 7\n" + BAR.replace("= 10", "= -1") + "rips = true\n"
    with pytest.raises(InputError) as raised:
        scene_config(write_scene(tmp_path, content))
    head, *lines = str(raised.value).splitlines()
    assert head == f"{tmp_path}/my-beam.toml: 5 problems"
    assert [line.split()[1] for line in lines] == ["'foo'", "unit:", "board:", "[[bar]]", "[[bar]]"]
    with pytest.raises(InputError, match=r"40 problems(.|\n)*and 20 more"):
        scene_config(write_scene(tmp_path, MM + "[[bar]]\n" * 20))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            BAR.replace("[100, 0, 50]", "[-100, 0, 50]"),
            r"bar 1 \(bar, diameter 0.01 m\): .*none repeated in a row",
        ),
        (
            BAR.replace("50]]", "50], [100, 0, 60]]"),
            "leg 2 is 0.0100 m long, but its bends .* need 0.0250 m, expected a path",
        ),
        (BAR.replace("50]]", "50], [0, 0, 50]]"), "turns straight back on itself"),
        (BAR.replace("= 10", "= 1000"), "diameter is 1 m, expected 0.0005 to 0.2 m: is the unit right"),
        (BAR.replace("= 10", "= 0.0001"), "diameter is 1e-07 m"),
        (BAR.replace("100", "1e6"), "extends 1000 m from the world's origin, expected at most 100 m"),
        (BAR + BAR.replace("10\n", "12\n"), "bar 2 .* has the same axis as bar 1"),
        ("[[bar]]\ndiameter = 1\npoints = [[0, 0, 5], [0.5, 0, 5]]\n", "cage is 0.0005 m long, expected 0.001 to"),
    ],
)
def test_impossible_bar_geometry_is_rejected(tmp_path: Path, content: str, words: str) -> None:
    with pytest.raises(MeshError, match=f"^{tmp_path}/my-beam.toml: .*{words}"):
        scene_config(write_scene(tmp_path, MM + content))


def test_steel_below_board_or_around_cameras_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"extends down to z = -0\.0"):
        scene_config(write_scene(tmp_path, MM + BAR.replace("50]", "-50]")))
    near = '[cameras]\nkind = "ring"\nradius = 130\nelevation_deg = 35\nazimuths = 20\n'
    with pytest.raises(MeshError, match=r"extends 0\.2\d* m from its centre, expected less than 0\.13 m"):
        scene_config(write_scene(tmp_path, MM + BAR.replace("100", "200") + near))


def test_unreadable_or_misnamed_files_are_rejected(tmp_path: Path) -> None:
    for name, words in (
        ("a.yaml", "unsupported scene file type '.yaml'"),
        ("a.toml", "cannot be read: No such file"),
    ):
        with pytest.raises(InputError, match=words):
            scene_config(tmp_path / name)
    with pytest.raises(InputError, match="not UTF-8: byte 0 is invalid"):
        scene_config(write_scene(tmp_path, b"\xff\xfe"))
    with pytest.raises(
        InputError, match=r"would be named 'My Beam', expected a name of lower-case letters.*rename"
    ):
        scene_config(write_scene(tmp_path, MM + BAR, "My Beam.toml"))
    with pytest.raises(MeshError, match=r"gone.ifc: the cage file cannot be read"):
        scene_config(write_scene(tmp_path, 'ifc = "gone.ifc"'))
    assert scene_config(write_scene(tmp_path, "\ufeff" + (MM + BAR).replace("\n", "\r\n"))).name == "my-beam"
    builtin_name = next(iter(CONFIGS))
    with pytest.raises(InputError, match=f"would be named '{builtin_name}'"):
        scene_config(write_scene(tmp_path, MM + BAR, f"{builtin_name}.toml"))
