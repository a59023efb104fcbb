"""Camera trajectories: views, distances, aim, assembly in frame, and domes measured to the nearest steel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import (
    Cylinders,
    aim_point_m,
    camera_offsets_m,
    poses,
    radii_at_steel_distance_m,
    subset,
    view_count,
)
from dataset_builder.catalog.named_configs import CONFIGS, PIER_DOME
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.environments.outdoors import CLEAR_M
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import Assembly
from dataset_builder.specs.config_specs import ConfigSpec, DomeSpec, PierSpec, RigSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import MeshError
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.cameras import camera_centre, ideal_K, project, right_camera_pose, transform
from tests.builder.cameras.survey_cages import steel_caster


@pytest.fixture(params=["lattice", "lattice-orbit"])
def config(request: pytest.FixtureRequest) -> ConfigSpec:
    return CONFIGS[request.param]()


def test_poses_are_distinct_upright_above_the_board_and_centred_on_the_target(config: ConfigSpec) -> None:
    target = np.array([0.0, 0.0, 0.05])
    lefts = poses(config.protocol, target, config.rig)
    assert len({pose.round(9).tobytes() for pose in lefts}) == len(lefts)
    for left in lefts:
        assert camera_centre(left)[2] > 0.05
        assert left[1, 2] < 0  # The camera's y axis points down.
        target_in_left_m = transform(left, target)
        target_in_right_m = transform(right_camera_pose(left, config.rig.baseline_m), target)
        assert target_in_left_m == pytest.approx([config.rig.baseline_m / 2, 0, target_in_left_m[2]], abs=1e-9)
        assert target_in_right_m == pytest.approx([-config.rig.baseline_m / 2, 0, target_in_left_m[2]], abs=1e-9)


def test_assembly_is_in_frame_of_both_cameras(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    vertices = assembly.vertices_m[::7]
    corners = np.array(np.meshgrid(*zip(vertices.min(0), vertices.max(0), strict=True))).reshape(3, -1).T
    K = ideal_K(config.rig.width, config.rig.height)
    for left in poses(config.protocol, aim_point_m(assembly), config.rig):
        for pose in (left, right_camera_pose(left, config.rig.baseline_m)):
            corners_cam_m = transform(pose, corners)
            uv = project(K, corners_cam_m)
            assert (corners_cam_m[:, 2] > 0).all()
            assert (uv >= 0).all()
            assert (uv <= [config.rig.width - 1, config.rig.height - 1]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lattice", "lattice-orbit", "pile", "pier"])
def test_steel_pixel_share_matches_paper(name: str) -> None:
    config = CONFIGS[name]()
    assembly = make_assembly(config.scene.assembly)
    caster = steel_caster(assembly)
    rig = replace(config.rig, width=160, height=90)
    left_poses = poses(config.protocol, aim_point_m(assembly), rig, assembly.bars)[::5]
    views = [[caster.cast(eye).mask.mean() for eye in rig_cameras(rig, pose).values()] for pose in left_poses]
    assert 0.045 <= np.mean(views) <= 0.072
    assert np.min(views) > 0.02, "steel in every view of both eyes"


def test_subset_is_evenly_spread() -> None:
    assert subset(504, None) == list(range(504))
    assert subset(504, 504) == list(range(504))
    assert subset(504, 900) == list(range(504))
    assert subset(10, 1) == [5]
    indices_of_6 = subset(504, 6)
    assert indices_of_6 == [42, 126, 210, 294, 378, 462]
    for count in range(1, 60):
        indices = subset(504, count)
        assert len(set(indices)) == count
        gaps = np.diff(indices)
        assert not len(gaps) or np.ptp(gaps) <= 1


@pytest.mark.parametrize(
    ("scale", "shift_m", "words"),
    [
        (1000, 0.0, "is the unit right"),
        (1, -0.01, "extends down to z = -0.00995 m, including its ribs, expected 0 or above"),
    ],
)
def test_assembly_outside_camera_limits_is_rejected(scale: float, shift_m: float, words: str) -> None:
    config = CONFIGS["lattice"]()
    assembly = make_assembly(config.scene.assembly)
    check_fits(assembly, config)
    moved = [
        replace(part, mesh=replace(part.mesh, vertices_m=scale * part.mesh.vertices_m + [0, 0, shift_m]))
        for part in assembly.parts
    ]
    with pytest.raises(MeshError, match=words):
        check_fits(replace(assembly, parts=tuple(moved)), config)


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
def test_pier_cameras_keep_directions_of_dome_above_ground_in_clear_area(
    pier: Assembly, offsets_m: np.ndarray
) -> None:
    centred = DomeSpec(PIER_DOME.radii_m, PIER_DOME.elevations_deg, PIER_DOME.azimuths)
    to_centre_m = np.array(camera_offsets_m(centred, aim_point_m(pier), ()))
    radii_m = np.linalg.norm(offsets_m, axis=1)
    assert len(offsets_m) == view_count(PIER_DOME) == 504
    directions = to_centre_m / np.linalg.norm(to_centre_m, axis=1)[:, None]
    assert np.abs(offsets_m / radii_m[:, None] - directions).max() < 1e-12
    assert np.abs(1000 * radii_m - np.round(1000 * radii_m)).max() < 1e-6, "whole millimetres"
    cylinders = Cylinders.from_bars(pier.bars)
    distances_m = cylinders.distance_m(aim_point_m(pier) + offsets_m)
    assert np.abs(distances_m - np.repeat(PIER_DOME.radii_m, SHELL)).max() < 0.00051

    lefts = poses(PIER_DOME, aim_point_m(pier), RigSpec(), pier.bars)
    rights = [right_camera_pose(left, RigSpec.baseline_m) for left in lefts]
    centres_m = np.array([camera_centre(pose) for pose in (*lefts, *rights)])
    assert centres_m[:, 2].min() > 0.6
    assert np.linalg.norm(centres_m[:, :2], axis=1).max() < SURROUNDINGS["outdoors"].cameras.radius_m < CLEAR_M
    assert cylinders.distance_m(centres_m).min() > 8 - RigSpec.baseline_m


def test_cameras_are_at_the_outermost_place_at_their_distance() -> None:
    bars = [Bar(n, "bar", 0.1, ((x, 0.0, -1.0), (x, 0.0, 1.0))) for n, x in enumerate((0.0, 10.0), start=1)]
    [radius_m] = radii_at_steel_distance_m(ORIGIN, np.array([[1.0, 0.0, 0.0]]), np.array([2.0]), bars)
    assert radius_m == pytest.approx(12.05, abs=1e-6)


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
def test_domes_that_no_bars_fit_are_rejected(bars: tuple[Bar, ...], words: str) -> None:
    dome = DomeSpec((0.5, 3.0), (10.0,), 4, "nearest steel")
    with pytest.raises(ValueError, match=words):
        camera_offsets_m(dome, ORIGIN, bars)
    radii_m = np.linalg.norm(camera_offsets_m(replace(dome, distance_to="centre"), ORIGIN, bars), axis=1)
    assert radii_m.tolist() == pytest.approx([0.5] * 4 + [3.0] * 4), "distances from the centre need no bars"
