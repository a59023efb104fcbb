"""World mesh: rays against surfaces of known depth, boxes around steel, and the PLY files of the ground truth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy import ndarray

from dataset_builder.scene.mesh_ply import has_mesh_ply_header, parse_mesh_ply, read_mesh_ply, write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster, steel_box
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at

WIDTH, HEIGHT = 160, 90


def camera(pose: ndarray) -> Camera:
    return Camera(ideal_K(WIDTH, HEIGHT), np.zeros(5), pose, WIDTH, HEIGHT)


def slab(z_m: float, half_m: float, bar_id: int) -> WorldMesh:
    corners = np.array(
        [[-half_m, -half_m, z_m], [half_m, -half_m, z_m], [half_m, half_m, z_m], [-half_m, half_m, z_m]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return WorldMesh(corners, faces, np.full(2, bar_id, np.uint16))


@pytest.mark.parametrize("scale", [1.0, 40.0])
def test_depth_of_tilted_plane_is_exact(scale: float) -> None:
    centre_m = scale * np.array([0.21, -0.13, 0.31])
    pose = look_at(centre_m, scale * np.array([0.01, 0.02, 0.0]))
    truth = RayCaster(slab(0.0, scale * 100, 7)).cast(camera(pose))
    directions = camera(pose).rays() @ pose[:3, :3]  # world directions with unit planar depth
    expected_m = np.where(directions[..., 2] < 0, -centre_m[2] / directions[..., 2], 0.0)
    hit = truth.depth_m > 0
    assert hit.mean() > 0.9
    assert truth.depth_m[hit] == pytest.approx(expected_m[hit].astype(np.float32), rel=1.2e-7)


def test_nearest_surface_wins_and_background_is_zero() -> None:
    floor, plate = slab(0.0, 0.2, 0), slab(0.1, 0.05, 9)
    mesh = WorldMesh(
        np.concatenate([floor.vertices_m, plate.vertices_m]),
        np.concatenate([floor.faces, plate.faces + 4]),
        np.concatenate([floor.face_bar_id, plate.face_bar_id]),
    )
    pose = look_at(np.array([0.0, -0.001, 0.5]), np.array([0.0, 0.0, 0.0]))
    truth = RayCaster(mesh).cast(camera(pose))
    centre = (HEIGHT // 2, WIDTH // 2)
    assert truth.bars[centre] == 9
    assert truth.depth_m[centre] == pytest.approx(0.4, abs=1e-3)
    assert truth.bars[centre[0], 50] == 0
    assert truth.depth_m[centre[0], 50] == pytest.approx(0.5, abs=1e-3)
    assert truth.depth_m[0, 0] == 0.0
    assert np.array_equal(truth.mask, truth.bars > 0)


@pytest.mark.parametrize("seed", range(3))
def test_ray_along_the_plane_of_a_facet_meets_the_bar(seed: int) -> None:
    """Rounding makes such rays hit a facet whose plane they intersect far away from the bar."""
    rng, rays, facets, radius_m = np.random.default_rng(seed), 20_000, 24, 0.008
    angle_rad = 2 * np.pi * np.arange(facets) / facets
    ring_m = radius_m * np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1)
    vertices_m = np.concatenate([np.insert(ring_m, 2, z_m, axis=1) for z_m in (-1.0, 1.0)])
    here, following = np.arange(facets), (np.arange(facets) + 1) % facets
    faces = np.concatenate(
        [
            np.stack([here, following, following + facets], 1),
            np.stack([here, following + facets, here + facets], 1),
        ]
    )
    bar = WorldMesh(vertices_m, faces.astype(np.int32), np.ones(len(faces), np.uint16))
    facet = rng.integers(facets, size=rays)
    side_m = (np.roll(ring_m, -1, axis=0) - ring_m)[facet]
    aim_m = np.column_stack([ring_m[facet] + rng.uniform(0, 1, (rays, 1)) * side_m, rng.uniform(-0.9, 0.9, rays)])
    across = np.insert(side_m / np.linalg.norm(side_m, axis=1, keepdims=True), 2, 0, axis=1)
    origins_m = aim_m + 12 * rng.choice([-1, 1], (rays, 1)) * across + rng.uniform(-2, 2, (rays, 1)) * [0, 0, 1]
    directions = aim_m + rng.normal(0, 3e-7, (rays, 3)) - origins_m
    range_m = RayCaster(bar).hits(origins_m, directions).range_m
    hit = np.isfinite(range_m)
    assert hit.sum() > 10_000
    unit = directions[hit] / np.linalg.norm(directions[hit], axis=1, keepdims=True)
    points_m = origins_m[hit] + range_m[hit, None] * unit
    ratio = np.hypot(points_m[:, 0], points_m[:, 1]) / radius_m
    assert ratio.min() > np.cos(np.pi / facets) - 1e-3
    assert ratio.max() < 1.001
    assert np.abs(points_m[:, 2]).max() < 1.001


@settings(max_examples=50)
@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12)), st.integers(0, 4))
def test_box_is_the_smallest_with_the_margin_in_the_image(mask: ndarray, margin_px: int) -> None:
    found = steel_box(mask, margin_px)
    if not mask.any():
        assert found is None
        return
    assert found is not None
    rows, columns = np.nonzero(mask)
    assert (found.top, found.bottom) == (
        max(rows.min() - margin_px, 0),
        min(rows.max() + 1 + margin_px, len(mask)),
    )
    assert (found.left, found.right) == (
        max(columns.min() - margin_px, 0),
        min(columns.max() + 1 + margin_px, mask.shape[1]),
    )
    assert mask[found.slices].sum() == mask.sum()


def random_mesh() -> WorldMesh:
    """Return 50 vertices and 80 faces, with numbers that only exact storage keeps."""
    rng = np.random.default_rng(0)
    vertices_m, faces = rng.normal(size=(50, 3)), rng.integers(0, 50, (80, 3)).astype(np.int32)
    vertices_m[:3] = [[-0.0, 5e-324, 1e308], [0.1, 1 / 3, -np.pi], [np.nextafter(1, 2), -1e-9, 16.0]]
    return WorldMesh(vertices_m, faces, np.r_[0, 65535, rng.integers(0, 65536, 78)].astype(np.uint16))


MESH = random_mesh()
EMPTY = WorldMesh(np.empty((0, 3)), np.empty((0, 3), np.int32), np.empty(0, np.uint16))
FACE_BYTES, VERTEX_BYTES = 15, 24


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("ply") / "scene.ply"
    write_mesh_ply(path, MESH)
    return path.read_bytes()


@pytest.mark.parametrize("mesh", [MESH, EMPTY], ids=["mesh", "no faces"])
def test_ply_round_trip_is_bit_exact(tmp_path: Path, mesh: WorldMesh) -> None:
    write_mesh_ply(tmp_path / "scene.ply", mesh)
    read = read_mesh_ply(tmp_path / "scene.ply")
    for name, dtype in (("vertices_m", np.float64), ("faces", np.int32), ("face_bar_id", np.uint16)):
        array, expected = getattr(read, name), getattr(mesh, name)
        assert (array.dtype, array.shape, array.tobytes()) == (dtype, expected.shape, expected.tobytes())
        assert array.flags.c_contiguous
        assert array.flags.writeable


def test_ply_bytes_do_not_depend_on_array_layout(tmp_path: Path, content: bytes) -> None:
    again = WorldMesh(np.asfortranarray(MESH.vertices_m), np.asfortranarray(MESH.faces), MESH.face_bar_id)
    write_mesh_ply(tmp_path / "again.ply", again)
    assert (tmp_path / "again.ply").read_bytes() == content
    assert len(content) == content.index(b"end_header\n") + 11 + 50 * VERTEX_BYTES + 80 * FACE_BYTES


def test_ply_states_frame_and_unit_and_may_have_other_comments(content: bytes) -> None:
    comment = content.split(b"\n")[2].decode()
    assert all(word in comment for word in ("comment ", "z up", "metre", "bar_id 0 is not steel"))
    commented = content.replace(b"element face", b"comment \xff\nobj_info mine\nelement face", 1)
    assert has_mesh_ply_header(commented)
    np.testing.assert_array_equal(parse_mesh_ply(commented, "x").vertices_m, MESH.vertices_m)


def test_trimesh_reads_the_same_ply(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "scene.ply").write_bytes(content)
    (loaded,) = trimesh.load_scene(tmp_path / "scene.ply", process=False).geometry.values()
    np.testing.assert_array_equal(loaded.vertices, MESH.vertices_m)
    np.testing.assert_array_equal(loaded.faces, MESH.faces)
    np.testing.assert_array_equal(loaded.metadata["_ply_raw"]["face"]["data"]["bar_id"], MESH.face_bar_id)


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
        (b"ply\n", b"\x89PNG\r\n"),
        (b"ply\n", b"ply\n" + b"comment x\n" * 100_000),
    ],
)
def test_other_ply_layouts_are_refused(content: bytes, old: bytes, new: bytes) -> None:
    other = content.replace(old, new, 1)
    assert not has_mesh_ply_header(other)
    with pytest.raises(DatasetError, match=r"x\.ply: not a mesh of this dataset: found .* expected a binary"):
        parse_mesh_ply(other, "x.ply")


def replaced(content: bytes, before_end: int, new: bytes) -> bytes:
    start = len(content) - before_end
    return content[:start] + new + content[start + len(new) :]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda content: content[:0], "not a mesh of this dataset"),
        (lambda content: content[:4], "not a mesh of this dataset"),
        (
            lambda content: content.replace(b"vertex 50", b"vertex 9999999999"),
            r"damaged: \d+ bytes found, \d{11,} exp",
        ),
        (
            lambda content: content.replace(b"face 80", b"face 9999999999"),
            r"damaged: \d+ bytes found, \d{11,} expected",
        ),
        (lambda content: content[:-1], r"truncated or damaged: \d+ bytes found"),
        (lambda content: content[: -80 * FACE_BYTES], r"truncated or damaged: \d+ bytes found"),
        (lambda content: content + b"\0", r"truncated or damaged: \d+ bytes found"),
        (lambda content: content + bytes(FACE_BYTES), r"truncated or damaged: \d+ bytes found"),
        (lambda content: replaced(content, 79 * FACE_BYTES, b"\4"), "face 1 has 4 corners, expected 3"),
        (
            lambda content: replaced(content, 78 * FACE_BYTES - 1, np.array([0, 1, -1], "<i4").tobytes()),
            r"face 2 refers to vertices \[0, 1, -1\], expected 0 to 49",
        ),
        (
            lambda content: replaced(content, 78 * FACE_BYTES - 1, np.array([0, 1, 50], "<i4").tobytes()),
            r"face 2 refers to vertices \[0, 1, 50\], expected 0 to 49",
        ),
        (
            lambda content: replaced(content, 80 * FACE_BYTES + 8, np.array(np.nan, "<f8").tobytes()),
            r"vertex 49 is \[.*nan\], expected finite metres",
        ),
    ],
)
def test_damaged_ply_files_are_refused(content: bytes, damage: Callable[[bytes], bytes], words: str) -> None:
    with pytest.raises(DatasetError, match=rf"x\.ply: .*{words}"):
        parse_mesh_ply(damage(content), "x.ply")


def test_unreadable_ply_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"gone\.ply: 1 problem\n  - cannot be read: No such file"):
        read_mesh_ply(tmp_path / "gone.ply")
    with pytest.raises(DatasetError, match="it is a folder, not a regular file"):
        read_mesh_ply(tmp_path)
