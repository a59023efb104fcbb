"""Mesh files of users: numbering of bars, axes, units, files of other programs, and damaged and hostile files."""

from __future__ import annotations

import os
import re
import struct
import time
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
from dataset_builder.specs.file_specs import Selection
from dataset_builder.user_files import mesh_import
from dataset_builder.user_files.cage_file import load_cage, mesh_file_spec, read_cage
from rebar_depth_bench.base.errors import MeshError
from rebar_depth_bench.base.limits import MESH_SECONDS
from tests.builder.scene.cages import line_length_m
from tests.builder.user_files.tube_shapes import (
    CENTRELINES_M,
    RODS,
    concatenated,
    load_content,
    obj_bytes,
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


def test_objects_are_bars_numbered_by_name(tmp_path: Path) -> None:
    content = obj_bytes(RODS, ("bar10", "bar9", "bar1"))
    assert diameters_mm(load_content(tmp_path, "a.obj", content)) == [20, 10, 16]
    lines = obj_bytes(RODS[:2], "ab").split(b"\n")
    content = b"\n".join([*lines[:200], b"usemtl paint", b"g group", *lines[200:]])
    assert [len(part.mesh.faces) for part in load_content(tmp_path, "a.obj", content).parts] == [256, 256]


def test_object_of_several_bars_is_split(tmp_path: Path) -> None:
    """Bars of a layer are found by its name and by their own; a piece that is no bar keeps an object whole."""
    path = tmp_path / "a.obj"
    path.write_bytes(obj_bytes((concatenated(RODS[:2]), RODS[2]), ("layer", "single")))
    bars = read_cage(mesh_file_spec(path, "m")).bars
    assert [(bar.source, round(bar.bar.diameter_m * 1000)) for bar in bars] == [
        ("layer 1", 16),
        ("layer 2", 10),
        ("single", 20),
    ]
    for pattern, sources in (("layer", ["layer 1", "layer 2"]), ("layer 2", ["layer 2"])):
        spec = mesh_file_spec(path, "m", None, (Selection((("name", pattern),)),))
        assert [bar.source for bar in read_cage(spec).bars] == sources
    plate = trimesh.creation.box((0.1, 0.2, 0.01), trimesh.transformations.translation_matrix((0, 1, 0)))
    path.write_bytes(obj_bytes((concatenated((RODS[0], plate)), RODS[2]), ("layer", "single")))
    bars = read_cage(mesh_file_spec(path, "m")).bars
    assert [(bar.source, bar.bar.has_axis) for bar in bars] == [("layer", False), ("single", True)]


def test_time_for_finding_bars_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_import, "MESH_SECONDS", replace(MESH_SECONDS, default=0))
    for name, content in (("a.stl", BINARY_STL), ("a.obj", obj_bytes(RODS, "abc"))):
        with pytest.raises(MeshError, match=r"more than 0 s of processor time, .* REBAR_MAX_MESH_SECONDS raises"):
            load_content(tmp_path, name, content)


def test_polygons_are_triangulated_and_oriented_outward(tmp_path: Path) -> None:
    square = "v 0 0 0\nv .1 0 0\nv .1 .1 0\nv 0 .1 0\nf 1 2 \\\n3 4\n"
    mesh = load_content(tmp_path, "a.obj", square).parts[0].mesh
    assert trimesh.Trimesh(mesh.vertices_m, mesh.faces).area == pytest.approx(0.01)
    inside_out = RODS[0].copy()
    inside_out.invert()
    for part in load_content(tmp_path, "b.obj", obj_bytes((inside_out, RODS[1]), "ab")).parts:
        assert trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces).is_volume


UNITS = [("m", 1), ("cm", 100), ("mm", 1000), ("in", 1 / 0.0254), ("ft", 1 / 0.3048), (0.5, 2)]


@pytest.mark.parametrize(("unit", "per_metre"), UNITS)
def test_units_scale_vertices(tmp_path: Path, unit: str | float, per_metre: float) -> None:
    assembly = load_content(tmp_path, "a.obj", obj_bytes(RODS, "abc", per_metre), unit)
    assert diameters_mm(assembly) == [16, 10, 20]
    np.testing.assert_allclose(assembly.parts[1].mesh.vertices_m, RODS[1].vertices, atol=1e-12)


