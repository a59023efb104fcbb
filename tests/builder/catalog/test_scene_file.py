"""User scenes as TOML: bar geometry, units, default cameras, surroundings, and the files that they name."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray
from scipy.spatial import cKDTree

from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.cameras.trajectories import aim_point_m, view_count
from dataset_builder.catalog.named_configs import LATTICE_DOME, BuildRequest
from dataset_builder.catalog.scene_file import NEAREST_RADIUS_PER_REACH
from dataset_builder.scene.assemblies.bar_meshes import MAX_RIBS_PER_ROW
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.cages.generate import FAMILIES
from dataset_builder.scene.environments.surroundings import (
    FORMWORK_FAMILIES,
    LIFE_SIZE_ENVIRONMENTS,
    SURROUNDINGS,
    check_suitable,
)
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import Assembly, WorldMesh
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.variants.registry import LIGHT_SLOT, PROPS_SLOT, VARIANTS
from dataset_builder.specs.config_specs import STEREO_CAMERAS, DomeSpec, LatticeSpec, RingSpec, SurveySpec
from dataset_builder.specs.file_specs import CageFileSpec, MeshFileSpec
from dataset_builder.user_files.cage_file import cage_file_spec, load_cage, read_cage
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError, MeshError
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from tests.builder.catalog.scene_files import BAR, MM, scene_config, write_scene
from tests.builder.scene.cages import assembly_of

EXAMPLES = Path("examples")


def load_cage_text(folder: Path, content: str) -> Assembly:
    return load_cage(cage_file_spec(write_scene(folder, content)))


def sample_axis_m(bar: Bar, step_m: float = 5e-4) -> ndarray:
    axis_m = np.array(bar.axis_m)
    segments = pairwise(axis_m)
    counts = np.ceil(np.linalg.norm(np.diff(axis_m, axis=0), axis=1) / step_m).astype(int) + 1
    return np.concatenate([np.linspace(a, b, n) for (a, b), n in zip(segments, counts, strict=True)])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["beam.toml", "column.ifc"])
def test_examples_are_above_board_without_touching_bars(name: str) -> None:
    config = scene_config(EXAMPLES / name)
    assembly = make_assembly(config.scene.assembly)
    assert 0 < assembly.vertices_m[:, 2].min() < 0.001
    # The quiet zones of the markers begin at x = 0.139 m.
    assert (np.abs(assembly.vertices_m).max(axis=0)[:2] < [0.139, 0.07]).all()
    lines = [sample_axis_m(bar) for bar in assembly.bars]
    trees = [cKDTree(line) for line in lines]
    radii_m = [outer_radius_m(bar.diameter_m) for bar in assembly.bars]
    for a, b in combinations(range(len(lines)), 2):
        assert trees[a].query(lines[b])[0].min() > radii_m[a] + radii_m[b] + 2e-4
    assert (config.name, config.scene.name) == (name.split(".")[0],) * 2
    assert (config.scene.environment, config.scene.board) == ("laboratory", BoardSpec(markers=6))
    assert view_count(config.protocol) == 504


def test_bars_have_specified_geometry(tmp_path: Path) -> None:
    content = """
