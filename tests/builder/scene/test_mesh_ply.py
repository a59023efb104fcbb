"""Ground-truth mesh PLY files: bit-exact, deterministic, readable by trimesh, strictly validated on reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy import ndarray

from dataset_builder.scene.mesh_ply import has_mesh_ply_header, parse_mesh_ply, read_mesh_ply, write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from rebar_depth_bench.base.errors import DatasetError


def random_mesh(seed: int = 0, vertices: int = 50, faces: int = 80) -> WorldMesh:
    rng = np.random.default_rng(seed)
    return WorldMesh(
        rng.normal(size=(vertices, 3)),
        rng.integers(0, vertices, (faces, 3)).astype(np.int32),
        rng.integers(0, 65536, faces).astype(np.uint16),
    )


def arrays(mesh: WorldMesh) -> tuple[ndarray, ndarray, ndarray]:
    return mesh.vertices_m, mesh.faces, mesh.face_bar_id


def write_ply(folder: Path, mesh: WorldMesh) -> bytes:
    write_mesh_ply(folder / "scene.ply", mesh)
    return (folder / "scene.ply").read_bytes()


def test_round_trip_is_bit_exact(tmp_path: Path) -> None:
    mesh = random_mesh()
    mesh.vertices_m[:3] = [[-0.0, 5e-324, 1e308], [0.1, 1 / 3, -np.pi], [np.nextafter(1, 2), -1e-9, 16.0]]
    mesh.face_bar_id[:2] = 0, 65535
    write_mesh_ply(tmp_path / "scene.ply", mesh)

    arrays_read = arrays(read_mesh_ply(tmp_path / "scene.ply"))

    assert [array.dtype for array in arrays_read] == [np.float64, np.int32, np.uint16]
    for array_read, expected in zip(arrays_read, arrays(mesh), strict=True):
        assert array_read.tobytes() == expected.tobytes()
        assert array_read.flags.c_contiguous
        assert array_read.flags.writeable


def test_mesh_without_faces_round_trips(tmp_path: Path) -> None:
    empty = WorldMesh(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.uint16))
    write_mesh_ply(tmp_path / "a.ply", empty)
    assert [array.shape for array in arrays(read_mesh_ply(tmp_path / "a.ply"))] == [(0, 3), (0, 3), (0,)]


def test_bytes_do_not_depend_on_array_layout(tmp_path: Path) -> None:
    mesh = random_mesh()
    first = write_ply(tmp_path, mesh)
    again = WorldMesh(np.asfortranarray(mesh.vertices_m), np.asfortranarray(mesh.faces), mesh.face_bar_id)
    write_mesh_ply(tmp_path / "again.ply", again)
    assert (tmp_path / "again.ply").read_bytes() == first
    assert len(first) == first.index(b"end_header\n") + 11 + 50 * 24 + 80 * 15


def test_header_states_frame_and_unit(tmp_path: Path) -> None:
    comment = write_ply(tmp_path, random_mesh()).split(b"\n")[2].decode()
    assert comment.startswith("comment ")
    for word in ("world frame", "right-handed", "z up", "metre", "bar_id 0 is not steel"):
        assert word in comment


def test_trimesh_reads_same_mesh(tmp_path: Path) -> None:
    mesh = random_mesh()
    write_mesh_ply(tmp_path / "scene.ply", mesh)
    loaded = next(iter(trimesh.load_scene(tmp_path / "scene.ply", process=False).geometry.values()))
    np.testing.assert_array_equal(loaded.vertices, mesh.vertices_m)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    np.testing.assert_array_equal(loaded.metadata["_ply_raw"]["face"]["data"]["bar_id"], mesh.face_bar_id)


def test_extra_header_comments_are_accepted(tmp_path: Path) -> None:
    mesh = random_mesh()
    content = write_ply(tmp_path, mesh).replace(b"element face", b"comment \xff\nobj_info mine\nelement face", 1)
    assert has_mesh_ply_header(content)
    np.testing.assert_array_equal(parse_mesh_ply(content, "x").vertices_m, mesh.vertices_m)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"binary_little_endian", b"binary_big_endian"),
        (b"binary_little_endian", b"ascii"),
        (b"property double y", b"property float y"),
        (b"property double z\n", b"property double z\nproperty double nx\n"),
        (b"list uchar int", b"list uchar uint"),
        (b"ushort bar_id", b"uint bar_id"),
        (b"property ushort bar_id\n", b""),
        (b"element vertex 50", b"element vertex -50"),
        (b"element vertex 50", b"element vertex " + b"9" * 5000),
        (b"end_header\n", b"end_header\r\n"),
        (b"ply\n", b"PLY\n"),
    ],
)
def test_other_ply_layouts_are_rejected(tmp_path: Path, old: bytes, new: bytes) -> None:
    content = write_ply(tmp_path, random_mesh()).replace(old, new, 1)
    assert not has_mesh_ply_header(content)
    with pytest.raises(DatasetError, match=r"x\.ply: not a mesh of this dataset: found .* expected a binary"):
        parse_mesh_ply(content, "x.ply")


def test_huge_element_counts_are_rejected(tmp_path: Path) -> None:
    content = write_ply(tmp_path, random_mesh())
    for element in (b"vertex 50", b"face 80"):
        huge = content.replace(element, element.split()[0] + b" 9999999999", 1)
        with pytest.raises(DatasetError, match=r"truncated or damaged: \d+ bytes found, \d{11,} expected"):
            parse_mesh_ply(huge, "x.ply")


@pytest.mark.parametrize("cut", [1, 15, 80 * 15, 80 * 15 + 50 * 24])
def test_truncated_and_trailing_bytes_are_rejected(tmp_path: Path, cut: int) -> None:
    content = write_ply(tmp_path, random_mesh())
    for damaged in (content[:-cut], content + b"\0" * cut):
        with pytest.raises(DatasetError, match=f"truncated or damaged: {len(damaged)} bytes found"):
            parse_mesh_ply(damaged, "x.ply")


@pytest.mark.parametrize("content", [b"", b"ply\n", b"ply\n" + b"comment x\n" * 100_000, b"\x89PNG\r\n"])
def test_non_ply_content_is_rejected(content: bytes) -> None:
    with pytest.raises(DatasetError, match="not a mesh of this dataset"):
        parse_mesh_ply(content, "x.ply")


def test_quads_bad_indices_and_nan_are_rejected(tmp_path: Path) -> None:
    content = write_ply(tmp_path, random_mesh())
    faces_offset = len(content) - 80 * 15
    quad = content[: faces_offset + 15] + b"\4" + content[faces_offset + 16 :]
    with pytest.raises(DatasetError, match="face 1 has 4 corners, expected 3"):
        parse_mesh_ply(quad, "x.ply")
    for corner in (-1, 50):
        index = np.array([0, 1, corner], "<i4").tobytes()
        with pytest.raises(DatasetError, match=rf"face 2 refers to vertices \[0, 1, {corner}\], expected 0 to 49"):
            parse_mesh_ply(content[: faces_offset + 31] + index + content[faces_offset + 43 :], "x.ply")
    nan = np.array(np.nan, "<f8").tobytes()
    with pytest.raises(DatasetError, match=r"vertex 49 is \[.*nan\], expected finite metres"):
        parse_mesh_ply(content[: faces_offset - 8] + nan + content[faces_offset:], "x.ply")


@pytest.fixture(scope="module")
def small_file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_ply(tmp_path_factory.mktemp("ply"), random_mesh(vertices=4, faces=3))


@given(position=st.integers(0, 10_000), value=st.integers(0, 255), end=st.integers(0, 10_000))
def test_random_damage_raises_only_dataset_error(small_file: bytes, position: int, value: int, end: int) -> None:
    damaged = bytearray(small_file)
    damaged[position % len(damaged)] = value
    cut = bytes(damaged[: end if end < len(damaged) else None])
    try:
        vertices, faces, bar_id = arrays(parse_mesh_ply(cut, "x.ply"))
    except DatasetError as error:
        assert str(error).startswith("x.ply: ")  # noqa: PT017
        return
    assert np.isfinite(vertices).all()
    assert faces.min(initial=0) >= 0
    assert faces.max(initial=-1) < len(vertices)
    assert len(bar_id) == len(faces)


def test_unreadable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"gone\.ply: 1 problem\n  - cannot be read: No such file"):
        read_mesh_ply(tmp_path / "gone.ply")
    with pytest.raises(DatasetError, match="it is a folder, not a regular file"):
        read_mesh_ply(tmp_path)
