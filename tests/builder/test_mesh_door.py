"""Users' mesh files as assemblies: which part is which bar, in whose frame and unit, and what is refused."""

from __future__ import annotations

import base64
import hashlib
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from dataset_builder.lattice import lattice_assembly
from dataset_builder.mesh_door import load_assembly, mesh_file_spec
from dataset_builder.mesh_tools import enclosed_volume
from dataset_builder.model import Assembly, Mesh
from dataset_builder.specs import LatticeSpec
from rebar_depth_bench.errors import MeshError
from rebar_depth_bench.ply import write_mesh_ply

SIDES = 48


def tube(start: tuple[float, ...], end: tuple[float, ...], diameter: float, capped: bool = True) -> Mesh:
    """A prism of SIDES sides round a line, counter-clockwise from outside."""
    a, b = np.array(start, float), np.array(end, float)
    along = (b - a) / np.linalg.norm(b - a)
    across = np.cross(along, [0.36, 0.48, 0.80])
    across /= np.linalg.norm(across)
    angle = np.arange(SIDES) * 2 * np.pi / SIDES
    ring = np.outer(np.cos(angle), across) + np.outer(np.sin(angle), np.cross(along, across))
    vertices = np.concatenate([a + ring * diameter / 2, b + ring * diameter / 2, [a, b]])
    i = np.arange(SIDES)
    j = (i + 1) % SIDES
    side = [np.stack([i, j, SIDES + j], 1), np.stack([i, SIDES + j, SIDES + i], 1)]
    caps = [np.stack([np.full(SIDES, 2 * SIDES), j, i], 1)]
    caps += [np.stack([np.full(SIDES, 2 * SIDES + 1), SIDES + i, SIDES + j], 1)]
    if not capped:
        return Mesh(vertices[:-2], np.concatenate(side).astype(np.int32))
    return Mesh(vertices, np.concatenate(side + caps).astype(np.int32))


LINES = (
    ((-0.20, 0.00, 0.05), (0.30, 0.00, 0.05), 0.016),
    ((0.00, -0.10, 0.07), (0.00, 0.25, 0.09), 0.010),
    ((0.10, 0.10, 0.00), (0.12, 0.11, 0.40), 0.020),
)
TUBES = tuple(tube(*line) for line in LINES)


def stl(meshes: tuple[Mesh, ...]) -> bytes:
    corners = np.concatenate([mesh.vertices_m[mesh.faces] for mesh in meshes])
    rows = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("extra", "<u2")])
    rows["corners"] = corners
    return b"\0" * 80 + struct.pack("<I", len(rows)) + rows.tobytes()


def text_stl(meshes: tuple[Mesh, ...]) -> str:
    lines = []
    for number, mesh in enumerate(meshes):
        lines.append(f"solid bar{number}")
        for corners in mesh.vertices_m[mesh.faces].tolist():
            lines.append("facet normal 0 0 0\n outer loop")
            lines += [f"  vertex {x!r} {y!r} {z!r}" for x, y, z in corners]
            lines.append(" endloop\nendfacet")
        lines.append(f"endsolid bar{number}")
    return "\n".join(lines)


def obj(meshes: tuple[Mesh, ...], key: str | None = "o") -> str:
    lines, start = ["mtllib missing.mtl"], 1
    for number, mesh in enumerate(meshes):
        lines += [f"{key} bar {number}"] if key else []
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices_m.tolist()]
        lines += ["vn 0 0 1", "usemtl steel", "s off"]
        lines += ["f " + " ".join(f"{c}//1" for c in face) for face in (mesh.faces + start).tolist()]
        start += len(mesh.vertices_m)
    return "\n".join(lines)


def y_up(mesh: Mesh) -> Mesh:
    x, y, z = mesh.vertices_m.T
    return Mesh(np.stack([x, z, -y], 1), mesh.faces)


def gltf_tree(meshes: tuple[Mesh, ...]) -> tuple[dict[str, Any], bytes]:
    """A glTF with one node per mesh, and its buffer."""
    blobs = [b for m in meshes for b in (m.vertices_m.astype("<f4").tobytes(), m.faces.astype("<u4").tobytes())]
    offsets = np.cumsum([0, *map(len, blobs)]).tolist()
    views = [{"buffer": 0, "byteOffset": at, "byteLength": len(b)} for at, b in zip(offsets, blobs, strict=False)]
    accessors: list[dict[str, Any]] = []
    for n, mesh in enumerate(meshes):
        vertices, corners = len(mesh.vertices_m), mesh.faces.size
        accessors.append({"bufferView": 2 * n, "componentType": 5126, "count": vertices, "type": "VEC3"})
        accessors.append({"bufferView": 2 * n + 1, "componentType": 5125, "count": corners, "type": "SCALAR"})
    count = range(len(meshes))
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(count)}],
        "nodes": [{"mesh": n, "name": "bar"} for n in count],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 2 * n}, "indices": 2 * n + 1}]} for n in count],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offsets[-1]}],
    }
    return tree, b"".join(blobs)


