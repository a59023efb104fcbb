"""The ground-truth mesh file: bit-exact, deterministic, readable elsewhere, and strict towards its reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from dataset_builder.scene.mesh_ply import (
    MeshArrays,
    has_mesh_ply_header,
    parse_mesh_ply,
    read_mesh_ply,
    write_mesh_ply,
)
from rebar_depth_bench.errors import DatasetError


def arrays(seed: int = 0, vertices: int = 50, faces: int = 80) -> MeshArrays:
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=(vertices, 3)),
        rng.integers(0, vertices, (faces, 3)).astype(np.int32),
        rng.integers(0, 65536, faces).astype(np.uint16),
    )


def written(folder: Path, mesh: MeshArrays) -> bytes:
    write_mesh_ply(folder / "scene.ply", *mesh)
    return (folder / "scene.ply").read_bytes()


def test_every_value_survives_to_the_bit(tmp_path: Path) -> None:
    vertices, faces, bar_id = arrays()
    vertices[:3] = [[-0.0, 5e-324, 1e308], [0.1, 1 / 3, -np.pi], [np.nextafter(1, 2), -1e-9, 16.0]]
    bar_id[:2] = 0, 65535
    write_mesh_ply(tmp_path / "scene.ply", vertices, faces, bar_id)

    back = read_mesh_ply(tmp_path / "scene.ply")

    assert [array.dtype for array in back] == [np.float64, np.int32, np.uint16]
    for found, expected in zip(back, (vertices, faces, bar_id), strict=True):
        assert found.tobytes() == expected.tobytes()
        assert found.flags.c_contiguous
        assert found.flags.writeable


def test_a_mesh_without_faces_survives(tmp_path: Path) -> None:
    write_mesh_ply(tmp_path / "a.ply", np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.uint16))
    assert [array.shape for array in read_mesh_ply(tmp_path / "a.ply")] == [(0, 3), (0, 3), (0,)]


def test_equal_arrays_give_equal_bytes_whatever_their_layout(tmp_path: Path) -> None:
    vertices, faces, bar_id = arrays()
    first = written(tmp_path, (vertices, faces, bar_id))
    write_mesh_ply(tmp_path / "again.ply", np.asfortranarray(vertices), faces.astype(np.int64), bar_id[:])
    assert (tmp_path / "again.ply").read_bytes() == first
    assert len(first) == first.index(b"end_header\n") + 11 + 50 * 24 + 80 * 15


def test_the_header_tells_frame_and_unit(tmp_path: Path) -> None:
    comment = written(tmp_path, arrays()).split(b"\n")[2].decode()
    assert comment.startswith("comment ")
    for word in ("world frame", "right-handed", "z up", "metre", "bar_id 0 is not steel"):
        assert word in comment


def test_trimesh_reads_the_same_mesh(tmp_path: Path) -> None:
    mesh = arrays()
    write_mesh_ply(tmp_path / "scene.ply", *mesh)
    loaded = next(iter(trimesh.load_scene(tmp_path / "scene.ply", process=False).geometry.values()))
    np.testing.assert_array_equal(loaded.vertices, mesh[0])
    np.testing.assert_array_equal(loaded.faces, mesh[1])
    np.testing.assert_array_equal(loaded.metadata["_ply_raw"]["face"]["data"]["bar_id"], mesh[2])


def test_other_comments_are_no_other_layout(tmp_path: Path) -> None:
    mesh = arrays()
    content = written(tmp_path, mesh).replace(b"element face", b"comment \xff\nobj_info mine\nelement face", 1)
    assert has_mesh_ply_header(content)
    np.testing.assert_array_equal(parse_mesh_ply(content, "x")[0], mesh[0])


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
def test_another_layout_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    content = written(tmp_path, arrays()).replace(old, new, 1)
    assert not has_mesh_ply_header(content)
    with pytest.raises(DatasetError, match=r"x\.ply: not a mesh of this dataset: found .* expected a binary"):
        parse_mesh_ply(content, "x.ply")


def test_hostile_counts_allocate_nothing(tmp_path: Path) -> None:
    content = written(tmp_path, arrays())
    for element in (b"vertex 50", b"face 80"):
        claim = content.replace(element, element.split()[0] + b" 9999999999", 1)
        with pytest.raises(DatasetError, match=r"truncated or damaged: \d+ bytes found, \d{11,} expected"):
            parse_mesh_ply(claim, "x.ply")


@pytest.mark.parametrize("cut", [1, 15, 80 * 15, 80 * 15 + 50 * 24])
def test_truncation_and_trailing_bytes_are_refused(tmp_path: Path, cut: int) -> None:
    content = written(tmp_path, arrays())
    for damaged in (content[:-cut], content + b"\0" * cut):
        with pytest.raises(DatasetError, match=f"truncated or damaged: {len(damaged)} bytes found"):
            parse_mesh_ply(damaged, "x.ply")


@pytest.mark.parametrize("content", [b"", b"ply\n", b"ply\n" + b"comment x\n" * 100_000, b"\x89PNG\r\n"])
def test_no_ply_at_all_is_refused(content: bytes) -> None:
    with pytest.raises(DatasetError, match="not a mesh of this dataset"):
        parse_mesh_ply(content, "x.ply")


def test_a_body_that_is_no_triangle_mesh_is_refused(tmp_path: Path) -> None:
    content = written(tmp_path, arrays())
    faces_at = len(content) - 80 * 15
    quad = content[: faces_at + 15] + b"\4" + content[faces_at + 16 :]
    with pytest.raises(DatasetError, match="face 1 has 4 corners, expected 3"):
        parse_mesh_ply(quad, "x.ply")
    for corner in (-1, 50):
        index = np.array([0, 1, corner], "<i4").tobytes()
        with pytest.raises(DatasetError, match=rf"face 2 names vertices \[0, 1, {corner}\], expected 0 to 49"):
            parse_mesh_ply(content[: faces_at + 31] + index + content[faces_at + 43 :], "x.ply")
    nan = np.array(np.nan, "<f8").tobytes()
    with pytest.raises(DatasetError, match=r"vertex 49 is \[.*nan\], expected finite metres"):
        parse_mesh_ply(content[: faces_at - 8] + nan + content[faces_at:], "x.ply")


@pytest.fixture(scope="module")
def small_file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("ply"), arrays(vertices=4, faces=3))


@given(position=st.integers(0, 10_000), value=st.integers(0, 255), end=st.integers(0, 10_000))
def test_any_damage_is_answered_in_words(small_file: bytes, position: int, value: int, end: int) -> None:
    damaged = bytearray(small_file)
    damaged[position % len(damaged)] = value
    cut = bytes(damaged[: end if end < len(damaged) else None])
    try:
        vertices, faces, bar_id = parse_mesh_ply(cut, "x.ply")
    except DatasetError as error:
        assert str(error).startswith("x.ply: ")  # noqa: PT017
        return
    assert np.isfinite(vertices).all()
    assert faces.min(initial=0) >= 0
    assert faces.max(initial=-1) < len(vertices)
    assert len(bar_id) == len(faces)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"gone\.ply: the mesh cannot be read: No such file"):
        read_mesh_ply(tmp_path / "gone.ply")
    with pytest.raises(DatasetError, match="Is a directory"):
        read_mesh_ply(tmp_path)


def test_what_is_no_mesh_is_not_written(tmp_path: Path) -> None:
    vertices, faces, bar_id = arrays()
    before = written(tmp_path, (vertices, faces, bar_id))
    infinite = vertices.copy()
    infinite[3, 1] = np.inf
    for bad, words in (
        ((vertices[:, :2], faces, bar_id), r"vertices \(50, 2\)"),
        ((vertices, faces, bar_id[1:]), r"bar ids \(79,\): expected one for each of the 80 faces"),
        ((vertices, faces + 1, bar_id), "faces name vertices 1 to 50: expected 0 to 49"),
        ((vertices, faces - 1, bar_id), "faces name vertices -1 to"),
        ((vertices, faces, np.full(80, 65536)), "bar ids 65536 to 65536: expected 0 to 65535"),
        ((vertices, faces.astype(float), bar_id), "faces float64"),
        ((infinite, faces, bar_id), "not finite"),
    ):
        with pytest.raises(ValueError, match=words):
            write_mesh_ply(tmp_path / "scene.ply", *bad)
    assert (tmp_path / "scene.ply").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]