[[bar]]
diameter = 9
points = [[-100, 7, 50.5], [100, 7, 50.5]]
role = "edge bar"
id = 2
ribs = false
[[bar]]
diameter = 16
points = [[0, 0, 3], [0, 0, 300]]
[[bar]]
diameter = 20
points = [[0, 100, 20], [300, 100, 20], [300, 100, 320]]
[[bar]]
diameter = 10
bend_diameter = 100
points = [[0, 200, 20], [300, 200, 20], [300, 400, 20]]
"""
    assembly = load_cage_text(tmp_path, MM + content)
    first, second, third, fourth = assembly.bars
    assert first == Bar(2, "edge bar", 0.009, ((-0.1, 0.007, 0.0505), (0.1, 0.007, 0.0505)))
    assert second == Bar(1, "bar", 0.016, ((0.0, 0.0, 0.003), (0.0, 0.0, 0.3)))
    assert [bar.bar_id for bar in (third, fourth)] == [3, 4]
    # Quarter circle about (300 - r, r), r = (7 x 20 + 20) / 2 = 80 mm: EN 1992-1-1, table 8.1N, above 16 mm.
    arc = np.array(third.axis_m)[1:-1]
    np.testing.assert_allclose(np.hypot(arc[:, 0] - 0.22, arc[:, 2] - 0.1), 0.08, atol=1e-12)
    assert len(arc) == 16
    arc = np.array(fourth.axis_m)[1:-1]
    np.testing.assert_allclose(np.hypot(arc[:, 0] - 0.245, arc[:, 1] - 0.255), 0.055, atol=1e-12)
    assert [part.bar_id for part in assembly.parts] == [2, 1, 3, 4]
    assert [part.name for part in assembly.parts[:2]] == ["edge bar-002", "bar-001"]
    # Plain bar: two rings of 24 vertices and two end centres. The ribbed mesh has the full length of the bar.
    assert len(assembly.parts[0].mesh.vertices_m) == 50
    assert np.ptp(assembly.parts[1].mesh.vertices_m[:, 2]) == pytest.approx(0.297, abs=1e-12)


def test_rows_are_equal_to_bars_in_tables_of_their_own(tmp_path: Path) -> None:
    def table(y: float, keys: str) -> str:
        return f'[[bar]]\ndiameter = 1\npoints = [[0, {y}, 5], [20, {y}, 5], [20, {y}, 20]]\nrole = "a"\n{keys}\n'

    unit = 'unit = "cm"\n'
    row = load_cage_text(
        tmp_path, unit + table(0, "count = 4\nstep = [0, 15.1, 0]\nid = 7") + table(90, "count = 1")
    )
    tables = [
        table(0, "id = 7"),
        table(15.1, "id = 8"),
        table(30.2, "id = 9"),
        table(45.3, "id = 10"),
        table(90, ""),
    ]
    assert row.bars == load_cage_text(tmp_path, unit + "".join(tables)).bars
    assert [bar.bar_id for bar in row.bars] == [7, 8, 9, 10, 1]
    split = table(0, "count = 3\nstep = [0, 30, 0]") + table(5, "id = 2")
    cage = read_cage(cage_file_spec(write_scene(tmp_path, unit + split)))
    assert [(bar.bar.bar_id, bar.source) for bar in cage.bars] == [
        (1, "bar 1"), (3, "bar 1"), (4, "bar 1"), (2, "bar 2")
    ]  # fmt: skip


def test_default_dome_scales_with_steel_extent(tmp_path: Path) -> None:
    small = scene_config(write_scene(tmp_path, MM + BAR.replace("100", "20")))
    assert small.protocol == LATTICE_DOME
    config = scene_config(write_scene(tmp_path, MM + BAR))
    assert isinstance(config.protocol, DomeSpec)
    reach_m = math.hypot(0.1, outer_radius_m(0.01))
    assert min(config.protocol.radii_m) == pytest.approx(NEAREST_RADIUS_PER_REACH * reach_m, abs=0.002)
    ratio = np.array(config.protocol.radii_m) / np.array(LATTICE_DOME.radii_m)
    np.testing.assert_allclose(ratio, ratio[0], atol=0.003)
    narrower = scene_config(write_scene(tmp_path, MM + BAR + '[rig]\ncamera = "Intel RealSense D415"\n'))
    assert isinstance(narrower.protocol, DomeSpec)
    assert min(narrower.protocol.radii_m) == pytest.approx(min(config.protocol.radii_m) * 1004.6 / 700, abs=0.002)
    numbers = "[rig]\nwidth = 1280\nheight = 480\nbaseline = 120\nfx = 700\n"
    lower = scene_config(write_scene(tmp_path, MM + BAR + numbers))
    assert isinstance(lower.protocol, DomeSpec)
    assert min(lower.protocol.radii_m) == pytest.approx(1.5 * min(config.protocol.radii_m), abs=0.002)
    lattice = lattice_assembly(LatticeSpec())
    reach_m = float(np.linalg.norm(lattice.vertices_m - aim_point_m(lattice), axis=1).max())
    assert min(LATTICE_DOME.radii_m) == pytest.approx(NEAREST_RADIUS_PER_REACH * reach_m, rel=0.08)


@settings(max_examples=15)
@given(length=st.floats(3.0, 340.0), across=st.floats(0.0, 190.0))
def test_default_dome_fits_any_cage(
    length: float, across: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    points = f"[[0, 0, 40], [{length!r}, {across!r}, 40]]"
    content = f"{MM}[[bar]]\ndiameter = 10\nribs = false\npoints = {points}\n"
    config = scene_config(write_scene(tmp_path_factory.mktemp("dome"), content))
    check_fits(make_assembly(config.scene.assembly), config)
    assert isinstance(config.protocol, DomeSpec)
    assert view_count(config.protocol) == 504


@pytest.mark.slow
def test_default_is_a_survey_where_a_dome_would_exceed_one_metre(tmp_path: Path) -> None:
    for half_mm, kind in ((203, DomeSpec), (206, SurveySpec)):
        config = scene_config(write_scene(tmp_path, MM + BAR.replace("100", str(half_mm))))
        assert isinstance(config.protocol, kind)
    assert (view_count(config.protocol), config.scene.environment) == (504, "outdoors")
    bench = 'environment = "laboratory"\n' + MM + BAR.replace("100", "206")
    assert isinstance(scene_config(write_scene(tmp_path, bench)).protocol, DomeSpec)


def test_cameras_board_environment_and_rig_are_applied(tmp_path: Path) -> None:
    head = 'name = "other"\nenvironment = "outdoors"\nboard = 12\n' + MM
    head += '[rig]\ncamera = "Luxonis OAK-D"\n'
    ring = '[cameras]\nkind = "ring"\nradius = 400\nelevation_deg = 35\nazimuths = 20\n'
    config = scene_config(write_scene(tmp_path, head + BAR + ring))
    assert (config.name, config.scene.name, config.scene.environment) == ("other", "other", "outdoors")
    assert (config.protocol, config.scene.board) == (RingSpec(0.4, 35.0, 20), BoardSpec(markers=12))
    assert config.rig == STEREO_CAMERAS["Luxonis OAK-D"]
    in_cm = "[[bar]]\ndiameter = 1\npoints = [[-10, 0, 5], [10, 0, 5]]\n"
    dome = '[cameras]\nkind = "dome"\nradii = [30, 40.5]\nelevations_deg = [15, 45]\nazimuths = 5\n'
    config = scene_config(write_scene(tmp_path, 'unit = "cm"\nboard = false\n' + in_cm + dome))
    assert config.protocol == replace(LATTICE_DOME, radii_m=(0.3, 0.405), elevations_deg=(15.0, 45.0), azimuths=5)
    assert (config.scene.environment, config.scene.board) == ("laboratory", None)


def test_large_cage_is_outdoors_and_rejected_in_laboratory(tmp_path: Path) -> None:
    content = MM + BAR.replace("100", "2000")
    config = scene_config(write_scene(tmp_path, content))
    assert (config.scene.environment, config.scene.board) == ("outdoors", None)
    with pytest.raises(
        InputError,
        match=r"steel extends 2 m from the world's origin, expected at most 0\.45 m in the environment lab",
    ):
        scene_config(write_scene(tmp_path, 'environment = "laboratory"\n' + content))
    far = '[cameras]\nkind = "ring"\nradius = 2000\nelevation_deg = 35\nazimuths = 4\n'
    with pytest.raises(
        InputError, match=r"the steel extends 21 m from the world's origin, expected at most 20\.5"
    ):
        scene_config(write_scene(tmp_path, MM + BAR.replace("100", "21000")))
    with pytest.raises(InputError, match=r"cameras are 1.638 m from the world's origin"):
        scene_config(write_scene(tmp_path, 'environment = "laboratory"\n' + MM + BAR + far))


@pytest.mark.slow
def test_mesh_and_ifc_paths_are_relative_to_scene_file(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    part = load_cage_text(tmp_path, MM + BAR).parts[0]
    faces = part.mesh.faces
    bar_id = np.full(len(faces), 4, np.uint16)
    write_mesh_ply(tmp_path / "parts/a.ply", WorldMesh(part.mesh.vertices_m * 1000, faces, bar_id))
    config = scene_config(write_scene(tmp_path, MM + 'mesh = "parts/a.ply"\n'))
    assert isinstance(config.scene.assembly, MeshFileSpec)
    assert make_assembly(config.scene.assembly).bars[0].diameter_m == pytest.approx(0.01, rel=0.01)
    (tmp_path / "parts/b.ifc").write_bytes((EXAMPLES / "column.ifc").read_bytes())
    config = scene_config(write_scene(tmp_path, 'ifc = "parts/b.ifc"\n'))
    assert isinstance(config.scene.assembly, CageFileSpec)
    assert (config.name, len(make_assembly(config.scene.assembly).bars)) == ("my-beam", 13)


@pytest.mark.parametrize("name", ["/etc/passwd", "../a.ply", "parts/../../a.ply", "~/a.ply", "a\\u001bb.ply", "."])
def test_files_outside_the_folder_of_the_scene_are_not_opened(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.ply").write_text("secret")
    (tmp_path / "scene").mkdir()
    for key in ("mesh", "ifc"):
        with pytest.raises(InputError) as caught:
            scene_config(write_scene(tmp_path / "scene", f'{MM}{key} = "{name}"\n'))
        assert [(problem.code, problem.where) for problem in caught.value.problems] == [("invalid", key)]
        assert "in the folder of this file" in str(caught.value)
        assert "secret" not in str(caught.value)


def test_errors_of_named_files_name_scene_and_key(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, MM + 'mesh = "a.stl"\n')
    os.mkfifo(tmp_path / "a.stl")
    with pytest.raises(MeshError, match=f"^{scene}: mesh: {tmp_path}/a.stl: 1 problem\n  - .* it is a named pipe"):
        scene_config(scene)
    (tmp_path / "a.stl").unlink()
    (tmp_path / "a.stl").write_bytes(bytes(200))
    with pytest.raises(MeshError, match=f"^{scene}: mesh: {tmp_path}/a.stl: truncated or damaged") as caught:
        scene_config(scene)
    assert [problem.code for problem in caught.value.problems] == ["damaged"]


def test_scene_files_are_regular_files_within_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    for name, words in (("pipe.toml", "it is a named pipe"), ("zero.toml", "it is a device")):
        with pytest.raises(InputError, match=f"{name}: 1 problem\n.*{words}"):
            scene_config(tmp_path / name)
    with pytest.raises(InputError, match="the keys have too many parts"):
        scene_config(write_scene(tmp_path, MM + "a." * 30_000 + "a = 1\n"))
    monkeypatch.setenv("REBAR_MAX_TOML_BYTES", "20")
    with pytest.raises(InputError, match="REBAR_MAX_TOML_BYTES raises the limit"):
        scene_config(write_scene(tmp_path, MM + BAR))


@pytest.mark.slow
def test_long_bars_are_plain_and_triangle_count_is_limited() -> None:
    def bar(number: int, length_m: float, points: int = 2) -> CageBar:
        axis_m = tuple((x, 0.02 * number, 0.1) for x in np.linspace(0, length_m, points).tolist())
        return CageBar(f"bar {number}", Bar(number, "bar", 0.01, axis_m))

    max_ribbed_length_m = MAX_RIBS_PER_ROW * 0.68 * 0.01
    short, long = assembly_of(
        [bar(1, max_ribbed_length_m * 0.999), bar(2, max_ribbed_length_m * 1.001)], "a"
    ).parts
    assert len(short.mesh.faces) > 100_000
    assert len(long.mesh.faces) == 96  # 24 sides of two triangles, two end caps of 24
    many = assembly_of([bar(number, 0.1) for number in range(1, 1000)], "a")
    assert {len(part.mesh.faces) for part in many.parts} == {96}
    few = assembly_of([bar(number, 0.1) for number in range(1, 20)], "a")
    assert min(len(part.mesh.faces) for part in few.parts) > 5000
    with pytest.raises(MeshError, match=r"the bars make [0-9]+ triangles, expected at most 20000000"):
        assembly_of([bar(number, 3.0, points=10_000) for number in range(1, 20)], "a")


def test_straight_segments_next_to_bends_keep_section(tmp_path: Path) -> None:
    content = MM + "[[bar]]\ndiameter = 10\nribs = false\npoints = [[0, 0, 9], [300, 0, 9], [300, 300, 9]]\n"
    vertices_m = load_cage_text(tmp_path, content).parts[0].mesh.vertices_m
    straight = vertices_m[vertices_m[:, 0] < 0.2651]
    rings = np.unique(np.round(straight[:, 0], 9))
    # One diameter before the bend, which begins at 275 mm, and perpendicular to the segment.
    assert rings.tolist() == [0.0, 0.265]


SMALL_SURVEY = '[cameras]\nkind = "survey"\ndistances = [1000]\nviews_per_distance = 4\n'


def test_tables_name_environments_and_families() -> None:
    assert set(LIFE_SIZE_ENVIRONMENTS) < set(SURROUNDINGS)
    assert set(FORMWORK_FAMILIES) < set(FAMILIES)
    for name in LIFE_SIZE_ENVIRONMENTS:
        surroundings = SURROUNDINGS[name]
        assert surroundings.steel_radius_m > 3, "cages have diagonals of 5 m"
        assert set(surroundings.variants(PROPS_SLOT)) == {
            variant.name for variant in VARIANTS.values() if variant.slot == PROPS_SLOT
        }


@pytest.mark.parametrize("place", ["hall", "deck"])
def test_shadows_suit_only_places_with_room_for_the_screen(place: str, tmp_path: Path) -> None:
    assert "shadows" not in SURROUNDINGS[place].variants(LIGHT_SLOT)
    assert "dusk" in SURROUNDINGS[place].variants(LIGHT_SLOT)
    with pytest.raises(InputError) as raised:
        check_suitable(place, ("dusk", "shadows"))
    assert [(problem.code, problem.where) for problem in raised.value.problems] == [("conflict", "'shadows'")]
    config = scene_config(write_scene(tmp_path, f'environment = "{place}"\n' + MM + BAR))
    BuildRequest(configs=(), variants=("dusk",), scenes=(config,)).config_specs()
    with pytest.raises(InputError, match="laboratory, outdoors"):
        BuildRequest(configs=(), variants=("shadows",), scenes=(config,)).config_specs()


@pytest.mark.parametrize(("place", "limit_m"), [("hall", 10.4), ("deck", 8.3)])
def test_scene_file_names_hall_or_deck(place: str, limit_m: float, tmp_path: Path) -> None:
    head = f'environment = "{place}"\n' + MM
    config = scene_config(write_scene(tmp_path, head + BAR))
    assert isinstance(config.protocol, DomeSpec)
    assert (config.scene.environment, config.scene.board) == (place, None)
    ring = f'[cameras]\nkind = "ring"\nradius = {1000 * limit_m + 200:g}\nelevation_deg = 5\nazimuths = 4\n'
    with pytest.raises(
        InputError, match=rf"cameras are .* m from the world's origin, expected at most {limit_m} m in .* {place}"
    ):
        scene_config(write_scene(tmp_path, head + BAR + ring))
    high = '[cameras]\nkind = "ring"\nradius = 9000\nelevation_deg = 80\nazimuths = 4\n'
    with pytest.raises(InputError, match=r"cameras are .* m high, expected at most"):
        scene_config(write_scene(tmp_path, head + BAR + high))
    with pytest.raises(
        InputError, match=rf"the steel extends 6 m from the world's origin, expected at most 5 m in .* {place}"
    ):
        scene_config(write_scene(tmp_path, head + BAR.replace("100", "6000") + SMALL_SURVEY))