def glb(tree: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<2I", len(binary), 0x004E4942) + binary
    return struct.pack("<3I", 0x46546C67, 2, 12 + len(chunks)) + chunks


def joined_arrays(meshes: tuple[Mesh, ...], ids: tuple[int, ...]) -> tuple[ndarray, ndarray, ndarray]:
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    return (
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(np.int32),
        np.concatenate([np.full(len(m.faces), i, np.uint16) for m, i in zip(meshes, ids, strict=True)]),
    )


def loaded(folder: Path, name: str, content: bytes | str, unit: str | float = "m") -> Assembly:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return load_assembly(mesh_file_spec(path, unit))


def assert_is_tubes(assembly: Assembly, atol: float = 1e-7) -> None:
    """The three tubes in their order, in the world, in metres."""
    assert [bar.bar_id for bar in assembly.bars] == [part.bar_id for part in assembly.parts] == [1, 2, 3]
    for bar, part, mesh, (start, end, diameter) in zip(assembly.bars, assembly.parts, TUBES, LINES, strict=True):
        assert bar.role == "imported"
        assert (part.name, part.material) == (f"bar-{bar.bar_id:03d}", "steel")
        assert (part.mesh.vertices_m.dtype, part.mesh.faces.dtype) == (np.float64, np.int32)
        corners = part.mesh.vertices_m[part.mesh.faces]
        np.testing.assert_allclose(corners, mesh.vertices_m[mesh.faces], rtol=0, atol=atol)
        np.testing.assert_allclose(bar.axis_m, [start, end], rtol=0, atol=1e-6)
        assert bar.diameter_m == pytest.approx(diameter, rel=0.005)


# --- what each format's bars are ---------------------------------------------------------------------------


def test_own_ply_keeps_ids_and_every_bit(tmp_path: Path) -> None:
    board = Mesh(np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]], np.int32))
    write_mesh_ply(tmp_path / "scene.ply", *joined_arrays((TUBES[0], board, *TUBES[1:]), (7, 0, 40_000, 65_535)))

    assembly = load_assembly(mesh_file_spec(tmp_path / "scene.ply", "m"))

    assert [part.bar_id for part in assembly.parts] == [7, 40_000, 65_535]
    assert [part.name for part in assembly.parts] == ["bar-007", "bar-40000", "bar-65535"]
    for part, mesh in zip(assembly.parts, TUBES, strict=True):
        assert part.mesh.vertices_m.tobytes() == mesh.vertices_m.tobytes()
        assert part.mesh.faces.tobytes() == mesh.faces.tobytes()


def test_a_finished_scene_is_not_turned_or_welded(tmp_path: Path) -> None:
    inside_out = Mesh(TUBES[0].vertices_m, np.ascontiguousarray(TUBES[0].faces[:, ::-1]))
    soup = Mesh(
        TUBES[1].vertices_m[TUBES[1].faces].reshape(-1, 3),
        np.arange(TUBES[1].faces.size, dtype=np.int32).reshape(-1, 3),
    )
    write_mesh_ply(tmp_path / "scene.ply", *joined_arrays((inside_out, soup), (1, 2)))
    parts = load_assembly(mesh_file_spec(tmp_path / "scene.ply", "m")).parts
    for part, mesh in zip(parts, (inside_out, soup), strict=True):
        np.testing.assert_array_equal(part.mesh.vertices_m, mesh.vertices_m)
        np.testing.assert_array_equal(part.mesh.faces, mesh.faces)


@pytest.mark.parametrize("encoding", ["binary", "ascii"])
def test_foreign_ply_with_bar_id_is_split_by_it(tmp_path: Path, encoding: str) -> None:
    vertices, faces, bar_id = joined_arrays(TUBES, (3, 0, 12))
    mesh = trimesh.Trimesh(vertices, faces, process=False, face_attributes={"bar_id": bar_id})
    assembly = loaded(tmp_path, "a.ply", trimesh.exchange.ply.export_ply(mesh, encoding=encoding))
    assert [bar.bar_id for bar in assembly.bars] == [3, 12]
    np.testing.assert_array_equal(assembly.parts[1].mesh.faces, TUBES[2].faces)
    np.testing.assert_allclose(assembly.parts[1].mesh.vertices_m, TUBES[2].vertices_m, atol=1e-7)


