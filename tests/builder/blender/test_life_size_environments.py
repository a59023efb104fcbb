"""Environments of life-size cages, hall and deck: clear space, floor, closed horizon, surfaces, light.

Blender runs in a separate process, ``python -m tests.builder.blender.test_life_size_environments FOLDER``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.environments import deck, hall
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import Part, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import merge_meshes
from dataset_builder.specs.config_specs import AppearanceSpec, ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at
from tests.builder.blender.cages import cage
from tests.builder.blender.probe import RunProbe

PLACES: dict[str, Callable[[], tuple[Part, ...]]] = {"hall": hall.hall, "deck": deck.deck}
CLEAR_M = {"hall": hall.CLEAR_M, "deck": deck.CLEAR_M}
FLOORS = ("floor", "marking", "panels", "joists", "storey", "ground")
"""First words of the names of surfaces that may be below the clear space."""
LIGHTS = (None, "dusk", "spotlight", "backlight", "night")
CAMERA = Camera(
    ideal_K(96, 54), np.zeros(5), look_at(np.array([3.1, -2.4, 1.5]), np.array([0.0, 0.0, 0.7])), 96, 54
)


def probe(folder: Path) -> None:
    """Render the environments with several lights and cast their ground truth (runs in the Blender process)."""
    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.render import render_depth
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    steel = cage(0.6, 1.8, 0.02)
    arrays: dict[str, ndarray] = {}
    for place in PLACES:
        for light in LIGHTS:
            appearance = AppearanceSpec((light,) if light else ())
            build_scene(steel, SceneSpec("s", LatticeSpec(), None, place, appearance))
            configure_colour(threads=1)
            truth = RayCaster(evaluated_world_mesh()).cast(CAMERA)
            key = f"{place}/{light}"
            arrays[f"{key}/colour"] = render_colour(CAMERA, truth.mask, ColourSpec(2, 2), 1, folder)
            arrays[f"{key}/depth"], arrays[f"{key}/mask"] = truth.depth_m, truth.mask
            if light is None:
                arrays[f"{key}/cycles"] = render_depth(CAMERA, folder)
    np.savez(folder / "arrays.npz", **arrays)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_probe: RunProbe) -> Path:
    return run_probe("tests.builder.blender.test_life_size_environments", tmp_path_factory.mktemp("environments"))


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, ndarray]:
    return dict(np.load(folder / "arrays.npz"))


def caster(parts: tuple[Part, ...]) -> RayCaster:
    mesh = merge_meshes([part.mesh for part in parts])
    return RayCaster(WorldMesh(mesh.vertices_m, mesh.faces, np.zeros(len(mesh.faces), np.uint16)))


def eyes_m(place: str, count: int, rng: np.random.Generator) -> Float64[ndarray, "n 3"]:
    """Return random points of the space for cameras."""
    space = SURROUNDINGS[place].cameras
    points_m = rng.uniform([-space.radius_m] * 2 + [0.1], [space.radius_m] * 2 + [space.ceiling_m], (count, 3))
    return np.asarray(points_m[space.contains(points_m)])


@pytest.mark.parametrize("place", PLACES)
def test_space_for_cameras_is_clear(place: str) -> None:
    space = SURROUNDINGS[place].cameras
    assert space.radius_m <= space.clear_radius_m <= CLEAR_M[place]
    assert place != "hall" or space.ceiling_m < hall.CLEAR_HEIGHT_M
    for part in PLACES[place]():
        surface = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        points_m = np.concatenate([surface.vertices, trimesh.sample.sample_surface(surface, 3000, seed=1)[0]])
        is_low = points_m[:, 2] < (hall.CLEAR_HEIGHT_M if place == "hall" else np.inf)
        plan_m = np.hypot(points_m[:, 0], points_m[:, 1])
        if part.name.partition("-")[0] in FLOORS:
            assert points_m[plan_m < CLEAR_M[place], 2].max(initial=0.0) <= 0.0, part.name
        else:
            assert plan_m[is_low].min(initial=np.inf) > CLEAR_M[place], part.name


@pytest.mark.parametrize("place", PLACES)
def test_floor_is_at_the_foot_of_the_steel(place: str) -> None:
    rng = np.random.default_rng(3)
    above_m = eyes_m(place, 4000, rng)
    down = np.tile([0.0, 0.0, -1.0], (len(above_m), 1))
    height_m = above_m[:, 2] - caster(PLACES[place]()).hits(above_m, down).range_m
    assert (np.abs(height_m) < 1e-6).mean() > (0.99 if place == "deck" else 0.999999)
    assert height_m.min() > -0.03, "a joint of the deck is closed below"


@pytest.mark.parametrize("place", PLACES)
def test_every_ray_below_the_horizon_hits_a_surface(place: str) -> None:
    rng = np.random.default_rng(4)
    origins_m = eyes_m(place, 40_000, rng)
    directions = rng.normal(size=origins_m.shape) * [1.0, 1.0, 0.15]
    if place == "deck":
        directions[:, 2] = -np.abs(directions[:, 2])
    range_m = caster(PLACES[place]()).hits(origins_m, directions).range_m
    assert np.isfinite(range_m).all()
    assert range_m.min() > 0.05


def _flat_faces(parts: tuple[Part, ...]) -> dict[tuple[int, float], list[tuple[int, ndarray]]]:
    """Return the triangles perpendicular to an axis by axis and place: number of their body and their corners."""
    planes: dict[tuple[int, float], list[tuple[int, ndarray]]] = {}
    number = 0
    for part in parts:
        whole = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        for solid in whole.split(only_watertight=False):
            number += 1
            for corners_m in solid.triangles:
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
@pytest.mark.parametrize("place", PLACES)
def test_no_surfaces_coincide(place: str) -> None:
    for plane, faces in _flat_faces(PLACES[place]()).items():
        triangles = np.array([corners_m for _, corners_m in faces])
        numbers = np.array([number for number, _ in faces])
        for number, corners_m in faces:
            others = triangles[numbers > number]
            near = (others.max(axis=1) > corners_m.min(axis=0)) & (others.min(axis=1) < corners_m.max(axis=0))
            assert not _overlap(corners_m, others[near.all(axis=1)]).any(), (plane, corners_m)


@pytest.mark.parametrize("place", PLACES)
def test_environments_are_small(place: str) -> None:
    parts = PLACES[place]()
    assert len({part.name for part in parts}) == len(parts)
    assert sum(len(part.mesh.faces) for part in parts) < 20_000


@pytest.mark.parametrize("place", SURROUNDINGS)
def test_environments_have_a_light_and_surfaces_that_let_light_through(place: str) -> None:
    surroundings = SURROUNDINGS[place]
    assert None in surroundings.light
    words = {part.name.partition("-")[0] for part in surroundings.parts()}
    assert {*surroundings.enclosure, *surroundings.roof} <= words


@pytest.mark.parametrize("place", PLACES)
def test_cycles_depth_equals_ground_truth(arrays: dict[str, ndarray], place: str) -> None:
    cycles_m, truth_m = (arrays[f"{place}/None/{name}"] for name in ("cycles", "depth"))
    assert np.isfinite(truth_m).all()
    error_m = np.abs(cycles_m.astype(float) - truth_m)
    assert (error_m > 1e-4 * np.maximum(truth_m, 1.0)).mean() < 3e-3
    assert (truth_m > 0).all() if place == "hall" else (truth_m > 0).mean() > 0.7


@pytest.mark.parametrize("place", PLACES)
def test_exposure_suits_the_light(arrays: dict[str, ndarray], place: str) -> None:
    rgb = {light: arrays[f"{place}/{light}/colour"].astype(float) for light in LIGHTS}
    for light, colour in rgb.items():
        assert (colour.min(axis=2) >= 250).mean() < 0.02, light
    assert 80 < rgb[None].mean() < 175
    assert 50 < rgb[None][arrays[f"{place}/None/mask"]].mean() < 160
    assert 8 < rgb["dusk"].mean() < 0.6 * rgb[None].mean()
    assert 8 < rgb["spotlight"].mean() < 0.75 * rgb[None].mean()
    for first, second in pairwise(LIGHTS):
        assert np.abs(rgb[first] - rgb[second]).mean() > 3


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
