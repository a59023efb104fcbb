"""The command ``rebar-build inspect``: its table, files and picture, and bars that meet."""

from __future__ import annotations

import json
import math
from contextlib import redirect_stdout
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from dataset_builder.catalog.scene_file import scene_cage
from dataset_builder.cli.main import main
from dataset_builder.inspection import summary as summary_module
from dataset_builder.inspection.picture import _draw_scale_bar, font, inspection_picture
from dataset_builder.inspection.report import inspection_json, print_inspection
from dataset_builder.inspection.summary import CONTACT, CONTACT_M, bar_box_m, inspect_cage, meetings
from dataset_builder.pipeline.plan import MAX_NOTES, print_notes
from dataset_builder.scene.assemblies.bar_meshes import bar_mesh
from dataset_builder.scene.assemblies.cage import Cage, CageBar, LeftOut
from dataset_builder.scene.model import Mesh, Note, axis_of
from dataset_builder.scene.shapes.bending import bent_line_m
from rebar_depth_bench.bar_crossings.axis_segments import TooManyNeighboursError
from rebar_depth_bench.data.bars import Bar
from tests.builder.catalog.scene_files import BAR, MM, write_scene
from tests.builder.user_files.ifc_writer import Ifc
from tests.commands import run_in_process

COLUMN = Path("examples/column.ifc")
KEYS = {"bar_id", "role", "diameter_m", "length_m", "axis", "axis_m", "source", "host", "storey"}


def rods(folder: Path) -> Path:
    """Write a rod of 12 mm and a box, whose axis is unknown, in millimetres."""
    rod = trimesh.creation.cylinder(6, segment=[[0, 0, 100], [500, 0, 100]], sections=24)
    block = trimesh.creation.box((40, 80, 20), trimesh.transformations.translation_matrix((0, 300, 100)))
    trimesh.util.concatenate([rod, block]).export(folder / "Rods.stl")
    return folder / "Rods.stl"


@pytest.mark.slow
def test_json_lists_every_bar(tmp_path: Path) -> None:
    outputs = tmp_path / "a.json", tmp_path / "a.png"
    completed = run_in_process(main, "inspect", COLUMN, "--json", outputs[0], "--picture", outputs[1])
    assert completed.returncode == 0, completed.stderr
    values = json.loads(outputs[0].read_text())
    assert [bar["bar_id"] for bar in values["bars"]] == list(range(1, 14))
    assert all(bar.keys() == KEYS and bar["axis"] == "exact" for bar in values["bars"])
    assert {bar["storey"] for bar in values["bars"]} == {"Ground"}
    assert values["world_from_source"] == np.diag([0.001, 0.001, 0.001, 1]).tolist()
    uprights = [bar for bar in values["bars"] if bar["diameter_m"] == 0.008]
    assert len(uprights) == 8
    np.testing.assert_allclose([bar["length_m"] for bar in uprights], 0.2, atol=1e-3)
    np.testing.assert_allclose([np.ptp(bar["axis_m"], axis=0) for bar in uprights], [[0, 0, 0.2]] * 8, atol=1e-3)
    with Image.open(outputs[1]) as picture:
        assert picture.format == "PNG"
        assert picture.width >= 1600
    mass_kg = sum(math.pi / 4 * bar["diameter_m"] ** 2 * bar["length_m"] * 7850 for bar in values["bars"])
    assert f"{mass_kg:.1f}" in completed.stdout.splitlines()[-10]


def test_mesh_file_has_fitted_and_unknown_axes(tmp_path: Path) -> None:
    completed = run_in_process(main, "inspect", rods(tmp_path), "--mesh-unit", "mm", "--json", "-")
    assert completed.returncode == 0, completed.stderr
    rod, block = json.loads(completed.stdout)["bars"]
    assert (rod["axis"], rod["source"], rod["host"]) == ("fitted", "part 1", None)
    assert rod["diameter_m"] == pytest.approx(0.012, rel=0.01)
    assert rod["length_m"] == pytest.approx(0.5, rel=0.005)
    assert [block[key] for key in ("axis", "axis_m", "diameter_m", "length_m")] == [None] * 4