def test_ply_polygons_keep_their_id_and_place(tmp_path: Path) -> None:
    """Big-endian binary, double coordinates, quads, and a property that means nothing here."""
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0.1, 0.1], [0.1, 0.1, 0.1]])
    rows = np.zeros(2, [("quality", ">f4"), ("count", "u1"), ("index", ">u4", 4), ("bar_id", ">i2")])
    rows["count"] = 4
    rows["index"] = [[0, 1, 2, 3], [3, 2, 5, 4]]
    rows["bar_id"] = 9, 5
    header = (
        "ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement vertex 6\nproperty double x\n"
        "property double y\nproperty double z\nelement face 2\nproperty float quality\n"
        "property list uchar uint vertex_index\nproperty short bar_id\nend_header\n"
    )
    content = header.encode() + vertices.astype(">f8").tobytes() + rows.tobytes()
    assembly = loaded(tmp_path, "a.ply", content)
    assert [part.bar_id for part in assembly.parts] == [5, 9]
    corners = [part.mesh.vertices_m[part.mesh.faces] for part in assembly.parts]
    np.testing.assert_array_equal(corners[0], vertices[[[3, 2, 5], [3, 5, 4]]])
    np.testing.assert_array_equal(corners[1], vertices[[[0, 1, 2], [0, 2, 3]]])


@pytest.mark.parametrize("name", ["a.ply", "a.stl", "text.stl", "one.obj", "one.glb"])
def test_one_object_is_split_into_components_in_file_order(tmp_path: Path, name: str) -> None:
    vertices, faces, _ = joined_arrays(TUBES, (1, 2, 3))
    whole = trimesh.Trimesh(vertices, faces, process=False)
    content: dict[str, bytes | str] = {
        "a.ply": trimesh.exchange.ply.export_ply(whole),
        "a.stl": stl(TUBES),
        "text.stl": text_stl(TUBES).replace("\n", "\r\n").upper(),
        "one.obj": obj(TUBES, key=None),
        "one.glb": glb(*gltf_tree((y_up(Mesh(vertices, faces)),))),
    }
    assert_is_tubes(loaded(tmp_path, name, content[name]))


def test_components_are_welded_and_ordered_by_first_face(tmp_path: Path) -> None:
    assembly = loaded(tmp_path, "a.stl", stl(TUBES[::-1]))
    np.testing.assert_allclose(
        [bar.diameter_m for bar in assembly.bars], [line[2] for line in LINES[::-1]], rtol=0.005
    )
    assert [len(part.mesh.vertices_m) for part in assembly.parts] == [2 * SIDES + 2] * 3


def test_the_order_of_faces_numbers_components_not_that_of_vertices(tmp_path: Path) -> None:
    head, *objects = obj(TUBES).split("o bar ")
    vertices = [line for text in objects for line in text.split("\n") if line.startswith("v ")]
    faces = [[line for line in text.split("\n") if line.startswith("f ")] for text in objects]
    text = "\n".join([head, *vertices, *faces[2], *faces[0], *faces[1]])
    bars = loaded(tmp_path, "a.obj", text).bars
    assert [round(bar.diameter_m, 3) for bar in bars] == [0.020, 0.016, 0.010]


def test_faces_of_two_bars_may_alternate(tmp_path: Path) -> None:
    vertices, faces, _ = joined_arrays(TUBES[:2], (1, 2))
    woven = faces.reshape(2, -1, 3).transpose(1, 0, 2).reshape(-1, 3)
    assembly = loaded(tmp_path, "a.stl", stl((Mesh(vertices, np.ascontiguousarray(woven)),)))
    for part, mesh in zip(assembly.parts, TUBES[:2], strict=True):
        np.testing.assert_allclose(part.mesh.vertices_m[part.mesh.faces], mesh.vertices_m[mesh.faces], atol=1e-7)


@pytest.mark.parametrize("key", ["o", "g"])
def test_obj_objects_are_bars_in_file_order(tmp_path: Path, key: str) -> None:
    assembly = loaded(tmp_path, "a.obj", obj(TUBES, key))
    assert_is_tubes(assembly, atol=0)
    np.testing.assert_array_equal(assembly.parts[2].mesh.vertices_m, TUBES[2].vertices_m)


def test_an_obj_object_of_two_pieces_is_one_bar(tmp_path: Path) -> None:
    pieces = Mesh(*joined_arrays(TUBES[:2], (1, 1))[:2])
    text = obj((pieces, TUBES[2])).replace("usemtl steel", "g a group within", 1)
    assert [len(part.mesh.faces) for part in loaded(tmp_path, "a.obj", text).parts] == [8 * SIDES, 4 * SIDES]


