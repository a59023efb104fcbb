"""Ray caster compared with surfaces of analytically known depth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy import ndarray

from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import Camera, camera_centre, ideal_K, look_at, transform

WIDTH, HEIGHT = 160, 90


def camera(pose: ndarray) -> Camera:
    return Camera(ideal_K(WIDTH, HEIGHT), np.zeros(5), pose, WIDTH, HEIGHT)


def slab(z_m: float, half_m: float, bar_id: int) -> WorldMesh:
    corners = np.array(
        [[-half_m, -half_m, z_m], [half_m, -half_m, z_m], [half_m, half_m, z_m], [-half_m, half_m, z_m]]
    )
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return WorldMesh(corners, faces, np.full(2, bar_id, np.uint16))


def concatenate_meshes(*meshes: WorldMesh) -> WorldMesh:
    vertex_offsets = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    return WorldMesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, vertex_offsets, strict=False)]).astype(
            np.int32
        ),
        np.concatenate([mesh.face_bar_id for mesh in meshes]),
    )


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
    mesh = concatenate_meshes(slab(0.0, 0.2, 0), slab(0.1, 0.05, 9))
    pose = look_at(np.array([0.0, -0.001, 0.5]), np.array([0.0, 0.0, 0.0]))
    truth = RayCaster(mesh).cast(camera(pose))
    centre = (HEIGHT // 2, WIDTH // 2)
    assert truth.bars[centre] == 9
    assert truth.depth_m[centre] == pytest.approx(0.4, abs=1e-3)
    assert truth.bars[centre[0], 50] == 0
    assert truth.depth_m[centre[0], 50] == pytest.approx(0.5, abs=1e-3)
    assert truth.depth_m[0, 0] == 0.0
    assert np.array_equal(truth.mask, truth.bars > 0)


def test_unprojected_depth_is_on_surface() -> None:
    rng = np.random.default_rng(3)
    corners = rng.normal(0, 0.2, (60, 3, 3)) + np.array([0, 0, 0.2])
    mesh = WorldMesh(
        corners.reshape(-1, 3),
        np.arange(180, dtype=np.int32).reshape(-1, 3),
        np.arange(1, 61, dtype=np.uint16),
    )
    pose = look_at(np.array([0.9, 0.4, 0.5]), np.array([0.0, 0.0, 0.2]))
    truth = RayCaster(mesh).cast(camera(pose))
    assert truth.mask.sum() > 500
    points = transform(np.linalg.inv(pose), (camera(pose).rays() * truth.depth_m[..., None])[truth.mask])
    triangles = corners[truth.bars[truth.mask] - 1]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off_plane_m = np.abs(np.einsum("ij,ij->i", points - triangles[:, 0], normals))
    assert off_plane_m.max() < 1e-7  # rounding error of float32 at about 1 m
    assert np.linalg.norm(camera_centre(pose)) > 1


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