def test_dash_suppresses_the_table(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, MM + BAR)
    completed = run_in_process(main, "inspect", scene, "--json", "-")
    assert json.loads(completed.stdout)["bars"][0]["source"] == "bar 1"
    assert "steel:" in run_in_process(main, "inspect", scene).stdout


@pytest.mark.slow
def test_problems_are_told_after_everything_else(tmp_path: Path) -> None:
    ifc = Ifc()
    ifc.bar(ifc.disc(ifc.polyline((0, 0, 0), (500, 0, 0)), 8.0), NominalDiameter=32.0)
    ifc.file.write(str(tmp_path / "a.ifc"))
    completed = run_in_process(main, "inspect", tmp_path / "a.ifc", "--json", tmp_path / "a.json")
    assert completed.returncode == 2
    assert "16 mm in the geometry, 32 mm as declared" in completed.stderr
    assert len(json.loads((tmp_path / "a.json").read_text())["problems"]) == 1
    trusting = write_scene(tmp_path, 'ifc = "a.ifc"\ntrust = "geometry"\n')
    assert run_in_process(main, "inspect", trusting).returncode == 0


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.toml", "x", "a.toml"),
        pytest.param("a.ifc", "ISO-10303-21;", "a.ifc", marks=pytest.mark.slow),
        ("a.stl", "solid x", "a.stl"),
        ("a.txt", "", "a.txt"),
        ("a.toml", 'ifc = "missing.ifc"', "missing.ifc"),
    ],
)
def test_unreadable_files_are_refused(tmp_path: Path, name: str, content: str, words: str) -> None:
    (tmp_path / name).write_text(content)
    completed = run_in_process(main, "inspect", tmp_path / name, "--picture", tmp_path / "a.png")
    assert completed.returncode == 2
    assert words in completed.stderr
    assert "Traceback" not in completed.stderr
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize("output", ["scene.toml", "Rods.stl"])
def test_inputs_are_not_overwritten(tmp_path: Path, output: str) -> None:
    rods(tmp_path)
    scene = write_scene(tmp_path, 'mesh = "Rods.stl"\nunit = "mm"\n', "scene.toml")
    before = (tmp_path / output).read_bytes()
    completed = run_in_process(main, "inspect", scene, "--json", tmp_path / output)
    assert completed.returncode == 2
    assert (tmp_path / output).read_bytes() == before


def test_shift_onto_the_ground_is_noted_by_inspect_and_build(tmp_path: Path) -> None:
    """The shift is the difference between the places of a bar that is centred and of one that keeps its place."""
    keys, axes_m, notes = f'mesh = "{rods(tmp_path).name}"\nunit = "mm"\n', [], []
    for origin in ("", 'origin = "keep"\n'):
        scene = write_scene(tmp_path, keys + origin)
        axes_m.append(np.array(scene_cage(scene).bars[0].bar.axis_m))
        inspected = run_in_process(main, "inspect", scene, "--json", "-")
        notes.append(json.loads(inspected.stdout)["notes"])
        build = run_in_process(main, "--out", tmp_path / "root", "--scene", scene, "--dry-run")
        for printed in (inspected.stderr, build.stderr):
            assert [line for line in printed.splitlines() if "moved" in line] == [
                f"note: {one}" for one in notes[-1]
            ]
    x, y, z = np.unique(np.round(axes_m[0] - axes_m[1], 6), axis=0)[0]
    assert z < -0.05
    assert f"x {x:.3f}, y {y:.3f}, z {z:.3f} m" in notes[0][0]
    assert 'origin = "keep"' in notes[0][0]
    assert notes[1] == []