def test_obj_polygons_and_indices_from_the_end(tmp_path: Path) -> None:
    square = "v 0 0 0\nv .1 0 0\nv .1 .1 0 0.5 0.5 0.5\nv 0 .1 0 # corner\nf -4 -3/1 \\\n-2/1/1 -1\n"
    mesh = loaded(tmp_path, "a.obj", square.replace("\n", "\r\n")).parts[0].mesh
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.vertices_m, [[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])


def test_glb_nodes_are_bars_in_node_order(tmp_path: Path) -> None:
    tree, binary = gltf_tree(tuple(y_up(mesh) for mesh in TUBES))
    # Neither the order of the scene's list nor the tree's shape decides.
    tree["nodes"].append({"children": [2, 1], "name": "cage"})
    tree["scenes"] = [{"nodes": [3, 0]}]
    assert_is_tubes(loaded(tmp_path, "a.GLB", glb(tree, binary)))


def test_a_gltf_with_its_buffer_inside_is_read(tmp_path: Path) -> None:
    tree, binary = gltf_tree(tuple(y_up(mesh) for mesh in TUBES))
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    tree["buffers"][0]["uri"] = uri
    assert_is_tubes(loaded(tmp_path, "a.gltf", json.dumps(tree)))


def test_gltf_transforms_apply_from_the_root_down(tmp_path: Path) -> None:
    """One 2 x 2 x 0.1 plate hung three times; expected places are worked out by hand."""
    plate = Mesh(np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0.1]]), np.array([[0, 1, 2]], np.int32))
    tree, binary = gltf_tree((plate,))
    half = 0.5**0.5
    tree["nodes"] = [
        {"mesh": 0, "translation": [1, 2, 3], "rotation": [0, 0, half, half], "scale": [1, 10, 100]},
        {"mesh": 0, "matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
        {"translation": [0, 0, 1], "children": [1]},
    ]
    tree["scenes"] = [{"nodes": [0, 2]}]
    first, second = (part.mesh.vertices_m for part in loaded(tmp_path, "a.glb", glb(tree, binary)).parts)
    # Node 0, y up: scaled, turned by 90 degrees about z, moved; then (x, y, z) -> (x, -z, y).
    np.testing.assert_allclose(first, np.array([[1, -3, 2], [1, -3, 4], [-19, -13, 2]]), atol=1e-6)
    np.testing.assert_allclose(second, np.array([[5, -1, 0], [5, -1, 2], [3, -1.1, 0]]), atol=1e-6)


def test_a_mirrored_open_tube_still_faces_outward(tmp_path: Path) -> None:
    """Open, so that nothing but the transform can tell."""
    tree, binary = gltf_tree((y_up(tube((0, 0, 0), (0.5, 0, 0), 0.02, capped=False)), y_up(TUBES[1])))
    tree["nodes"][0]["scale"] = [-1, 1, 1]
    mesh = loaded(tmp_path, "a.glb", glb(tree, binary)).parts[0].mesh
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    outward = ((a + b + c) / 3 * [0, 1, 1] * np.cross(b - a, c - a)).sum(axis=1)
    assert (outward > 0).all()


def test_primitives_of_a_node_are_one_bar_and_lines_none(tmp_path: Path) -> None:
    tree, binary = gltf_tree(tuple(y_up(mesh) for mesh in TUBES))
    first, second, third = (mesh["primitives"][0] for mesh in tree["meshes"])
    tree["meshes"] = [{"primitives": [first, second]}, {"primitives": [third, {**first, "mode": 1}]}]
    tree["nodes"][2:] = [{"mesh": 2, "name": "lines"}]
    tree["meshes"].append({"primitives": [{**first, "mode": 1}]})
    assembly = loaded(tmp_path, "a.glb", glb(tree, binary))
    assert [len(part.mesh.faces) for part in assembly.parts] == [8 * SIDES, 4 * SIDES]


def test_interleaved_vertices_and_short_indices(tmp_path: Path) -> None:
    tree, _ = gltf_tree((y_up(TUBES[0]),))
    rows = np.zeros(len(TUBES[0].vertices_m), [("normal", "<f4", 3), ("position", "<f4", 3)])
    rows["position"] = y_up(TUBES[0]).vertices_m
    index = TUBES[0].faces.astype("<u2").tobytes()
    tree["bufferViews"] = [
        {"buffer": 0, "byteLength": rows.nbytes, "byteStride": 24},
        {"buffer": 0, "byteOffset": rows.nbytes, "byteLength": len(index)},
    ]
    tree["accessors"][0]["byteOffset"] = 12
    tree["accessors"][1]["componentType"] = 5123
    bar = loaded(tmp_path, "a.glb", glb(tree, rows.tobytes() + index)).bars[0]
    np.testing.assert_allclose(bar.axis_m, LINES[0][:2], atol=1e-6)


# --- frame, unit, estimates --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "per_metre"),
    [("m", 1), ("cm", 100), ("mm", 1000), ("in", 1 / 0.0254), ("ft", 1 / 0.3048), (0.5, 2)],
)
def test_units(tmp_path: Path, unit: str | float, per_metre: float) -> None:
    scaled = tuple(Mesh(mesh.vertices_m * per_metre, mesh.faces) for mesh in TUBES)
    assert_is_tubes(loaded(tmp_path, "a.obj", obj(scaled), unit), atol=1e-12)


