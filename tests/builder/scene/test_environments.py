"""Geometry of the environments: closed surfaces, clear space for cameras, floor, closed horizon."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.environments import deck, hall
from dataset_builder.scene.environments.laboratory import laboratory
from dataset_builder.scene.environments.outdoors import CLEAR_M, outdoors
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import NOT_STEEL, Part, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import merge_meshes

ENVIRONMENTS: dict[str, Callable[[], tuple[Part, ...]]] = {
    "laboratory": laboratory,
    "outdoors": outdoors,
    "hall": hall.hall,
    "deck": deck.deck,
}
LIFE_SIZE = pytest.mark.parametrize("place", ["hall", "deck"])
CLEAR_AND_HEIGHT_M = {
    "outdoors": (CLEAR_M, np.inf),
    "hall": (hall.CLEAR_M, hall.CLEAR_HEIGHT_M),
    "deck": (deck.CLEAR_M, np.inf),
}
"""Radius and height of the clear space."""
FLOORS = ("floor", "marking", "panels", "joists", "storey", "ground", "slab", "blinding")
"""First words of the names of surfaces that may be below the clear space."""


def solid(part: Part) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)


def caster(place: str) -> RayCaster:
    mesh = merge_meshes([part.mesh for part in ENVIRONMENTS[place]()])
    return RayCaster(WorldMesh(mesh.vertices_m, mesh.faces, np.zeros(len(mesh.faces), np.uint16)))


def eyes_m(place: str, count: int, rng: np.random.Generator) -> Float64[ndarray, "n 3"]:
    """Return random points of the space for cameras."""
    space = SURROUNDINGS[place].cameras
    points_m = rng.uniform([-space.radius_m] * 2 + [0.1], [space.radius_m] * 2 + [space.ceiling_m], (count, 3))
    return np.asarray(points_m[space.contains(points_m)])


@pytest.mark.parametrize("place", ENVIRONMENTS)
def test_environments_are_few_closed_surfaces_that_are_not_steel(place: str) -> None:
    parts = ENVIRONMENTS[place]()
    assert len({part.name for part in parts}) == len(parts)
    assert sum(len(part.mesh.faces) for part in parts) < 20_000
    for part in parts:
        assert part.bar_id == NOT_STEEL
        assert solid(part).is_watertight, part.name
        assert solid(part).is_winding_consistent, part.name
        assert solid(part).volume > 0, part.name


@pytest.mark.parametrize("place", SURROUNDINGS)
def test_environments_have_a_light_and_surfaces_that_let_light_through(place: str) -> None:
    surroundings = SURROUNDINGS[place]
    assert None in surroundings.light
    words = {part.name.partition("-")[0] for part in surroundings.parts()}
    assert {*surroundings.enclosure, *surroundings.roof} <= words


@pytest.mark.parametrize("place", CLEAR_AND_HEIGHT_M)
def test_space_for_cameras_is_clear(place: str) -> None:
    clear_m, height_m = CLEAR_AND_HEIGHT_M[place]
    for part in ENVIRONMENTS[place]():
        points_m = np.concatenate(
            [part.mesh.vertices_m, trimesh.sample.sample_surface(solid(part), 3000, seed=1)[0]]
        )
        plan_m = np.hypot(points_m[:, 0], points_m[:, 1])
        if part.name.partition("-")[0] in FLOORS:
            assert points_m[plan_m < clear_m, 2].max(initial=0.0) <= 0.0, part.name
        else:
            assert plan_m[points_m[:, 2] < height_m].min(initial=np.inf) > clear_m, part.name


@LIFE_SIZE
def test_cameras_stay_in_the_clear_space(place: str) -> None:
    space, (clear_m, height_m) = SURROUNDINGS[place].cameras, CLEAR_AND_HEIGHT_M[place]
    assert space.radius_m <= space.clear_radius_m <= clear_m
    assert space.ceiling_m < height_m


def test_slab_of_the_outdoor_scene_is_at_the_foot_of_the_steel() -> None:
    parts = {part.name: part for part in outdoors()}
    assert parts["slab"].mesh.vertices_m[:, 2].max() == 0.0
    assert parts["ground"].mesh.vertices_m[:, 2].max() < -0.05


@LIFE_SIZE
def test_floor_is_at_the_foot_of_the_steel(place: str) -> None:
    above_m = eyes_m(place, 4000, np.random.default_rng(3))
    down = np.tile([0.0, 0.0, -1.0], (len(above_m), 1))
    height_m = above_m[:, 2] - caster(place).hits(above_m, down).range_m
    assert (np.abs(height_m) < 1e-6).mean() > (0.99 if place == "deck" else 0.999999)
    assert height_m.min() > -0.03, "a joint of the deck is closed below"


@LIFE_SIZE
def test_every_ray_below_the_horizon_hits_a_surface(place: str) -> None:
    rng = np.random.default_rng(4)
    origins_m = eyes_m(place, 40_000, rng)
    directions = rng.normal(size=origins_m.shape) * [1.0, 1.0, 0.15]
    if place == "deck":
        directions[:, 2] = -np.abs(directions[:, 2])
    range_m = caster(place).hits(origins_m, directions).range_m
    assert np.isfinite(range_m).all()
    assert range_m.min() > 0.05


def _flat_faces(parts: tuple[Part, ...]) -> dict[tuple[int, float], list[tuple[int, ndarray]]]:
    """Return the triangles perpendicular to an axis by axis and place: number of their body and their corners."""
    planes: dict[tuple[int, float], list[tuple[int, ndarray]]] = {}
    number = 0
    for part in parts:
        for piece in solid(part).split(only_watertight=False):
            number += 1
            for corners_m in piece.triangles:
                for axis in np.flatnonzero(np.ptp(corners_m, axis=0) < 1e-7).tolist():
                    place = axis, round(float(corners_m[0, axis]), 5)
                    planes.setdefault(place, []).append((number, np.delete(corners_m, axis, axis=1)))
    return planes


def _overlap(first: Float64[ndarray, "3 2"], others: Float64[ndarray, "n 3 2"]) -> ndarray:
    """Return which triangles overlap the first one by more than 10 um: no edge of either separates them."""
    is_apart = np.zeros(len(others), bool)
    for edges in (
        np.tile(np.roll(first, -1, axis=0) - first, (len(others), 1, 1)),
        np.roll(others, -1, 1) - others,
    ):
        normals = np.stack([-edges[..., 1], edges[..., 0]], axis=-1) / np.linalg.norm(
            edges, axis=-1, keepdims=True
        )
        ours = np.einsum("nek,ck->nec", normals, first)
        theirs = np.einsum("nek,nck->nec", normals, others)
        shared_m = np.minimum(ours.max(-1), theirs.max(-1)) - np.maximum(ours.min(-1), theirs.min(-1))
        is_apart |= (shared_m < 1e-5).any(axis=1)
    return ~is_apart


@pytest.mark.slow
@LIFE_SIZE
def test_no_surfaces_coincide(place: str) -> None:
    for plane, faces in _flat_faces(ENVIRONMENTS[place]()).items():
        triangles = np.array([corners_m for _, corners_m in faces])
        numbers = np.array([number for number, _ in faces])
        for number, corners_m in faces:
            others = triangles[numbers > number]
            near = (others.max(axis=1) > corners_m.min(axis=0)) & (others.min(axis=1) < corners_m.max(axis=0))
            assert not _overlap(corners_m, others[near.all(axis=1)]).any(), (plane, corners_m)
