"""Camera trajectories: number of views, distances, aim, and assembly in frame in both cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, poses, subset
from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import merge_meshes
from dataset_builder.specs.config_specs import ConfigSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import MeshError
from rebar_depth_bench.geometry.cameras import (
    camera_centre,
    ideal_K,
    project,
    right_camera_pose,
    transform,
)


@pytest.fixture(params=["lattice", "lattice-orbit"])
def config(request: pytest.FixtureRequest) -> ConfigSpec:
    return CONFIGS[request.param]()


def test_view_counts_and_distances_match_paper() -> None:
    target_m = aim_point_m(make_assembly(CONFIGS["lattice"]().scene.assembly))
    assert target_m.tolist() == [0.0, 0.0, 0.05]
    dome = CONFIGS["lattice"]()
    distances_m = [
        np.linalg.norm(camera_centre(pose) - target_m) for pose in poses(dome.protocol, target_m, dome.rig)
    ]
    assert len(distances_m) == 504
    assert min(distances_m) == pytest.approx(0.22)
    assert max(distances_m) == pytest.approx(0.43)
    ring = CONFIGS["lattice-orbit"]()
    centres_m = np.array([camera_centre(pose) for pose in poses(ring.protocol, target_m, ring.rig)])
    assert len(centres_m) == 100
    assert np.ptp(centres_m[:, 2]) < 1e-12


def test_all_poses_are_distinct(config: ConfigSpec) -> None:
    cameras_from_world = poses(config.protocol, np.array([0.0, 0.0, 0.05]), config.rig)
    assert len({pose.round(9).tobytes() for pose in cameras_from_world}) == len(cameras_from_world)


def test_assembly_is_in_frame_of_both_cameras(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    vertices = np.concatenate([part.mesh.vertices_m for part in assembly.parts])[::7]
    corners = np.array(np.meshgrid(*zip(vertices.min(0), vertices.max(0), strict=True))).reshape(3, -1).T
    K = ideal_K(config.rig.width, config.rig.height)
    for left in poses(config.protocol, aim_point_m(assembly), config.rig):
        for pose in (left, right_camera_pose(left, config.rig.baseline_m)):
            corners_cam_m = transform(pose, corners)
            uv = project(K, corners_cam_m)
            assert (corners_cam_m[:, 2] > 0).all()
            assert (uv >= 0).all()
            assert (uv <= [config.rig.width - 1, config.rig.height - 1]).all()


def test_rig_centre_axis_passes_through_target(config: ConfigSpec) -> None:
    target = np.array([0.0, 0.0, 0.05])
    for left in poses(config.protocol, target, config.rig)[::17]:
        target_in_left_m = transform(left, target)
        target_in_right_m = transform(right_camera_pose(left, config.rig.baseline_m), target)
        assert target_in_left_m == pytest.approx([config.rig.baseline_m / 2, 0, target_in_left_m[2]], abs=1e-9)
        assert target_in_right_m == pytest.approx([-config.rig.baseline_m / 2, 0, target_in_left_m[2]], abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lattice", "lattice-orbit", "pile", "pier"])
def test_steel_pixel_share_matches_paper(name: str) -> None:
    config = CONFIGS[name]()
    assembly = make_assembly(config.scene.assembly)
    steel = merge_meshes([part.mesh for part in assembly.parts])
    caster = RayCaster(WorldMesh(steel.vertices_m, steel.faces, np.ones(len(steel.faces), np.uint16)))
    rig = replace(config.rig, width=160, height=90)
    left_poses = poses(config.protocol, aim_point_m(assembly), rig, assembly.bars)[::5]
    views = [[caster.cast(eye).mask.mean() for eye in rig_cameras(rig, pose).values()] for pose in left_poses]
    assert 0.045 <= np.mean(views) <= 0.072
    assert np.min(views) > 0.02, "steel in every view of both eyes"


def test_cameras_are_above_board_and_upright(config: ConfigSpec) -> None:
    for left in poses(config.protocol, np.array([0.0, 0.0, 0.05]), config.rig):
        assert camera_centre(left)[2] > 0.05
        assert left[1, 2] < 0  # The camera's y axis points down.


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