def bars_of(*bars: Bar, **fields: str) -> Cage:
    return Cage(tuple(CageBar(f"bar {bar.bar_id}", bar, source=f"bar {bar.bar_id}", **fields) for bar in bars))  # type: ignore[arg-type]


def printed(cage: Cage) -> str:
    with redirect_stdout(StringIO()) as stream:
        print_inspection(inspect_cage(cage, "a"))
    return stream.getvalue()


@pytest.mark.slow
def test_hostile_names_are_shown_as_escapes() -> None:
    cage = bars_of(
        Bar(1, "[red]\x1b[31m", 0.01, ((0, 0, 0.1), (1, 0, 0.1))), host="\x07" + "W" * 300, storey="[b]"
    )
    text = printed(cage)
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "[red]" in text
    assert inspection_picture(inspect_cage(cage, "a\x1b" * 300))


def test_long_lists_are_cut_and_counted() -> None:
    bars = [Bar(n, f"role {n}", 0.02, ((0, n * 0.01, 0.1), (1, n * 0.01, 0.1))) for n in range(1, 101)]
    left_out = tuple(LeftOut(str(number), f"IfcWall: reason {number}") for number in range(50))
    text = printed(Cage(bars_of(*bars).bars, left_out))
    assert "and 60 more groups of 60 bars" in text
    assert "left out: 50 objects" in text
    assert "and 30 more" in text
    assert "clashes: 99 pairs" in text
    assert "and 89 more" in text


def test_box_is_that_of_the_mesh() -> None:
    corners_m = np.array([[0, 0, 0], [0.4, 0.1, 0.05], [0.4, 0.6, 0.3], [0.1, 0.6, 0.9]])
    bar = CageBar("a", Bar(1, "bar", 0.016, axis_of(bent_line_m(corners_m, 0.04))), ribs=False)
    vertices_m = bar_mesh(bar).vertices_m
    np.testing.assert_allclose(bar_box_m(bar), [vertices_m.min(axis=0), vertices_m.max(axis=0)], atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.1, 12.0])
def test_picture_shows_bars_of_every_size(scale: float) -> None:
    plate = trimesh.creation.box((scale / 3, scale / 3, 0.01))
    mesh = Mesh(np.array(plate.vertices), np.array(plate.faces, np.int32))
    cage = bars_of(Bar(1, "bar", 0.012, ((0, 0, 0.1), (scale, 0, 0.1))))
    cage = Cage((*cage.bars, CageBar("plate", Bar.without_axis(2, "imported"), mesh=mesh)))
    with Image.open(BytesIO(inspection_picture(inspect_cage(cage, "a")))) as picture:
        pixels = np.asarray(picture)
    corners = [(row, column) for row in (90, 730) for column in (0, 960)]
    panels = [pixels[row : row + 640, column : column + 960] for row, column in corners]
    for panel in panels:
        assert (panel[60:580].max(axis=2).astype(int) - panel[60:580].min(axis=2) > 40).any()
    json.loads(inspection_json(inspect_cage(cage, "a")))


@pytest.mark.parametrize("power", range(-3, 4))
def test_picture_has_a_scale_bar_at_rounding_edges(power: int) -> None:
    px_per_m = 240 / np.nextafter(10.0**power, 0.0)  # The logarithm of the longest bar is rounded up.
    for pixels in np.nextafter(px_per_m, [0.0, np.inf, px_per_m]).tolist():
        image = Image.new("RGB", (960, 640))
        _draw_scale_bar(ImageDraw.Draw(image), pixels)
        assert image.getbbox() is not None


def test_notes_are_cut_and_lengths_come_last(capsys: pytest.CaptureFixture[str]) -> None:
    bar = Bar(1, "bar", 0.01, ((0, 0, 0), (1, 0, 0)))
    notes = [Note("a", "length", f"length {number}") for number in range(30)]
    cage = Cage((CageBar("a", bar, notes=(*notes, Note("a", "gap", "a gap"))),))
    print_notes(cage.notes)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "note: a: a gap"
    assert len(lines) == MAX_NOTES + 1
    assert "11 more notes" in lines[-1]