def test_an_open_tube_has_an_axis_and_a_diameter(tmp_path: Path) -> None:
    start, end, diameter = LINES[1]
    bar = loaded(tmp_path, "a.obj", obj((tube(start, end, diameter, capped=False),))).bars[0]
    np.testing.assert_allclose(bar.axis_m, [start, end], atol=1e-9)
    assert bar.diameter_m == pytest.approx(diameter, rel=1e-6)


def test_a_closed_bars_diameter_is_that_of_the_cylinder_of_its_volume(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.5, 0.01, 0.01))
    box.apply_translation([3, -2, 5])
    bar = loaded(tmp_path, "a.ply", trimesh.exchange.ply.export_ply(box)).bars[0]
    assert bar.diameter_m == pytest.approx(0.01 * (4 / np.pi) ** 0.5, rel=1e-4)
    np.testing.assert_allclose(bar.axis_m, [[2.75, -2.0, 5.0], [3.25, -2.0, 5.0]], atol=1e-6)


def test_a_closed_bars_axis_is_that_of_its_volume(tmp_path: Path) -> None:
    """A 3-4-5 wedge: the middle of its surface lies 1.7 mm beside the middle of its volume."""
    ends = [[x, y, z] for x in (0.0, 1.0) for y, z in ((0.0, 0.0), (0.03, 0.0), (0.0, 0.04))]
    faces = [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    bar = loaded(tmp_path, "a.obj", obj((Mesh(np.array(ends), np.array(faces, np.int32)),))).bars[0]
    np.testing.assert_allclose(bar.axis_m, [[0, 0.01, 0.04 / 3], [1, 0.01, 0.04 / 3]], atol=2e-5)
    assert bar.diameter_m == pytest.approx((4 * 0.0006 / np.pi) ** 0.5, rel=1e-3)


def test_tessellation_does_not_weigh_in(tmp_path: Path) -> None:
    start, end, diameter = LINES[2]
    coarse = tube(start, end, diameter, capped=False)
    vertices, faces = coarse.vertices_m, coarse.faces
    for _ in range(3):  # one side of one end only
        middle = vertices[faces].mean(axis=1)
        part = np.flatnonzero((middle[:, 0] > 0.11) & (middle[:, 2] > 0.2))
        vertices, faces = trimesh.remesh.subdivide(vertices, faces, part)
    assert len(faces) > 3 * len(coarse.faces)
    bar = loaded(tmp_path, "a.obj", obj((Mesh(vertices, faces),))).bars[0]
    np.testing.assert_allclose(bar.axis_m, [start, end], atol=1e-9)


def test_inside_out_parts_are_turned(tmp_path: Path) -> None:
    inside_out = Mesh(TUBES[0].vertices_m, TUBES[0].faces[:, ::-1])
    for name, content in (("a.stl", stl((inside_out,))), ("a.obj", obj((inside_out, TUBES[1])))):
        mesh = loaded(tmp_path, name, content).parts[0].mesh
        assert enclosed_volume(mesh.vertices_m[mesh.faces]) > 0


# --- the lattice through every format ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def lattice() -> Assembly:
    # Twelve rods of both diameters keep the text formats quick.
    return lattice_assembly(replace(LatticeSpec(), extent_m=0.040))


def lattice_file(lattice: Assembly, suffix: str) -> bytes | str:
    meshes = tuple(part.mesh for part in lattice.parts)
    if suffix == ".glb":
        return glb(*gltf_tree(tuple(y_up(mesh) for mesh in meshes)))
    return stl(meshes) if suffix == ".stl" else obj(meshes)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj", ".glb"])
def test_lattice_round_trip(tmp_path: Path, lattice: Assembly, suffix: str) -> None:
    ids = tuple(part.bar_id for part in lattice.parts)
    if suffix == ".ply":
        write_mesh_ply(tmp_path / "a.ply", *joined_arrays(tuple(part.mesh for part in lattice.parts), ids))
        back = load_assembly(mesh_file_spec(tmp_path / "a.ply", "m"))
    else:
        back = loaded(tmp_path, "a" + suffix, lattice_file(lattice, suffix))

    assert tuple(bar.bar_id for bar in back.bars) == tuple(part.bar_id for part in back.parts) == ids
    for bar, part, bar_in, part_in in zip(back.bars, back.parts, lattice.bars, lattice.parts, strict=True):
        np.testing.assert_allclose(bar.axis_m, bar_in.axis_m, rtol=0, atol=1e-4)
        assert bar.diameter_m == pytest.approx(bar_in.diameter_m, rel=0.05)
        found, expected = part.mesh, part_in.mesh
        if suffix == ".ply":
            np.testing.assert_array_equal(found.vertices_m, expected.vertices_m)
            np.testing.assert_array_equal(found.faces, expected.faces)
        np.testing.assert_allclose(
            found.vertices_m[found.faces], expected.vertices_m[expected.faces], rtol=0, atol=1e-8
        )


# --- refusals ----------------------------------------------------------------------------------------------


def test_the_spec_pins_the_content(tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    path.write_bytes(stl(TUBES))
    spec = mesh_file_spec(path, "mm")
    assert (spec.path, spec.unit_m) == (str(path), 0.001)
    assert spec.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    path.write_bytes(stl(TUBES[:2]))
    with pytest.raises(MeshError, match=f"changed since it was chosen: sha256 .* {spec.sha256} expected"):
        load_assembly(spec)


@pytest.mark.parametrize(("unit", "words"), [("km", "unknown unit 'km', expected one of m, cm, mm, in, ft")])
def test_unknown_units(tmp_path: Path, unit: str, words: str) -> None:
    (tmp_path / "a.stl").write_bytes(stl(TUBES))
    with pytest.raises(MeshError, match=words):
        mesh_file_spec(tmp_path / "a.stl", unit)


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf")])
def test_units_without_a_length(tmp_path: Path, unit: float) -> None:
    (tmp_path / "a.stl").write_bytes(stl(TUBES))
    with pytest.raises(MeshError, match="expected a positive length"):
        mesh_file_spec(tmp_path / "a.stl", unit)
    with pytest.raises(MeshError, match="expected a positive length"):
        load_assembly(replace(mesh_file_spec(tmp_path / "a.stl", "m"), unit_m=unit))


@pytest.mark.parametrize(("factor", "unit"), [(1000, "m"), (1, "mm"), (1e25, "m")])
def test_absurd_extents_ask_for_the_unit(tmp_path: Path, factor: float, unit: str) -> None:
    scaled = tuple(Mesh(mesh.vertices_m * factor, mesh.faces) for mesh in TUBES)
    with pytest.raises(MeshError, match=r"is \S+ m long, expected 0.001 to 100 m: is the unit right\?"):
        loaded(tmp_path, "a.obj", obj(scaled), unit)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"gone\.stl: the mesh file cannot be read: No such file"):
        mesh_file_spec(tmp_path / "gone.stl", "m")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(MeshError, match="Is a directory"):
        mesh_file_spec(tmp_path / "folder.ply", "m")
    for name in ("a.step", "mesh"):
        with pytest.raises(MeshError, match=r"expected \.glb, \.gltf, \.obj, \.ply, \.stl"):
            loaded(tmp_path, name, b"x")


POINTS = "v 0 0 0\nv 0.1 0 0\nv 0.2 0 0\nv 0 0.1 0\n"
PLY_HEAD = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY_FACES = b"element face 1\nproperty list uchar int vertex_indices\n"
PLY_POINTS = b"end_header\n0 0 0\n0.1 0 0\n0 0.1 0\n"
PLY_FACE_POINTS = PLY_FACES + PLY_POINTS
PLY_ID_POINTS = PLY_FACES + b"property int bar_id\n" + PLY_POINTS


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.obj", "", "no triangle found, expected the surface of at least one bar"),
        ("a.obj", POINTS, "no triangle found"),
        ("a.obj", POINTS + "f 1 2\n", r"line 5: 'f 1 2': 2 corners, expected at least 3"),
        ("a.obj", POINTS + "f 1 2 x\n", "line 5: .* invalid literal"),
        ("a.obj", POINTS + "f 1 2 0\n", "line 5: .* vertex 0, expected 1 and up"),
        ("a.obj", POINTS + "f 1 2 -9\n", "line 5: .* vertex -9, expected"),
        ("a.obj", POINTS + "f 1 2 9\n", r"triangle 0 names vertices \[0, 1, 8\] .* expected 0 to 3"),
        ("a.obj", POINTS + "f 1 2 99999999999999999999\n", "line 5: .* vertex 9+, expected"),
        ("a.obj", "v 0 0\nv", "line 1: 'v 0 0': not enough values"),
        ("a.obj", POINTS + "v nan 0 0\nf 1 2 5\n", r"vertex 4 .* is \[nan, .*expected finite"),
        ("a.obj", POINTS + "f 1 2 3\n", "bar 1 .1 triangles. is no surface: every triangle has zero area"),
        ("a.stl", b"", "no whole STL: 0 bytes found"),
        ("a.stl", stl(TUBES)[:-1], "no whole STL: .* a binary STL has 84 and 50 for each"),
        ("a.stl", stl(TUBES)[:80] + b"\xff" * 4 + stl(TUBES)[84:], "no whole STL"),
        ("a.stl", b"\0" * 84, "no triangle found"),
        ("a.stl", text_stl(TUBES[:1]).rpartition("endsolid")[0], "no whole STL"),
        ("a.stl", text_stl(TUBES).rpartition("vertex")[0] + "endsolid", r"576 facets and 1727 vertices"),
        ("a.stl", "solid a\nendsolid a\n", "no triangle found"),
        (
            "a.stl",
            text_stl(TUBES).replace("vertex 0", "vertex O", 1),
            "a vertex of this text STL is no number",
        ),
        (
            "a.stl",
            text_stl(TUBES).replace("vertex ", "vertex 1 ", 1),
            "576 facets and 1727 vertices of three numbers",
        ),
        ("a.stl", stl((Mesh(TUBES[0].vertices_m * np.nan, TUBES[0].faces),)), "expected finite coordinates"),
        ("a.ply", b"", "not a whole PLY that can be read: found a file that starts with b''"),
        ("a.ply", b"ply\nformat ascii 1.0\n", "expected a PLY header"),
        ("a.ply", PLY_HEAD.replace(b"ascii", b"utf-8") + PLY_POINTS, "'format utf-8 1.0', which is no PLY"),
        ("a.ply", PLY_HEAD.replace(b"float y", b"half y") + PLY_POINTS, "'property half y', which is no PLY"),
        ("a.ply", PLY_HEAD.replace(b"float y", b"float w") + PLY_FACE_POINTS + b"3 0 1 2", "'y' is missing"),
        ("a.ply", PLY_HEAD + PLY_POINTS, "no triangle found"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"3 0 1 3\n", r"\[0, 1, 3\] .* expected 0 to 2"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"3 0 1 -1\n", r"\[0, 1, -1\] .* expected 0 to 2"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"3 0 1 1.5\n", "vertex_indices 1.5 found, expected whole"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"3 0 1\n", "ends before its 1 face rows do"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS, "ends before its 1 face rows do"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"3 0 1 2 2\n", "8 bytes are left over"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"2 0 1\n", "has 2 entries, expected 3 to 255"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"nan 0 1\n", "has nan entries"),
        ("a.ply", PLY_HEAD + PLY_FACE_POINTS + b"3 0 1 x\n", "could not convert string to float"),
        (
            "a.ply",
            PLY_HEAD.replace(b"x 3", b"x 99999999999") + PLY_FACE_POINTS,
            "its 99999999999 vertex rows",
        ),
        (
            "a.ply",
            PLY_HEAD + PLY_FACE_POINTS.replace(b"face 1", b"face 2") + b"3 0 1 2 4 0 1 2",
            "face 1 has 4 corners and the first 3; triangulate the mesh first",
        ),
        ("a.ply", PLY_HEAD + PLY_ID_POINTS + b"3 0 1 2 70000\n", "bar_id 70000, expected 0 to 65535"),
        ("a.ply", PLY_HEAD + PLY_ID_POINTS + b"3 0 1 2 -1\n", "triangle 0 has bar_id -1, expected 0 to"),
        ("a.ply", PLY_HEAD + PLY_ID_POINTS + b"3 0 1 2 1.5\n", "bar_id 1.5 found, expected whole numbers"),
        ("a.ply", PLY_HEAD + PLY_ID_POINTS + b"3 0 1 2 0\n", "every face has bar_id 0"),
        ("a.glb", b"", "not a whole binary glTF 2.0"),
        ("a.glb", glb(*gltf_tree(TUBES))[:-4], "not a whole binary glTF 2.0: .* bytes claimed"),
        ("a.gltf", "[" * 100_000, "not a glTF 2.0 that can be read"),
        ("a.gltf", "{}", "not a glTF 2.0 that can be read: KeyError 'asset'"),
        ("a.gltf", '{"asset": {"version": "1.0"}}', "version 1.0, expected 2"),
        ("a.gltf", '{"asset": {"version": "2.0"}}', "no triangle found"),
    ],
)
def test_hostile_files(tmp_path: Path, name: str, content: bytes | str, words: str) -> None:
    with pytest.raises(MeshError, match=words) as caught:
        loaded(tmp_path, name, content)
    assert str(caught.value).startswith(str(tmp_path / name))


