"""Domes measured to the nearest steel: the pier's cameras, the solver, and invalid requests."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataset_builder.cameras.steel_distance import Cylinders, radii_at_steel_distance_m
from dataset_builder.cameras.trajectories import aim_point_m, camera_offsets_m, poses, view_count
from dataset_builder.catalog.named_configs import LATTICE_DOME, PIER_DOME, PILE_DOME
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.environments.outdoors import CLEAR_M
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import Assembly
from dataset_builder.specs.config_specs import DomeSpec, PierSpec, RigSpec
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.cameras import camera_centre, right_camera_pose

ORIGIN = np.zeros(3)
SHELL = len(PIER_DOME.elevations_deg) * PIER_DOME.azimuths


@pytest.fixture(scope="module")
def pier() -> Assembly:
    return pier_assembly(PierSpec())


@pytest.fixture(scope="module")
def offsets_m(pier: Assembly) -> np.ndarray:
    return np.array(camera_offsets_m(PIER_DOME, aim_point_m(pier), pier.bars))


def mesh_distance_m(point_m: np.ndarray, assembly: Assembly) -> float:
    """Return the distance to the surface: that to points on the edges of the triangles nearest to the point."""
    nearest_m = np.inf
    for part in assembly.parts:
        to_vertex_m = np.linalg.norm(part.mesh.vertices_m - point_m, axis=1)
        if to_vertex_m.min() > nearest_m + 0.2:  # No edge is longer.
            continue
        faces = part.mesh.faces[(to_vertex_m < to_vertex_m.min() + 0.1)[part.mesh.faces].any(axis=1)]
        a, b, c = (part.mesh.vertices_m[faces[:, k]] for k in range(3))
        for start_m, end_m in ((a, b), (b, c), (c, a)):
            along = np.linspace(0, 1, 41)[:, None, None]
            nearest_m = min(nearest_m, np.linalg.norm(start_m + along * (end_m - start_m) - point_m, axis=2).min())
    return float(nearest_m)


@pytest.mark.slow
def test_pier_shells_are_distances_to_surface_of_steel(pier: Assembly, offsets_m: np.ndarray) -> None:
    centres_m = aim_point_m(pier) + offsets_m
    for shell, radius_m in enumerate(PIER_DOME.radii_m):
        for index in (SHELL * shell, SHELL * shell + 37, SHELL * shell + 71):
            assert mesh_distance_m(centres_m[index], pier) == pytest.approx(radius_m, abs=0.001)


@pytest.mark.slow
def test_pier_keeps_directions_and_order_of_dome(pier: Assembly, offsets_m: np.ndarray) -> None:
    centred = DomeSpec(PIER_DOME.radii_m, PIER_DOME.elevations_deg, PIER_DOME.azimuths)
    to_centre_m = np.array(camera_offsets_m(centred, aim_point_m(pier), ()))
    radii_m = np.linalg.norm(offsets_m, axis=1)
    assert len(offsets_m) == view_count(PIER_DOME) == 504
    directions = to_centre_m / np.linalg.norm(to_centre_m, axis=1)[:, None]
    assert np.abs(offsets_m / radii_m[:, None] - directions).max() < 1e-12
    assert np.abs(1000 * radii_m - np.round(1000 * radii_m)).max() < 1e-6, "whole millimetres"
    distances_m = Cylinders.from_bars(pier.bars).distance_m(aim_point_m(pier) + offsets_m)
    assert np.abs(distances_m - np.repeat(PIER_DOME.radii_m, SHELL)).max() < 0.00051


@pytest.mark.slow
def test_pier_cameras_are_above_ground_in_clear_area(pier: Assembly) -> None:
    lefts = poses(PIER_DOME, aim_point_m(pier), RigSpec(), pier.bars)
    rights = [right_camera_pose(left, RigSpec.baseline_m) for left in lefts]
    centres_m = np.array([camera_centre(pose) for pose in (*lefts, *rights)])
    assert centres_m[:, 2].min() > 0.6
    assert np.linalg.norm(centres_m[:, :2], axis=1).max() < SURROUNDINGS["outdoors"].cameras.radius_m < CLEAR_M
    assert Cylinders.from_bars(pier.bars).distance_m(centres_m).min() > 8 - RigSpec.baseline_m


def test_other_domes_need_no_bars() -> None:
    for dome in (LATTICE_DOME, PILE_DOME):
        radii_m = np.linalg.norm(camera_offsets_m(dome, ORIGIN, ()), axis=1)
        assert radii_m.tolist() == pytest.approx(np.repeat(dome.radii_m, SHELL).tolist())


coordinate = st.floats(-1, 1)
point = st.tuples(coordinate, coordinate, coordinate)
lines = st.lists(st.lists(point, min_size=2, max_size=4, unique=True), min_size=1, max_size=4)


def brute_distance_m(point_m: np.ndarray, bars: list[Bar]) -> float:
    """Return the distance to solid cylinders along the segments, one segment at a time."""
    distances_m = []
    for bar in bars:
        for start, end in pairwise(np.array(bar.axis_m)):
            length_m = float(np.linalg.norm(end - start))
            along_m = float((point_m - start) @ (end - start)) / length_m
            across_m = float(np.linalg.norm(point_m - start - along_m * (end - start) / length_m))
            beyond_m = max(-along_m, along_m - length_m, 0.0)
            distances_m.append(np.hypot(beyond_m, max(across_m - bar.diameter_m / 2, 0.0)))
    return float(min(distances_m))


@pytest.mark.slow
@given(lines=lines, diameter_m=st.floats(0.01, 0.5), distance_m=st.floats(1.8, 9), direction=point)
def test_solution_is_outermost_point_at_distance(
    lines: list[list[tuple[float, float, float]]],
    diameter_m: float,
    distance_m: float,
    direction: tuple[float, float, float],
) -> None:
    bars = [Bar(n, "bar", diameter_m, tuple(line)) for n, line in enumerate(lines, start=1)]
    ray = np.array(direction) + np.array([0, 0, 2])
    ray /= np.linalg.norm(ray)
    [radius_m] = radii_at_steel_distance_m(ORIGIN, ray[None], np.array([distance_m]), bars)
    assert brute_distance_m(radius_m * ray, bars) == pytest.approx(distance_m, abs=1e-5)
    beyond = [brute_distance_m(m * ray, bars) for m in radius_m + np.linspace(0, 3, 13)]
    assert min(beyond) > distance_m - 1e-5


@pytest.mark.parametrize("radius_m", [1e-3, 1e9])
def test_extreme_radii_end(radius_m: float) -> None:
    bars = [Bar(1, "bar", 0.1, ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0)))]
    [found_m] = radii_at_steel_distance_m(ORIGIN, np.array([[0.0, 0.6, 0.8]]), np.array([radius_m]), bars)
    [distance_m] = Cylinders.from_bars(bars).distance_m(found_m * np.array([[0.0, 0.6, 0.8]]))
    assert distance_m == pytest.approx(radius_m, abs=1e-6)


@pytest.mark.parametrize(
    ("bars", "words"),
    [
        ((), "no bars to measure"),
        ((Bar(1, "bar", 0.1, ((0.0, 0.0, 1.0),)),), "no bars to measure"),
        ((Bar(1, "bar", 0.1, ((2.0, 0.0, -1.0), (2.0, 0.0, 1.0))),), "no steel is within 0.5 m"),
    ],
)
def test_unsolvable_domes_are_rejected(bars: tuple[Bar, ...], words: str) -> None:
    dome = DomeSpec((0.5, 3.0), (10.0,), 4, "nearest steel")
    with pytest.raises(ValueError, match=words):
        camera_offsets_m(dome, ORIGIN, bars)