@pytest.mark.slow
@pytest.mark.parametrize(("unit_m", "origin_m"), [(1.0, 0.0), (0.01, 1e4), (1e5, 0.0)])
def test_picture_shows_what_is_in_front_at_any_size(unit_m: float, origin_m: float) -> None:
    """From the front a thick near bar hides a thin one behind it; from above both are seen, with their places."""
    bars = [
        Bar(1, "bar", 0.2 * unit_m, ((origin_m, 0, 0), (origin_m + unit_m, 0, 0))),
        Bar(2, "bar", 0.1 * unit_m, ((origin_m, 0.5 * unit_m, 0), (origin_m + unit_m, 0.5 * unit_m, 0))),
    ]
    with Image.open(BytesIO(inspection_picture(inspect_cage(bars_of(*bars), "a")))) as picture:
        pixels = np.asarray(picture).astype(int)
    blue, orange = (pixels[..., n] - pixels[..., 2 - n] > 40 for n in (2, 0))
    front, top = (slice(90 + 60, 730 - 60), slice(960)), (slice(730 + 60, 1370 - 60), slice(960))
    assert not orange[front].any()
    np.testing.assert_allclose(np.ptp(np.argwhere(blue[front]), axis=0) + 1, (176, 880), atol=8)
    rows = [np.flatnonzero(seen[top].any(axis=1)) for seen in (orange, blue)]
    px_per_unit = 480 / 0.65  # The box is 0.65 high, and the panel has 480 pixels for it.
    assert [len(found) for found in rows] == pytest.approx([0.1 * px_per_unit, 0.2 * px_per_unit], abs=8)
    assert rows[1].mean() - rows[0].mean() == pytest.approx(0.5 * px_per_unit, abs=4)


@pytest.mark.slow
def test_bar_that_turns_back_is_left_out_of_the_picture() -> None:
    cage = bars_of(Bar(1, "bar", 0.01, ((0, 0, 0), (1, 0, 0), (0, 0, 0))))
    with Image.open(BytesIO(inspection_picture(inspect_cage(cage, "a")))) as picture:
        assert np.ptp(np.asarray(picture)[150:670, :960].astype(int), axis=2).max() == 0


def test_font_has_the_letters_of_names() -> None:
    def drawn(character: str) -> bytes:
        return bytes(font(40).getmask(character))

    assert all(drawn(character) != drawn("\U0010ffff") for character in "…–éßΩЖ\N{REPLACEMENT CHARACTER}")


def rod(bar_id: int, start: tuple[float, ...], end: tuple[float, ...], diameter_m: float = 0.012) -> Bar:
    return Bar(bar_id, "bar", diameter_m, axis_of(np.array([start, end], dtype=np.float64)))


def test_groups_have_spacing_and_height_above_the_ground() -> None:
    """Bars of another group, and those that cross, do not change the spacing; a plate's lowest point counts."""
    level = [rod(number, (0, y, 0.05), (1, y, 0.05)) for number, y in enumerate((0, 0.15, 0.3, 0.44), 1)]
    thick = [rod(10 + number, (0, y, 0.1), (1, y, 0.1), 0.02) for number, y in enumerate((0.07, 0.27))]
    across = rod(20, (0.5, 0, 0.07), (0.5, 1, 0.07), 0.016)
    plate = trimesh.creation.box((0.1, 0.1, 0.02))
    unknown = CageBar(
        "plate", Bar.without_axis(30, "plate"), mesh=Mesh(plate.vertices - (0, 0, 0.03), plate.faces)
    )
    groups = inspect_cage(Cage((*bars_of(*level, *thick, across).bars, unknown)), "a").groups
    assert [group.diameter_mm for group in groups] == [20, 16, 12, None]
    assert [group.spacing_m for group in groups] == [
        pytest.approx((0.2, 0.2, 0.2)), None, pytest.approx((0.15, 0.14, 0.15)), None
    ]  # fmt: skip
    assert [group.above_ground_m for group in groups] == pytest.approx([0.09, 0.062, 0.044, -0.04])
    lines = printed(bars_of(*level, *thick)).splitlines()
    assert lines[4].split()[-5:] == ["150.0", "(140.0", "-", "150.0)", "44.0"]
    assert lines[6].split()[-1] == "44.0"