def test_parts_that_are_no_round_bar_have_no_axis_and_are_named(tmp_path: Path) -> None:
    """A note names a wedge, and an object of two wedges, which stays one; a bent bar gets its bent axis."""
    ends = [[x, y, z] for x in (0.0, 1.0) for y, z in ((0.0, 0.0), (0.03, 0.0), (0.0, 0.04))]
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    line_m = CENTRELINES_M["U-bar"]
    u_bar = swept(line_m, 12)
    u_body = trimesh.Trimesh(u_bar.vertices_m, u_bar.faces)
    wedge = trimesh.Trimesh(ends, faces)
    bodies = (wedge, concatenated((wedge, wedge.copy().apply_translation([0, 1, 0]))), u_body, RODS[2])
    assembly = load_content(tmp_path, "a.obj", obj_bytes(bodies, "abcd"))
    assert [bar.has_axis for bar in assembly.bars] == [False, False, True, True]
    assert len(assembly.bars[3].axis_m) == 2
    assert assembly.bars[2].length_m == pytest.approx(line_length_m(line_m), rel=1e-4)
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
    with pytest.raises(MeshError, match=f"changed since .*: its sha256 is .*, expected {spec.sha256}"):
        load_cage(spec)


@pytest.mark.slow
def test_more_than_65535_parts_are_rejected(tmp_path: Path) -> None:
    corners = np.arange(65_536)[:, None, None] * [1e-4, 0, 0] + [[0, 0, 0], [5e-5, 0, 0], [0, 0.1, 0]]
    soup = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * 65_536).reshape(-1, 3), process=False)
    with pytest.raises(MeshError, match="65536 separate parts found, expected at most 65535 bars"):
        load_content(tmp_path, "a.stl", trimesh.exchange.stl.export_stl(soup))


STL = trimesh.exchange.stl.export_stl_ascii(RODS[0])
BINARY_STL = trimesh.exchange.stl.export_stl(RODS[0])
BINARY_PLY = trimesh.exchange.ply.export_ply(RODS[0])
PLY = trimesh.exchange.ply.export_ply(RODS[0], encoding="ascii").decode()
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
MANY_PROPERTIES = "ply\nformat ascii 1.0\nelement face 1500000\n" + "".join(
    f"property char {number:x}\n" for number in range(3000)
)
HEADER = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"


