"""Point sets of surfaces: random samples, covering points, points far from each other, short paths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.point_sets import (
    SurfaceSampler,
    covering_points,
    farthest_points,
    short_path,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_mesh(rng: np.random.Generator, triangles: int) -> Mesh:
    """Return triangles of any shape, from specks to slivers of metres."""
    sizes_m = 10.0 ** rng.uniform(-3, 0.7, (triangles, 3, 1))
    corners_m = rng.uniform(-3, 3, (triangles, 1, 3)) + sizes_m * rng.uniform(-1, 1, (triangles, 3, 3))
    return Mesh(corners_m.reshape(-1, 3), np.arange(3 * triangles, dtype=np.int32).reshape(-1, 3))


def test_samples_are_proportional_to_area_with_outward_normals() -> None:
    vertices_m = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [0, 3, 5], [0, 0, 7.0]])
    mesh = Mesh(vertices_m, np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    samples = SurfaceSampler(mesh).sample(20_000, np.random.default_rng(0))
    lower = samples.points_m[:, 2] == 0
    assert lower.mean() == pytest.approx(0.5 / (0.5 + 3.0), abs=0.01)
    np.testing.assert_allclose(samples.normals[lower], [[0, 0, 1]] * lower.sum(), atol=1e-12)
    np.testing.assert_allclose(samples.normals[~lower], [[1, 0, 0]] * (~lower).sum(), atol=1e-12)
    assert samples.points_m[lower, :2].sum(axis=1).max() <= 1
    np.testing.assert_allclose(samples.points_m[lower].mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)


def test_mesh_without_area_is_refused() -> None:
    for faces in (np.zeros((0, 3), np.int32), np.array([[0, 1, 0]], np.int32)):
        with pytest.raises(ValueError, match="no area"):
            SurfaceSampler(Mesh(np.eye(3), faces))


@given(seed=SEEDS, triangles=st.integers(1, 20), spacing_m=st.floats(0.02, 1.0))
def test_every_point_of_the_surface_is_near_a_covering_point(seed: int, triangles: int, spacing_m: float) -> None:
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng, triangles)
    corners_m = mesh.vertices_m.reshape(-1, 3, 3)
    weights = rng.dirichlet([0.5, 0.5, 0.5], (len(corners_m), 200))
    surface_m = np.concatenate([np.einsum("tni,tij->tnj", weights, corners_m).reshape(-1, 3), mesh.vertices_m])
    distance_m, _ = cKDTree(covering_points(mesh, spacing_m)).query(surface_m)
    assert distance_m.max() <= spacing_m


def test_fine_detail_gives_few_covering_points() -> None:
    rng = np.random.default_rng(0)
    corners_m = rng.uniform(0, 1, (20_000, 1, 3)) + rng.uniform(0, 1e-3, (20_000, 3, 3))
    mesh = Mesh(corners_m.reshape(-1, 3), np.arange(60_000, dtype=np.int32).reshape(-1, 3))
    assert len(covering_points(mesh, 0.5)) < 200


@given(seed=SEEDS, points=st.integers(1, 40), count=st.integers(0, 45))
def test_each_point_is_the_farthest_from_those_before(seed: int, points: int, count: int) -> None:
    points_m = np.random.default_rng(seed).normal(size=(points, 3))
    chosen = farthest_points(points_m, count)
    assert len(set(chosen.tolist())) == len(chosen) == min(points, count)
    for k in range(1, len(chosen)):
        distance_m = np.linalg.norm(points_m[:, None] - points_m[chosen[:k]], axis=2).min(axis=1)
        assert distance_m[chosen[k]] == distance_m.max()


@given(seed=SEEDS, points=st.integers(1, 30))
def test_short_path_goes_to_the_nearest_point_left(seed: int, points: int) -> None:
    points_m = np.random.default_rng(seed).normal(size=(points, 3))
    order = short_path(points_m).tolist()
    assert sorted(order) == list(range(points))
    assert points_m[order[0], 2] == points_m[:, 2].min()
    for k in range(1, points):
        distance_m = np.linalg.norm(points_m[order[k:]] - points_m[order[k - 1]], axis=1)
        assert distance_m.argmin() == 0