@pytest.mark.slow
def test_clashes_are_those_of_sampled_axes() -> None:
    random = np.random.default_rng(3)
    bars = [
        Bar(number, "bar", float(random.uniform(0.02, 0.06)), axis_of(random.uniform(0, 1, (4, 3))))
        for number in range(1, 19)
    ]
    at = np.linspace(0, 3, 3000)
    samples_m = [
        np.stack([np.interp(at, range(4), xyz) for xyz in zip(*bar.axis_m, strict=True)], 1) for bar in bars
    ]
    expected = {}
    for index, a in enumerate(bars):
        tree = cKDTree(samples_m[index])
        for b, points_m in zip(bars[index + 1 :], samples_m[index + 1 :], strict=True):
            depth_m = (a.diameter_m + b.diameter_m) / 2 - tree.query(points_m, distance_upper_bound=0.1)[0].min()
            if depth_m > CONTACT * (a.diameter_m + b.diameter_m) / 2 + CONTACT_M:
                expected[a.bar_id, b.bar_id] = depth_m
    _, clashes = meetings(bars)
    found = {(pair.bar_a, pair.bar_b): pair.depth_m for pair in clashes}
    assert len(expected) > 20
    assert expected.keys() <= found.keys()
    for pair, depth_m in found.items():
        diameters_m = [bars[bar_id - 1].diameter_m for bar_id in pair]
        sampled_m = expected.get(pair, CONTACT * np.mean(diameters_m) + CONTACT_M)
        assert sampled_m - 1e-9 <= depth_m <= sampled_m + 1.5e-3  # Samples are up to 1.7 mm apart.
    assert list(found.values()) == sorted(found.values(), reverse=True)


@pytest.mark.parametrize(
    ("height_mm", "contacts", "clashes"), [(13.8, 0, 0), (13.6, 1, 0), (12, 1, 0), (10.4, 1, 0), (10.2, 0, 1)]
)
def test_bars_in_contact_are_apart_from_clashes(height_mm: float, contacts: int, clashes: int) -> None:
    """Bars of 12 mm are in contact up to a gap and an overlap of 1.7 mm."""
    z_m = height_mm / 1000
    inspection = inspect_cage(bars_of(rod(1, (-2, 0, 0), (2, 0, 0)), rod(2, (0, -2, z_m), (0, 2, z_m))), "a")
    values = json.loads(inspection_json(inspection))
    assert (len(values["contacts"]), len(values["clashes"])) == (contacts, clashes)
    for pair in values["contacts"] + values["clashes"]:
        assert (pair["bar_a"], pair["bar_b"]) == (1, 2)
        assert pair["depth_m"] == pytest.approx(0.012 - z_m, abs=1e-9)
        np.testing.assert_allclose(pair["point_m"], (0, 0, z_m / 2), atol=1e-9)
    text = printed(inspection.cage)
    assert f"in contact: {contacts} pair" in text
    assert f"clashes: {clashes} pair" in text


def test_bars_without_axis_and_single_bars_meet_no_others() -> None:
    assert meetings([rod(1, (0, 0, 0), (1, 0, 0)), Bar.without_axis(2, "imported")]) == ([], [])


def test_too_many_neighbours_are_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(summary_module, "MAX_PAIRS", 1000)
    crowd = [rod(number, (0, 0, 0), (0.05, 0, 0)) for number in range(1, 100)]
    with pytest.raises(TooManyNeighboursError):
        meetings(crowd)