INVALID_OBJ: dict[str, tuple[bytes | str, str]] = {
    "empty": ("", "no triangle found"),
    "points only": (TRIANGLE, "no triangle found"),
    "corner beyond": (TRIANGLE + "f 1 2 9", "line 4: a corner is vertex 9, expected 1 to 3"),
    "corner 0": (TRIANGLE + "f 0 1 2", "line 4: a corner is vertex 0, expected 1 to 3"),
    "corner before": (TRIANGLE + "f -3 -2 -4", "line 4: a corner is vertex 0, expected 1 to 3"),
    "no number": (TRIANGLE + "f 1 2 x", "line 4: found f 1 2 x, expected .* f with three or more corners"),
    "two corners": (TRIANGLE + "f 1 2 3\nf 1 2", "line 5: found f 1 2, expected .* three or more"),
    "two coordinates": ("v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3", "line 2: found v 1 0, expected v with 3"),
    "four coordinates": (TRIANGLE + "v 1 2 3 4\nf 1 2 3", "line 4: a vertex of 4 numbers"),
    "underscore": (TRIANGLE + "v 1_0 0 0\nf 1 2 3", "line 4: found v 1_0 0 0, expected v with 3"),
    "damaged v": (TRIANGLE + "w 0 0 0\nf 1 2 3", "line 4: found w 0 0 0, expected v with 3"),
    "damaged f": (TRIANGLE + "f 1 2 3\ne 1//1 2//1 3//1", "line 5: found e 1//1 2//1 3//1, expected v with 3"),
    "surface": (TRIANGLE + "f 1 2 3\nsurf 0 1 0 1 1 2 3", "line 5: found surf 0 1"),
    "nan": (TRIANGLE + "v nan 0 0\nf 1 2 4", "line 4: found v nan 0 0, expected v with 3"),
    "no area": (
        TRIANGLE + "f 1 2 2",
        "part 1 .1 triangles. is not a valid .*: every triangle has zero area",
    ),
}
INVALID_STL: dict[str, tuple[bytes | str, str]] = {
    "empty": ("", "has 0 bytes, expected 84, or a text"),
    "cut binary": (BINARY_STL[:-1], "the header counts 256 triangles, but the file has 12883 bytes"),
    "long binary": (BINARY_STL + bytes(50), "counts 256 triangles.* 12934 bytes, expected 12884"),
    "cut text": (STL[:-80], "line 1787: found facet normal.*, expected .* facets of three vertices"),
    "no endsolid": (STL.replace("endsolid", ""), "the file ends, expected .* facets .* and .endsolid"),
    "quadrilateral": (STL.replace("endloop", "vertex 0 0 0\nendloop", 1), "line 2: found facet normal"),
    "letter in a number": (
        STL.replace("vertex 0", "vertex O", 1),
        "line 2: found facet normal.*, expected .* three numbers",
    ),
    "inf in a second solid": (STL + "\n" + STL.replace("vertex 0.0", "vertex inf", 1), "line 1798: found facet"),
}
LINES = "element face 1\nproperty list uchar int a\nend_header\n0 0 0\n2 0 0\n"
HUGE_LIST = HEADER.replace("ascii", "binary_little_endian")
HUGE_LIST += "element face 1\nproperty list uint64 double vertex_indices\nend_header\n"
INVALID_PLY: dict[str, tuple[bytes | str, str]] = {
    "empty": ("", "no PLY header"),
    "half a header": (PLY[:60], "no PLY header"),
    "no y": (PLY.replace("float y", "float w"), "header: no vertices with the properties x, y and z"),
    "cut text": (PLY[: PLY.rindex("3 ")], "385 rows after the header, expected 386"),
    "cut in a number": (PLY[:-1], "the last row has no line end"),
    "long text": (PLY + "3 0 1 2\n", "387 rows after the header, expected 386"),
    "fewer faces": (PLY.replace("face 256", "face 255"), "386 rows after the header, expected 385"),
    "split row": (PLY.replace("\n3 ", "\n3\n", 1), "387 rows after the header, expected 386"),
    "short row": (PLY.replace("\n3 ", "\n4 ", 1), "face 0: found 4 .*, expected the numbers"),
    "word": (PLY.replace("\n3 ", "\nthree ", 1), "face 0: found three .*, expected the numbers"),
    "corner beyond": (PLY.replace("\n3 ", "\n3 999", 1), "triangle 1: the corners are the vertices .999"),
    "corner 0.5": (PLY.replace("\n3 ", "\n3 0.5", 1), "a corner is vertex 0.5"),
    "cut binary": (BINARY_PLY[:-1], "the file ends within the 256 rows of face"),
    "long binary": (BINARY_PLY + b"a", "1 bytes after the last row"),
    "huge binary": (BINARY_PLY.replace(b"vertex 130", b"vertex 99999999999999"), "within the 99999999999999 rows"),
    "huge list": (HUGE_LIST.encode() + bytes(12) + b"\xff" * 8, "the file ends within the 1 rows of face"),
    "no faces": (HEADER + "element face 0\nproperty list uchar int a\nend_header\n0 0 0\n", "no triangle"),
    "lines": (HEADER + LINES, "face 0: 2 corners, expected three or more"),
    "element twice": (
        HEADER + "element vertex 1\nend_header\n",
        "line 7: found element vertex 1, expected .* once",
    ),
    "property twice": (HEADER + "property int x\nend_header\n", "line 7: found property int x, expected .* once"),
    "unknown type": (PLY.replace("float z", "quad z"), "line 7: found property quad z"),
    "foreign bar_id": (PLY.replace("end_h", "property int bar_id\nend_h"), "has the property bar_id, but not"),
}
INVALID_FILES = {
    f"{name}{suffix}": (suffix, *case)
    for suffix, cases in ((".obj", INVALID_OBJ), (".stl", INVALID_STL), (".ply", INVALID_PLY))
    for name, case in cases.items()
}