def test_damaged_own_ply_is_a_mesh_error(tmp_path: Path) -> None:
    write_mesh_ply(tmp_path / "a.ply", *joined_arrays(TUBES, (1, 2, 3)))
    with pytest.raises(MeshError, match="truncated or damaged"):
        loaded(tmp_path, "b.ply", (tmp_path / "a.ply").read_bytes()[:-1])


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("accessors", 0, "count"), 10**12, r"accessor 0 reads 1000000000000 items up to byte \d+ of"),
        (("accessors", 0, "count"), -5, "accessor 0 reads -5 items"),
        (("accessors", 0, "byteOffset"), -4, "accessor 0 reads"),
        (("accessors", 0, "sparse"), {}, "sparse; expected plain VEC3"),
        (("accessors", 0, "componentType"), 5122, "VEC3 of component type 5122"),
        (("accessors", 1, "count"), 7, "7 corners, expected a multiple of 3"),
        (("accessors", 0, "count"), 3, r"node 0 \('bar'\): triangle 0 names vertices"),
        (("bufferViews", 0, "byteStride"), 1, "accessor 0 reads"),
        (("bufferViews", 0, "byteLength"), 5, "accessor 0 reads"),
        (("nodes", 0, "mesh"), -1, "meshes -1 is named, but there are 3"),
        (("nodes", 1, "children"), [0], "node 0 is reached twice"),
        (("nodes", 1, "children"), [1], "node 1 is reached twice"),
        (("nodes", 0, "rotation"), [0, 0, 0, 0], "not a glTF 2.0 that can be read"),
        (("nodes", 0, "translation"), [float("nan"), 0, 0], "node 0 has a transform that is not finite"),
        (("nodes", 0, "matrix"), [1, 2], "cannot reshape"),
        (("meshes", 0, "primitives", 0, "mode"), 5, "strips or fans .mode 5., expected triangles"),
        (("extensionsRequired",), ["KHR_draco_mesh_compression"], "it needs KHR_draco_mesh_compression"),
        (("extensionsUsed",), ["EXT_mesh_gpu_instancing"], "without compression or instancing"),
        (("buffers", 0, "uri"), "../secret.bin", "in another file, '../secret.bin', .* save it as .glb"),
        (("buffers", 0, "uri"), "data:;base64,%%", "not a glTF 2.0 that can be read"),
        (("nodes",), 5, "not a glTF 2.0 that can be read"),
    ],
)
def test_hostile_gltf(tmp_path: Path, path: tuple[str | int, ...], value: object, words: str) -> None:
    tree, binary = gltf_tree(TUBES)
    place: Any = tree
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(MeshError, match=words):
        loaded(tmp_path, "a.glb", glb(tree, binary))


