"""Import of users' mesh files: numbering of bars, axes, units and rejected files."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import Assembly, WorldMesh
from dataset_builder.specs.config_specs import LatticeSpec
from dataset_builder.user_files.cage_file import load_cage, mesh_file_spec, read_cage
from rebar_depth_bench.base.errors import MeshError
from tests.builder.user_files.tube_shapes import (
    CENTRELINES_M,
    RODS,
    concatenated,
    length_m,
    load_content,
    obj_bytes,
    rod,
    swept,
)


def diameters_mm(assembly: Assembly) -> list[int]:
    return [round(bar.diameter_m * 1000) for bar in assembly.bars]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_lattice_round_trips_through_every_format(tmp_path: Path, suffix: str) -> None:
    lattice = lattice_assembly(replace(LatticeSpec(), extent_m=0.040))
    meshes = [part.mesh for part in lattice.parts]
    bodies = [trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False) for mesh in meshes]
    names = [f"rod {number}" for number in range(1, 13)]  # Natural order: "rod 10" after "rod 9".
    whole, path = concatenated(bodies), tmp_path / f"a{suffix}"
    if suffix == ".ply":
        bar_id = np.repeat(range(1, 13), [len(body.faces) for body in bodies])
        write_mesh_ply(path, WorldMesh(whole.vertices, whole.faces, bar_id))
    else:
        path.write_bytes(obj_bytes(bodies, names) if suffix == ".obj" else trimesh.exchange.stl.export_stl(whole))

    imported = load_cage(mesh_file_spec(path, "m"))

    assert [bar.bar_id for bar in imported.bars] == [part.bar_id for part in imported.parts] == list(range(1, 13))
    for bar, original in zip(imported.bars, lattice.bars, strict=True):
        same_way = np.vdot(np.diff(bar.axis_m, axis=0), np.diff(original.axis_m, axis=0)) > 0
        np.testing.assert_allclose(bar.axis_m[:: 1 if same_way else -1], original.axis_m, rtol=0, atol=1e-4)
        assert bar.role == "imported"
        assert bar.diameter_m == pytest.approx(original.diameter_m, rel=0.05)
    for part, mesh in zip(imported.parts, meshes, strict=True):
        assert (part.name, part.material) == (f"imported-{part.bar_id:03d}", "steel")
        assert (part.mesh.vertices_m.dtype, part.mesh.faces.dtype) == (np.float64, np.int32)
        corners = part.mesh.vertices_m[part.mesh.faces]
        np.testing.assert_allclose(corners, mesh.vertices_m[mesh.faces], rtol=0, atol=2e-8)
        if suffix == ".ply":
            np.testing.assert_array_equal(part.mesh.vertices_m, mesh.vertices_m)
            np.testing.assert_array_equal(part.mesh.faces, mesh.faces)


def test_dataset_ply_keeps_bar_ids_and_skips_board(tmp_path: Path) -> None:
    inside_out = RODS[1].copy()
    inside_out.invert()
    bodies = (RODS[0], trimesh.creation.box((2, 2, 0.01)), inside_out)
    whole = concatenated(bodies)
    bar_id = np.repeat([40_000, 0, 7], [len(body.faces) for body in bodies])
    write_mesh_ply(tmp_path / "a.ply", WorldMesh(whole.vertices, whole.faces, bar_id))
    parts = load_cage(mesh_file_spec(tmp_path / "a.ply", "m")).parts
    assert [(part.bar_id, part.name) for part in parts] == [(7, "imported-007"), (40_000, "imported-40000")]
    np.testing.assert_array_equal(parts[0].mesh.faces, inside_out.faces)
    np.testing.assert_array_equal(parts[1].mesh.vertices_m, RODS[0].vertices)
    in_feet = load_cage(mesh_file_spec(tmp_path / "a.ply", "ft")).parts[1].mesh.vertices_m
    np.testing.assert_array_equal(in_feet, RODS[0].vertices * 0.3048)
    write_mesh_ply(tmp_path / "a.ply", WorldMesh(whole.vertices, whole.faces, bar_id * 0))
    with pytest.raises(MeshError, match="every face has bar_id 0"):
        load_cage(mesh_file_spec(tmp_path / "a.ply", "m"))
    with pytest.raises(MeshError, match=f"^{tmp_path}/b.ply: truncated or damaged"):
        load_content(tmp_path, "b.ply", (tmp_path / "a.ply").read_bytes()[:-1])


def test_huge_coordinates_are_refused_without_warnings(tmp_path: Path) -> None:
    huge = WorldMesh(RODS[0].vertices * 1e234, RODS[0].faces, np.ones(len(RODS[0].faces), np.uint16))
    write_mesh_ply(tmp_path / "a.ply", huge)
    with warnings.catch_warnings(action="error"), pytest.raises(MeshError, match=r"extends 5e\+233 m"):
        load_cage(mesh_file_spec(tmp_path / "a.ply", "m"))


def test_triangle_soup_is_split_in_order_of_first_face(tmp_path: Path) -> None:
    """Split two rods whose faces alternate and whose vertices are stored in reverse order."""
    first, second = RODS[2], RODS[1]
    faces = np.stack([first.faces + len(second.vertices), second.faces], axis=1).reshape(-1, 3)
    soup = trimesh.Trimesh(np.concatenate([second.vertices, first.vertices]), faces, process=False)
    solids = "".join(trimesh.exchange.stl.export_stl_ascii(body) + "\n" for body in (first, second))
    for name, content in {
        "a.stl": trimesh.exchange.stl.export_stl(soup),
        "text.stl": solids.replace("\n", "\r\n"),
        "a.ply": trimesh.exchange.ply.export_ply(soup),
        "text.PLY": trimesh.exchange.ply.export_ply(soup, encoding="ascii"),
    }.items():
        assembly = load_content(tmp_path, name, content)
        assert diameters_mm(assembly) == [20, 10]
        assert [len(part.mesh.vertices_m) for part in assembly.parts] == [130, 130]


def test_objects_are_numbered_by_name(tmp_path: Path) -> None:
    content = obj_bytes(RODS, ("bar10", "bar9", "bar1"))
    assert diameters_mm(load_content(tmp_path, "a.obj", content)) == [20, 10, 16]


def test_object_of_two_pieces_is_one_bar(tmp_path: Path) -> None:
    lines = obj_bytes((concatenated(RODS[:2]), RODS[2]), "ab").split(b"\n")
    content = b"\n".join([*lines[:400], b"usemtl paint", b"g group", *lines[400:]])
    assert [len(part.mesh.faces) for part in load_content(tmp_path, "a.obj", content).parts] == [512, 256]


def test_polygons_are_triangulated_and_oriented_outward(tmp_path: Path) -> None:
    square = "v 0 0 0\nv .1 0 0\nv .1 .1 0\nv 0 .1 0\nf 1 2 \\\n3 4\n"
    mesh = load_content(tmp_path, "a.obj", square).parts[0].mesh
    assert trimesh.Trimesh(mesh.vertices_m, mesh.faces).area == pytest.approx(0.01)
    inside_out = RODS[0].copy()
    inside_out.invert()
    for part in load_content(tmp_path, "b.obj", obj_bytes((inside_out, RODS[1]), "ab")).parts:
        assert trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces).is_volume


@pytest.mark.parametrize(
    ("unit", "per_metre"),
    [("m", 1), ("cm", 100), ("mm", 1000), ("in", 1 / 0.0254), ("ft", 1 / 0.3048), (0.5, 2)],
)
def test_units_scale_vertices(tmp_path: Path, unit: str | float, per_metre: float) -> None:
    assembly = load_content(tmp_path, "a.obj", obj_bytes(RODS, "abc", per_metre), unit)
    assert diameters_mm(assembly) == [16, 10, 20]
    np.testing.assert_allclose(assembly.parts[1].mesh.vertices_m, RODS[1].vertices, atol=1e-12)


def test_axis_and_diameter_of_open_tube_far_from_origin(tmp_path: Path) -> None:
    """Fit a tube one end of which is open and one side of which is finely tessellated."""
    tube = rod(0.016)
    tube.update_faces(tube.face_normals[:, 0] < 0.5)
    for _ in range(3):
        x, y, _ = tube.triangles_center.T
        tube = tube.subdivide(np.flatnonzero((x > 0.26) & (y > 0)))
    tube.apply_translation([300, -200, 500])
    (tmp_path / "a.obj").write_bytes(obj_bytes((tube,), "a"))
    bar = read_cage(mesh_file_spec(tmp_path / "a.obj", "m")).bars[0].bar
    np.testing.assert_allclose(bar.axis_m, [[300.0, -200, 500.1], [300.5, -200, 500.1]], rtol=0, atol=2e-6)
    assert bar.diameter_m == pytest.approx(0.016, rel=0.005)


def test_parts_that_are_no_round_bar_have_no_axis_and_are_named(tmp_path: Path) -> None:
    """A note names a wedge, and a part of two rods, which stays one part; a bent bar gets its bent axis."""
    ends = [[x, y, z] for x in (0.0, 1.0) for y, z in ((0.0, 0.0), (0.03, 0.0), (0.0, 0.04))]
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    line_m = CENTRELINES_M["U-bar"]
    u_bar = swept(line_m, 12)
    bodies = (
        trimesh.Trimesh(ends, faces),
        concatenated(RODS[:2]),
        trimesh.Trimesh(u_bar.vertices_m, u_bar.faces),
        RODS[2],
    )
    assembly = load_content(tmp_path, "a.obj", obj_bytes(bodies, "abcd"))
    assert [bar.has_axis for bar in assembly.bars] == [False, False, True, True]
    assert len(assembly.bars[3].axis_m) == 2
    assert assembly.bars[2].length_m == pytest.approx(length_m(line_m), rel=1e-4)
    (note,) = assembly.notes
    assert (note.source, note.code) == (str(tmp_path / "a.obj"), "axis")
    assert "2 of 4 " in note.text
    assert "bar 1, a, bar 2, b" in note.text
    assert load_content(tmp_path, "b.obj", obj_bytes(RODS, "abc")).notes == ()


def test_invalid_mesh_paths_and_units_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    with pytest.raises(MeshError, match="cannot be read: No such file"):
        mesh_file_spec(path, "m")
    path.write_bytes(trimesh.exchange.stl.export_stl(RODS[0]))
    with pytest.raises(MeshError, match="unknown unit 'km', expected one of m, cm, mm, in, ft"):
        mesh_file_spec(path, "km")
    for unit_m in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(MeshError, match="expected a positive length"):
            mesh_file_spec(path, unit_m)
    with pytest.raises(MeshError, match=r"unsupported mesh file type '.step', expected .obj, .ply, .stl$"):
        mesh_file_spec(tmp_path / "a.step", "m")
    for unit_m in (1000, 1e-6, 1e200):
        with pytest.raises(MeshError, match="is the unit right"):
            load_cage(mesh_file_spec(path, unit_m))
    spec = mesh_file_spec(path, "m")
    path.write_bytes(trimesh.exchange.stl.export_stl(RODS[1]))
    with pytest.raises(
        MeshError, match=f"changed since it was selected: its sha256 is .*, expected {spec.sha256}"
    ):
        load_cage(spec)


@pytest.mark.slow
def test_more_than_65535_parts_are_rejected(tmp_path: Path) -> None:
    corners = np.arange(65_536)[:, None, None] * [1e-4, 0, 0] + [[0, 0, 0], [5e-5, 0, 0], [0, 0.1, 0]]
    soup = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * 65_536).reshape(-1, 3), process=False)
    with pytest.raises(MeshError, match="65536 separate parts found, expected at most 65535 bars"):
        load_content(tmp_path, "a.stl", trimesh.exchange.stl.export_stl(soup))