@pytest.mark.parametrize(("suffix", "content", "words"), INVALID_FILES.values(), ids=INVALID_FILES)
def test_invalid_mesh_file_is_refused_with_its_place(
    tmp_path: Path, suffix: str, content: bytes | str, words: str
) -> None:
    with pytest.raises(MeshError, match=words) as caught:
        load_content(tmp_path, "a" + suffix, content)
    assert str(caught.value).startswith(f"{tmp_path / 'a'}{suffix}: ")
    assert "\n" not in str(caught.value)


PLY_LIKE_MESHLAB = (
    "ply\r\nformat ascii 1.0\r\ncomment VCGLIB generated\r\nobj_info by hand, caf\x85\r\nelement vertex 130\r\n"
    "property double x\r\nproperty double y\r\nproperty double z\r\nproperty uchar red\r\nproperty uchar green\r\n"
    "property uchar blue\r\nelement face 256\r\nproperty list uint8 uint32 vertex_index\r\n"
    "property float quality\r\nelement camera 1\r\nproperty list int float values\r\nend_header\r\n"
    + "".join(f"{x!r} {y!r} {z!r} 255 0 0 \r\n" for x, y, z in RODS[0].vertices.tolist())
    + "".join(f"3 {a} {b} {c} -nan(ind)\r\n" for a, b, c in RODS[0].faces.tolist())
    + "4 1 2.5 3 4\r\n\r\n"
)


_LINES, _, _BODY = BINARY_PLY.replace(
    b"element vertex", b"element mark 1\nproperty uchar a\nelement vertex"
).partition(b"end_header\n")
PLY_LIKE_RHINO = _LINES.replace(b"\n", b"\r") + b"end_header\r\n" + _BODY
"""PLY whose lines end with CR; the value of the first element, a line feed, follows."""


def big_endian_ply() -> bytes:
    """Return a PLY with a triangle, a quadrilateral and a pentagon, of different list lengths."""
    header = (
        "ply\nformat binary_big_endian 1.0\nelement face 3\nproperty list uchar int vertex_indices\n"
        "property uchar flags\nelement vertex 7\nproperty float x\nproperty float y\nproperty double z\n"
        "end_header\n"
    )
    polygons = [(0, 1, 2), (0, 2, 3, 4), (0, 4, 5, 6, 1)]
    faces = b"".join(struct.pack(f">B{len(item)}iB", len(item), *item, 7) for item in polygons)
    angles = np.linspace(0, 2 * np.pi, 7).tolist()
    vertices = b"".join(struct.pack(">ffd", np.cos(angle), np.sin(angle), 0.1) for angle in angles)
    return header.encode() + faces + vertices


OBJ_LIKE_RHINO = (
    "# Rhino\r\n#c:\\work\\\r\nmtllib pipe.mtl\r\nusemtl pipe\r\ng all#1\r\no bar#1 \xe9\r\n"
    + "".join(f"  v\t{x!r} {y!r}  {z!r} 0.5 .5 1e0\r\n" for x, y, z in RODS[0].vertices.tolist())
    + "vn 0 0 1\r\nvt 0 1\r\ns off\r\n"
    + "".join(
        f"f {a - 130}/1/-1 {b - 130}/1/-1 \\\r\n  {c - 130}/1/-1 # face\r\n" for a, b, c in RODS[0].faces.tolist()
    )
    + "v 0 0 0\r\np 1\r\nl 1 2\r\nshadow_obj none\r\nalias OBJ file"
).encode("latin-1")


SOUND_FILES: dict[str, tuple[str, bytes | str]] = {
    "meshlab ply": (".ply", PLY_LIKE_MESHLAB.encode("latin-1")),
    "ply with a line end": (".ply", BINARY_PLY + b"\n"),
    "text ply with carriage returns": (".ply", PLY_LIKE_MESHLAB.replace("\n", "").encode("latin-1")),
    "ply with carriage returns": (".ply", PLY_LIKE_RHINO),
    "rhino obj": (".obj", OBJ_LIKE_RHINO),
    "obj with a byte order mark": (".obj", b"\xef\xbb\xbf" + obj_bytes(RODS[:1], "a")),
    "stl that begins with solid": (".stl", b"solid of a CAD program".ljust(80) + BINARY_STL[80:]),
    "stl with colours": (".stl", BINARY_STL[:84] + re.sub(b"(?s)(.{48})..", b"\\1\xff\x7f", BINARY_STL[84:])),
    "upper case stl": (".stl", STL.upper().replace("\n", " \r\n   ")),
    "stl without normals": (".stl", re.sub("normal .*", "normal nan -nan(ind) 0", STL)),
    "stl with padding": (".stl", STL.replace("endsolid", "endsolid bar 1") + "\x1a\0\0"),
}


