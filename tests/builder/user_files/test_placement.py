"""Selection and placement of cages: up, centring, rotation and translation, for bars, IFC models and meshes."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.catalog import scene_file
from dataset_builder.catalog.scene_file import scene_cage
from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.specs.config_specs import SurveySpec
from dataset_builder.specs.file_specs import Origin, PlacementSpec, Up
from dataset_builder.user_files.cage_file import cage_assembly
from dataset_builder.user_files.cage_placement import placed
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError, MeshError
from rebar_depth_bench.data.bars import Bar
from tests.builder.catalog.scene_files import BAR, MM, scene_config, write_scene
from tests.builder.user_files.ifc_writer import SITE_TURN_DEG, site_from_world_m, write_site_model
from tests.builder.user_files.tube_shapes import RODS, concatenated, obj_bytes

COORDINATE = st.floats(-1e6, 1e6)
NAMES = ("Rod 0", "Rod 1")


def cage_of(*axes_m: tuple[tuple[float, float, float], ...], diameter_m: float = 0.012) -> Cage:
    bars = [Bar(number, "bar", diameter_m, axis_m) for number, axis_m in enumerate(axes_m, start=1)]
    return Cage(tuple(CageBar(f"bar {bar.bar_id}", bar) for bar in bars))


def rods_at(x: float, y: float, z: float) -> Cage:
    return cage_of(((x, y, z), (x + 1.5, y, z + 0.1)), ((x, y + 0.3, z), (x, y + 0.3, z + 0.7)))


@pytest.mark.slow
@settings(max_examples=40)
@given(
    st.tuples(COORDINATE, COORDINATE, COORDINATE),
    st.sampled_from(["z", "y"]),
    st.sampled_from(["centre", "keep"]),
    st.floats(-360, 360),
)
def test_matrix_takes_source_points_to_the_world_where_centred_cages_are_equal(
    place: tuple[float, float, float], up: Up, origin: Origin, rotate_deg: float
) -> None:
    placement = PlacementSpec(up, origin, rotate_deg, (1.0, -2.0, 0.5))
    source = rods_at(*place)
    cage, at_origin = placed(source, placement, "a"), placed(rods_at(0, 0, 0), placement, "b")
    for before, after, expected in zip(source.bars, cage.bars, at_origin.bars, strict=True):
        points = np.column_stack([before.bar.axis_m, np.ones(2)]) @ cage.world_from_source.T
        np.testing.assert_allclose(points[:, :3], after.bar.axis_m, rtol=0, atol=1e-6)
        if origin == "centre":
            shift_m = np.array(after.bar.axis_m) - np.array(expected.bar.axis_m)
            assert np.abs(shift_m).max() <= 0.0021  # The box is centred by whole millimetres.
            np.testing.assert_allclose(shift_m - shift_m[0], 0, atol=1e-6)
    if origin == "centre":
        assert -1e-9 <= cage_assembly(cage, "a").vertices_m[:, 2].min() - 0.5 <= 0.001 + 1e-9


def test_order_is_up_centre_rotation_translation() -> None:
    """A rod along the file's y axis at (5, 7, 9) stands upright; a quarter turn takes x to y."""
    upright = cage_of(((5.0, 7.0, 9.0), (5.0, 8.0, 9.0)), ((5.0, 7.0, 9.0), (6.0, 7.0, 9.0)))
    cage = placed(upright, PlacementSpec("y", "centre", 90.0, (0.0, 0.0, 2.0)), "a")
    (foot, head), (_, end) = (np.array(bar.bar.axis_m) for bar in cage.bars)
    np.testing.assert_allclose(head - foot, (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(end - foot, (0, 1, 0), atol=1e-12)
    assert 2.0 <= foot[2] - 0.006 <= 2.002


@pytest.mark.slow
def test_sound_cage_at_the_origin_is_not_moved(tmp_path: Path) -> None:
    kept = scene_cage(write_scene(tmp_path, MM + BAR))
    np.testing.assert_array_equal(kept.world_from_source, np.diag([0.001, 0.001, 0.001, 1]))
    assert kept.bars[0].bar.axis_m == ((-0.1, 0.0, 0.05), (0.1, 0.0, 0.05))
    column = scene_cage("examples/column.ifc")
    np.testing.assert_array_equal(column.world_from_source, np.diag([0.001, 0.001, 0.001, 1]))


def test_bars_of_a_scene_file_can_be_placed(tmp_path: Path) -> None:
    keys = 'origin = "centre"\nrotate_deg = 90\ntranslate = [0, 10, 0]\n'
    (bar,) = scene_cage(write_scene(tmp_path, MM + keys + BAR)).bars
    np.testing.assert_allclose(bar.bar.axis_m, [(0, -0.09, 0.006), (0, 0.11, 0.006)], atol=0.0012)


def write_rods(path: Path, offset_m: float) -> Path:
    """Write two rods as OBJ (64-bit numbers), or as STL (32-bit)."""
    rods = [rod.copy() for rod in RODS[:2]]
    for rod in rods:
        rod.vertices += offset_m
    is_obj = path.suffix == ".obj"
    path.write_bytes(obj_bytes(rods, NAMES) if is_obj else trimesh.exchange.stl.export_stl(concatenated(rods)))
    return path


def test_obj_at_site_coordinates_keeps_a_micrometre(tmp_path: Path) -> None:
    scenes = []
    for name, offset_m in (("near", 0.0), ("far", 1e6)):
        mesh = write_rods(tmp_path / f"{name}.obj", offset_m)
        scenes.append(scene_cage(write_scene(tmp_path, f'mesh = "{mesh.name}"\nunit = "m"\n', f"{name}.toml")))
    for near, far in zip(scenes[0].bars, scenes[1].bars, strict=True):
        ends_m = np.array(near.bar.axis_m), np.array(far.bar.axis_m)
        assert np.abs(ends_m[0] - ends_m[1]).max() <= 1e-6
        assert far.bar.diameter_m == pytest.approx(near.bar.diameter_m, abs=1e-6)
        assert (far.source, far.axis_kind) == (near.source, "fitted")


def test_coordinates_that_32_bits_cannot_hold_are_refused(tmp_path: Path) -> None:
    near, far = (write_rods(tmp_path / f"{offset}.stl", offset) for offset in (700.0, 2000.0))
    assert len(scene_cage(write_scene(tmp_path, f'mesh = "{near.name}"\nunit = "m"\n')).bars) == 2
    with pytest.raises(MeshError, match=r"32-bit coordinates are 0.122 mm apart .* expected 0.1 mm"):
        scene_cage(write_scene(tmp_path, f'mesh = "{far.name}"\nunit = "m"\n'))


def test_parts_of_a_mesh_are_selected_by_name_and_box(tmp_path: Path) -> None:
    write_rods(tmp_path / "a.obj", 0.0)
    keys = 'mesh = "a.obj"\nunit = "m"\n'
    for table in ("name = 'Rod 1'", "box = [[-1, 0.05, 0], [1, 1, 1]]"):
        cage = scene_cage(write_scene(tmp_path, f"{keys}[[select]]\n{table}\n"))
        assert [(bar.bar.bar_id, bar.source) for bar in cage.bars] == [(1, "Rod 1")]
        assert [record.source for record in cage.left_out] == ["Rod 0"]
    with pytest.raises(MeshError, match=r"no part is selected.*2 parts; nearest to name rod-1\*: Rod 1, Rod 0$"):
        scene_cage(write_scene(tmp_path, f"{keys}[[select]]\nname = 'rod-1*'\n"))


def test_mesh_file_alone_keeps_its_coordinates(tmp_path: Path) -> None:
    cage = scene_cage(write_rods(tmp_path / "a.obj", 3.0), "cm")
    np.testing.assert_array_equal(cage.world_from_source, np.diag([0.01, 0.01, 0.01, 1]))


@pytest.mark.slow
def test_gltf_is_refused_with_a_conversion_that_keeps_bars_and_height(tmp_path: Path) -> None:
    """Follow the message: nodes with transforms become objects of an OBJ file, whose vertical axis is y."""
    rod = trimesh.creation.cylinder(0.006, segment=[[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]], sections=24)
    scene = trimesh.Scene()
    for x_m in (0.0, 0.1, 0.3):
        scene.add_geometry(rod, transform=trimesh.transformations.translation_matrix([x_m, 0.0, 0.0]))
    scene.export(tmp_path / "FILE.glb")
    keys = 'mesh = "FILE.{}"\nunit = "m"\nup = "y"\n'
    for path in (tmp_path / "FILE.glb", write_scene(tmp_path, keys.format("glb"))):
        with pytest.raises(
            InputError, match=r"\.glb'.*mesh = \"FILE.obj\", unit = \"m\" and up = \"y\"$"
        ) as caught:
            scene_cage(path)
    (program,) = re.findall('python -c "(.*?)"', str(caught.value))
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
    bars = scene_cage(write_scene(tmp_path, keys.format("obj"))).bars
    for bar in bars:
        assert np.ptp(bar.bar.axis_m, axis=0)[2] == pytest.approx(0.5, abs=1e-4)
    starts_m = sorted(bar.bar.axis_m[0][0] for bar in bars)
    np.testing.assert_allclose(np.diff(starts_m), [0.1, 0.2], atol=1e-4)


def test_placement_is_part_of_the_spec(tmp_path: Path) -> None:
    write_rods(tmp_path / "a.obj", 0.0)
    specs = []
    for keys in ("", "rotate_deg = 5\n", "[[select]]\nname = 'Rod 0'\n"):
        config = scene_config(write_scene(tmp_path, f'mesh = "a.obj"\nunit = "m"\n{keys}'))
        specs.append(config.scene.assembly)
        assert make_assembly(config.scene.assembly).world_from_source is not None
    assert len(set(specs)) == 3


WALL_BARS, COLUMN_BARS, FITTING_BARS = 60, 4 + 10, 2
BOTH = WALL_BARS + COLUMN_BARS


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_site_model(tmp_path_factory.mktemp("site") / "Site Model.ifc")


def cage_with(model: Path, content: str) -> Cage:
    return scene_cage(write_scene(model.parent, f'ifc = "{model.name}"\n{content}', "scene.toml"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tables", "bars"),
    [
        ("", BOTH),
        ("[[select]]\nhost = 'W-*'", WALL_BARS),
        ("[[select]]\nstorey = 'EG*'", WALL_BARS),
        ("[[select]]\nstorey = 'Level ?'", COLUMN_BARS),
        ("[[select]]\nlayer = 'Stirrups'", COLUMN_BARS - 4),
        ("[[select]]\nname = 'Bar 25'\n[[select]]\nname = 'Bar 10'", COLUMN_BARS),
        ("[[select]]\nname = 'Bar 1?'\nstorey = 'Level 1'", COLUMN_BARS - 4),
        ("[[select]]\nclass = 'ifcbuildingelement*'", FITTING_BARS),
        ("[[select]]\nclass = 'IfcReinforcing*'", BOTH),
        ("[[select]]\nname = '*'", BOTH),
        ("[[select]]\nname = 'bar 25'\n[[select]]\nname = '*5'", 4),
    ],
)
def test_only_selected_bars_are_in_the_cage(model: Path, tables: str, bars: int) -> None:
    cage = cage_with(model, tables)
    assert len(cage.bars) == bars
    assert [bar.bar.bar_id for bar in cage.bars] == list(range(1, bars + 1))
    assert not cage.problems
    left_out = {record.source for record in cage.left_out}
    assert not left_out & {bar.source for bar in cage.bars}
    taken = {bar.source for bar in cage.bars}
    assert len(left_out) == BOTH + 3 - len(taken)  # Also the wall, the slab and the fitting.


@pytest.mark.slow
@pytest.mark.parametrize("schema", ["IFC4", "IFC2X3", "IFC4X3"])
def test_bars_have_hosts_and_storeys(tmp_path: Path, schema: str) -> None:
    bars = scene_cage(write_site_model(tmp_path / "a.ifc", schema)).bars
    assert {(bar.host, bar.storey) for bar in bars[:WALL_BARS]} == {("W-1", "EG Erdgeschoss")}
    assert {(bar.host, bar.storey) for bar in bars[WALL_BARS:]} == {(None, "Level 1")}


@pytest.mark.slow
def test_box_takes_the_objects_that_are_wholly_inside(model: Path) -> None:
    from_site = np.linalg.inv(site_from_world_m())
    around_m = (from_site @ np.array([7.0, 1.0, 5.5, 1.0]))[:3]
    for half_m, expected in ((2.0, COLUMN_BARS), (0.5, 3), (0.05, 0)):
        lower, upper = ((around_m + sign * half_m) * 1000 for sign in (-1, 1))
        table = f"[[select]]\nbox = [{upper.tolist()}, {lower.tolist()}]"
        if expected:
            assert len(cage_with(model, table).bars) == expected
        else:
            with pytest.raises(MeshError, match="no object is inside the box"):
                cage_with(model, table)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tables", "nearest"),
    [
        ("name = 'Bar 25'\nhost = 'w 1'", "; nearest to host w 1: W-1"),
        (
            "class = 'IfcBuildingElementProxi'",
            "; nearest to class IfcBuildingElementProxi: IfcBuildingElementProxy",
        ),
        (
            "storey = '2'\n[[select]]\nstorey = 'Level'",
            "; nearest to storey 2: .*; nearest to storey Level: Level 1",
        ),
        ("name = 'Bar 25'\nstorey = 'EG*'", "$"),
    ],
)
def test_selection_of_nothing_names_what_there_is(model: Path, tables: str, nearest: str) -> None:
    words = rf"no object is selected.*{BOTH} IfcReinforcingBar.*1 IfcWall[^;]*{nearest}"
    with pytest.raises(MeshError, match=words):
        cage_with(model, f"[[select]]\n{tables}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keys", "rotate_deg", "move_m"),
    [
        ("", 0.0, (0, 0, 0)),
        (f"rotate_deg = {-SITE_TURN_DEG}\ntranslate = [1, -2.5, 0.25]\n", -SITE_TURN_DEG, (1, -2.5, 0.25)),
    ],
)
def test_cage_is_centred_by_whole_millimetres(
    model: Path, keys: str, rotate_deg: float, move_m: tuple[float, float, float]
) -> None:
    """Compare the axes with those of the site's frame, which the placement does not know."""
    keys += "[[select]]\nhost = 'W-1'\n"
    cage = cage_with(model, keys)
    vertices_m = cage_assembly(cage, str(model)).vertices_m - move_m
    lower_m, upper_m = vertices_m.min(axis=0), vertices_m.max(axis=0)
    assert 0 <= lower_m[2] <= 0.001
    assert np.abs(lower_m + upper_m)[:2].max() / 2 <= (0.0006 if not rotate_deg else 0.002)
    source_from_world = np.linalg.inv(cage.world_from_source)
    for bar in cage.bars[:3]:
        points = np.column_stack([bar.bar.axis_m, np.ones(len(bar.bar.axis_m))])
        source_mm = (points @ source_from_world.T)[:, :3]
        site_m = np.column_stack([source_mm / 1000, np.ones(len(points))]) @ site_from_world_m().T
        number = bar.bar.bar_id - 1
        expected_m = [[0.075 + 0.3 * number, 0.041, z_m] for z_m in (0.04, 2.96)]
        np.testing.assert_allclose(site_m[:, :3], expected_m, rtol=0, atol=2e-6)
    if rotate_deg:  # The wall is parallel to the x axis again.
        np.testing.assert_allclose(np.ptp(vertices_m[:, :2], axis=0), (5.92, 0.204), rtol=0, atol=0.02)


@pytest.mark.slow
def test_site_coordinates_that_are_kept_are_refused(model: Path) -> None:
    cage = cage_with(model, 'origin = "keep"\n[[select]]\nhost = "W-1"\n')
    assert len(cage.problems) == WALL_BARS
    np.testing.assert_array_equal(cage.world_from_source, np.diag([0.001, 0.001, 0.001, 1]))
    with pytest.raises(MeshError, match="from the world's origin"):
        scene_config(model.parent / "scene.toml")


@pytest.mark.slow
def test_ifc_file_alone_is_centred_and_surveyed(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fewer_views(*arguments: Any) -> SurveySpec:
        survey = default(*arguments)
        assert isinstance(survey, SurveySpec)
        return replace(survey, distances_m=(2.0,), views_per_distance=4)

    default: Any = scene_file._default_trajectory
    monkeypatch.setattr(scene_file, "_default_trajectory", fewer_views)
    config = scene_config(model)
    assert (config.name, config.scene.environment) == ("site-model", "outdoors")
    assert config.protocol.kind == "survey"  # The dome would be too large.
    cage = scene_cage(model)
    assembly = cage_assembly(cage, str(model))
    assert 0 <= assembly.vertices_m[:, 2].min() <= 0.001
    assert assembly.world_from_source is cage.world_from_source
    codes = [note.code for note in assembly.notes]
    assert codes == ["moved", "left-out"]
    assert "1 (IfcWall: not reinforcement)" in assembly.notes[1].text
