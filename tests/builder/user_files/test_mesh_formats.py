"""Damaged, truncated and hostile mesh files, and the files that other programs write."""

from __future__ import annotations

import os
import re
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dataset_builder.user_files.cage_file import load_cage, mesh_file_spec
from rebar_depth_bench.base.errors import MeshError
from tests.builder.user_files.tube_shapes import RODS, load_content, obj_bytes

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
    "corner before": (TRIANGLE + "f -3 -2 -4", "line 4: a corner is vertex -4, expected 1 to 3"),
    "no number": (TRIANGLE + "f 1 2 x", "line 4: found f 1 2 x, expected three or more corners"),
    "two corners": (TRIANGLE + "f 1 2 3\nf 1 2", "line 5: found f 1 2, expected three or more"),
    "two coordinates": ("v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3", "line 2: a vertex of 2 numbers"),
    "four coordinates": (TRIANGLE + "v 1 2 3 4\nf 1 2 3", "line 4: a vertex of 4 numbers"),
    "underscore": (TRIANGLE + "v 1_0 0 0\nf 1 2 3", "line 4: got 1_0, expected a number"),
    "damaged v": (TRIANGLE + "w 0 0 0\nf 1 2 3", 'line 4: found w 0 0 0, expected "v"'),
    "damaged f": (TRIANGLE + "f 1 2 3\ne 1//1 2//1 3//1", 'line 5: found e 1//1 2//1 3//1, expected "v"'),
    "surface": (TRIANGLE + "f 1 2 3\nsurf 0 1 0 1 1 2 3", "line 5: found surf, expected polygons"),
    "nan": (TRIANGLE + "v nan 0 0\nf 1 2 4", "line 4: a vertex is .nan, 0.0, 0.0., expected finite"),
    "no area": (
        TRIANGLE + "f 1 2 2",
        "part 1 .1 triangles. is not a valid .*: every triangle has zero area",
    ),
}
INVALID_STL: dict[str, tuple[bytes | str, str]] = {
    "empty": ("", "0 bytes, expected a text or binary STL"),
    "cut binary": (BINARY_STL[:-1], "the header counts 256 triangles, but the file has 12883 bytes"),
    "long binary": (BINARY_STL + bytes(50), "counts 256 triangles.* 12934 bytes, expected 12884"),
    "cut text": (STL[:-80], "line 1787: found facet normal.*, expected a facet of three vertices"),
    "no endsolid": (STL.replace("endsolid", ""), "the file ends, expected a facet .* or .endsolid"),
    "quadrilateral": (STL.replace("endloop", "vertex 0 0 0\nendloop", 1), "line 2: found facet normal"),
    "letter in a number": (STL.replace("vertex 0", "vertex O", 1), "triangle [0-9]+: got O.*, expected a number"),
    "inf in a second solid": (STL + "\n" + STL.replace("vertex 0.0", "vertex inf", 1), "finite"),
}
NO_FACES = "element face 0\nproperty list uchar int a\nend_header\n0 0 0\n"
LINES = "element face 1\nproperty list uchar int a\nend_header\n0 0 0\n2 0 0\n"
HUGE_LIST = (HEADER + "element face 1\nproperty list uint64 double vertex_indices\nend_header\n").replace(
    "ascii", "binary_little_endian"
)
TWICE = "header: an element or property occurs twice"
INVALID_PLY: dict[str, tuple[bytes | str, str]] = {
    "empty": ("", "no PLY header"),
    "half a header": (PLY[:60], "no PLY header"),
    "no y": (PLY.replace("float y", "float w"), "header: no vertices with the properties x, y and z"),
    "cut text": (PLY[: PLY.rindex("3 ")], "385 rows after the header, expected 386"),
    "cut in a number": (PLY[:-1], "the last row has no line end"),
    "long text": (PLY + "3 0 1 2\n", "387 rows after the header, expected 386"),
    "fewer faces": (PLY.replace("face 256", "face 255"), "386 rows after the header, expected 385"),
    "split row": (PLY.replace("\n3 ", "\n3\n", 1), "387 rows after the header, expected 386"),
    "short row": (PLY.replace("\n3 ", "\n4 ", 1), "face 0: found 4 .*, expected the values"),
    "word": (PLY.replace("\n3 ", "\nthree ", 1), "face 0: got three, expected a number"),
    "corner beyond": (PLY.replace("\n3 ", "\n3 999", 1), "triangle 0: the corners are the vertices .999"),
    "corner 0.5": (PLY.replace("\n3 ", "\n3 0.5", 1), "a corner is vertex 0.5"),
    "cut binary": (BINARY_PLY[:-1], "the file ends within the 256 rows of face"),
    "long binary": (BINARY_PLY + b"a", "1 bytes after the last row"),
    "huge binary": (BINARY_PLY.replace(b"vertex 130", b"vertex 99999999999999"), "within the 99999999999999 rows"),
    "huge list": (HUGE_LIST.encode() + bytes(12) + b"\xff" * 8, "the file ends within the 1 rows of face"),
    "no faces": (HEADER + NO_FACES, "no triangle"),
    "lines": (HEADER + LINES, "face 0: 2 corners, expected three or more"),
    "element twice": (HEADER + "element vertex 1\nend_header\n", TWICE),
    "property twice": (HEADER + "property int x\nend_header\n", TWICE),
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
    + "".join(f"3 {a} {b} {c} nan\r\n" for a, b, c in RODS[0].faces.tolist())
    + "4 1 2.5 3 4\r\n\r\n"
)


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


def test_polygons_of_different_sizes_are_read(tmp_path: Path) -> None:
    mesh = load_content(tmp_path, "a.ply", big_endian_ply()).parts[0].mesh
    assert (len(mesh.faces), len(mesh.vertices_m)) == (6, 6)  # The first and last vertex are the same point.
    assert np.unique(mesh.vertices_m[:, 2]).tolist() == [0.1]


def test_relative_indices_count_from_their_line(tmp_path: Path) -> None:
    lines = ["v 0 0 0", "v .1 0 0", "v 0 .1 0", "f -3 -2 -1", "v 0 0 5", "v 0 0 6", "v .1 0 5", "f -1 -2 -3"]
    mesh = load_content(tmp_path, "a.obj", "\n".join(lines)).parts
    assert [part.mesh.vertices_m[:, 2].max() for part in mesh] == [0, 6]


def test_size_limit_and_pipes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".stl", "solid\nfacet" + " " * 1_000_000),
        (".stl", "solid\n" + "facet normal 0 0 1\n" * 50_000),
        (".obj", TRIANGLE + "q " + "1" * 1_000_000 + "x\nf 1 2"),
        (".obj", TRIANGLE + "f " + "1/" * 500_000),
        (".obj", TRIANGLE + "v " + "1" * 1_000_000 + "x 0 0"),
        (".ply", PLY.replace("\n3 ", "\n" + "3" * 1_000_000 + "x ", 1)),
        (".ply", "ply\n" + " \n" * 1_000_000),
        (".ply", MANY_PROPERTIES + "end_header\n" + "1\n" * 1_500_000),
    ],
    ids=range(8),
)
def test_hostile_texts_are_refused_in_linear_time(tmp_path: Path, suffix: str, content: str) -> None:
    start = time.process_time()
    with pytest.raises(MeshError):
        load_content(tmp_path, "a" + suffix, content)
    assert time.process_time() - start < 10