@pytest.mark.parametrize(("suffix", "content"), SOUND_FILES.values(), ids=SOUND_FILES)
def test_files_of_other_programs_are_read(tmp_path: Path, suffix: str, content: bytes | str) -> None:
    """Read files whose material library is a named pipe, which would block if it was opened."""
    os.mkfifo(tmp_path / "pipe.mtl")
    assembly = load_content(tmp_path, "a" + suffix, content)
    assert assembly.bars[0].diameter_m == pytest.approx(0.016, rel=0.01)
    assert len(assembly.parts[0].mesh.faces) == len(RODS[0].faces)


OBJ_POLYGONS = "".join(f"v {x} {y} .1\n" for x, y in ((1, 0), (2, 0), (2, 1), (1, 2), (0, 2), (0, 1), (1, 0)))
OBJ_POLYGONS += "f 1 2 3\nf 1 3 4 5\nf 1 5 6 7 2\n"


@pytest.mark.parametrize("suffix", [".ply", ".obj"])
def test_polygons_of_different_sizes_are_read(tmp_path: Path, suffix: str) -> None:
    content = big_endian_ply() if suffix == ".ply" else OBJ_POLYGONS
    mesh = load_content(tmp_path, "a" + suffix, content).parts[0].mesh
    assert (len(mesh.faces), len(mesh.vertices_m)) == (6, 6)  # The first and last vertex are the same point.
    assert np.unique(mesh.vertices_m[:, 2]).tolist() == [0.1]


def test_relative_indices_count_from_their_line(tmp_path: Path) -> None:
    lines = ["v 0 0 0", "v .1 0 0", "v 0 .1 0", "f -3 -2 -1", "v 0 0 5", "v 0 0 6", "v .1 0 5", "f -1 -2 -3"]
    mesh = load_content(tmp_path, "a.obj", "\n".join(lines)).parts
    assert [part.mesh.vertices_m[:, 2].max() for part in mesh] == [0, 6]


def test_pipes_and_large_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "zero.ply").symlink_to("/dev/zero")
    for name, words in (("pipe.stl", "it is a named pipe"), ("zero.ply", "it is a device")):
        with pytest.raises(MeshError, match=words):
            mesh_file_spec(tmp_path / name, "m")
    (tmp_path / "link.stl").symlink_to(tmp_path / "a.stl")
    load_content(tmp_path, "a.stl", BINARY_STL)
    assert load_cage(mesh_file_spec(tmp_path / "link.stl", "m")).bars
    monkeypatch.setenv("REBAR_MAX_MESH_BYTES", str(len(BINARY_STL) - 1))
    with pytest.raises(MeshError, match="REBAR_MAX_MESH_BYTES raises the limit"):
        mesh_file_spec(tmp_path / "a.stl", "m")


HOSTILE_TEXTS = {
    "blanks.stl": "solid\nfacet" + " " * 1_000_000,
    "normals.stl": "solid\n" + "facet normal 0 0 1\n" * 50_000,
    "digits.obj": TRIANGLE + "q " + "1" * 1_000_000 + "x\nf 1 2",
    "slashes.obj": TRIANGLE + "f " + "1/" * 500_000,
    "vertex.obj": TRIANGLE + "v " + "1" * 1_000_000 + "x 0 0",
    "digits.ply": PLY.replace("\n3 ", "\n" + "3" * 1_000_000 + "x ", 1),
    "lines.ply": "ply\n" + " \n" * 1_000_000,
    "properties.ply": MANY_PROPERTIES + "end_header\n" + "1\n" * 1_500_000,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE_TEXTS)
def test_hostile_texts_are_refused_in_linear_time(tmp_path: Path, name: str) -> None:
    start = time.process_time()
    with pytest.raises(MeshError):
        load_content(tmp_path, name, HOSTILE_TEXTS[name])
    assert time.process_time() - start < 10