def test_too_many_bars(tmp_path: Path) -> None:
    corner = np.arange(65_536)[:, None, None] * [1e-4, 0.0, 0.0]
    soup = (corner + np.array([[0, 0, 0], [5e-5, 0, 0], [0, 0.1, 0]])).reshape(-1, 3)
    mesh = Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3))
    with pytest.raises(MeshError, match="65536 connected components found, expected at most 65535 bars"):
        loaded(tmp_path, "a.stl", stl((mesh,)))


SAMPLES = {
    "a.stl": stl(TUBES[:1]),
    "b.stl": text_stl(TUBES[:1]).encode(),
    "a.obj": obj(TUBES[:1]).encode(),
    "a.glb": glb(*gltf_tree(TUBES[:1])),
    "a.ply": trimesh.exchange.ply.export_ply(trimesh.Trimesh(TUBES[0].vertices_m, TUBES[0].faces)),
    "b.ply": PLY_HEAD + PLY_ID_POINTS + b"3 0 1 2 4\n",
}


@settings(deadline=None, max_examples=100)
@given(name=st.sampled_from(sorted(SAMPLES)), data=st.data())
def test_any_damage_is_answered_in_words(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    content = bytearray(SAMPLES[name])
    # Half of the damage falls on the first 400 bytes, where the headers are.
    places = st.integers(0, len(content) - 1) | st.integers(0, min(399, len(content) - 1))
    for place, value in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), min_size=1, max_size=4)):
        content[place] = value
    folder = tmp_path_factory.mktemp("damaged")
    try:
        assembly = loaded(folder, name, bytes(content[: data.draw(places | st.none())]))
    except MeshError as error:
        assert str(error).startswith(str(folder / name))  # noqa: PT017
        return
    assert all(np.isfinite(part.mesh.vertices_m).all() for part in assembly.parts)
    assert all(bar.diameter_m > 0 for bar in assembly.bars)
