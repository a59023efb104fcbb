"""Placement of cages: up, centring, rotation and translation, for bars, IFC models and meshes."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from dataset_builder.catalog.scene_file import scene_cage, scene_config
from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.specs.file_specs import Origin, PlacementSpec, Up
from dataset_builder.user_files.cage_file import cage_assembly
from dataset_builder.user_files.cage_placement import placed
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError, MeshError
from rebar_depth_bench.data.bars import Bar
from tests.builder.catalog.scene_files import BAR, MM, write_scene

COORDINATE = st.floats(-1e6, 1e6)


def cage_of(*axes_m: tuple[tuple[float, float, float], ...], diameter_m: float = 0.012) -> Cage:
    bars = [Bar(number, "bar", diameter_m, axis_m) for number, axis_m in enumerate(axes_m, start=1)]
    return Cage(tuple(CageBar(f"bar {bar.bar_id}", bar) for bar in bars))


def rods_at(x: float, y: float, z: float) -> Cage:
    return cage_of(((x, y, z), (x + 1.5, y, z + 0.1)), ((x, y + 0.3, z), (x, y + 0.3, z + 0.7)))


@given(COORDINATE, COORDINATE, COORDINATE, st.sampled_from(["z", "y"]), st.floats(-360, 360))
def test_centred_cage_is_the_same_wherever_the_file_has_it(
    x: float, y: float, z: float, up: Up, rotate_deg: float
) -> None:
    placement = PlacementSpec(up, "centre", rotate_deg)
    cage, at_origin = placed(rods_at(x, y, z), placement), placed(rods_at(0, 0, 0), placement)
    for bar, expected in zip(cage.bars, at_origin.bars, strict=True):
        shift_m = np.array(bar.bar.axis_m) - np.array(expected.bar.axis_m)
        assert np.abs(shift_m).max() <= 0.0021  # The box is centred by whole millimetres.
        np.testing.assert_allclose(shift_m - shift_m[0], 0, atol=1e-6)
    vertices_m = cage_assembly(cage, "a").vertices_m
    assert -1e-9 <= vertices_m[:, 2].min() <= 0.001 + 1e-9


@given(
    COORDINATE, COORDINATE, st.floats(-360, 360), st.sampled_from(["z", "y"]), st.sampled_from(["centre", "keep"])
)
def test_matrix_takes_source_points_to_the_world(
    x: float, y: float, rotate_deg: float, up: Up, origin: Origin
) -> None:
    source = rods_at(x, y, 3.0)
    cage = placed(source, PlacementSpec(up, origin, rotate_deg, (1.0, -2.0, 0.5)))
    for before, after in zip(source.bars, cage.bars, strict=True):
        points = np.column_stack([before.bar.axis_m, np.ones(2)]) @ cage.world_from_source.T
        np.testing.assert_allclose(points[:, :3], after.bar.axis_m, rtol=0, atol=1e-6)


def test_order_is_up_centre_rotation_translation() -> None:
    """A rod along the file's y axis at (5, 7, 9) stands upright; a quarter turn takes x to y."""
    upright = cage_of(((5.0, 7.0, 9.0), (5.0, 8.0, 9.0)), ((5.0, 7.0, 9.0), (6.0, 7.0, 9.0)))
    cage = placed(upright, PlacementSpec("y", "centre", 90.0, (0.0, 0.0, 2.0)))
    (foot, head), (_, end) = (np.array(bar.bar.axis_m) for bar in cage.bars)
    np.testing.assert_allclose(head - foot, (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(end - foot, (0, 1, 0), atol=1e-12)
    assert 2.0 <= foot[2] - 0.006 <= 2.002


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


def write_rods(path: Path, offset_m: float, dtype: str = "<f8") -> Path:
    """Write two rods as OBJ (64-bit numbers), or as STL (32-bit)."""
    rods = [
        trimesh.creation.cylinder(0.006, segment=[[0.0, y, 0.1], [0.5, y, 0.1]], sections=24) for y in (0.0, 0.1)
    ]
    for rod in rods:
        rod.vertices += offset_m
    if path.suffix == ".stl":
        trimesh.util.concatenate(rods).export(path)
        return path
    lines, first = [], 1
    for number, rod in enumerate(rods):
        lines += [f"o Rod {number}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in rod.vertices.tolist())]
        lines += ["f " + " ".join(str(corner + first) for corner in face) for face in rod.faces.tolist()]
        first += len(rod.vertices)
    path.write_text("\n".join(lines) + "\n")
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
    with pytest.raises(MeshError, match=r"no part is selected.*2 parts, such as Rod 0"):
        scene_cage(write_scene(tmp_path, f"{keys}[[select]]\nname = 'x'\n"))


def test_mesh_file_alone_keeps_its_coordinates(tmp_path: Path) -> None:
    cage = scene_cage(write_rods(tmp_path / "a.obj", 3.0), "cm")
    np.testing.assert_array_equal(cage.world_from_source, np.diag([0.01, 0.01, 0.01, 1]))


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
