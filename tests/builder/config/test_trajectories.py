"""Camera protocols: how many, where, aimed how, and everything in frame in both eyes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dataset_builder.config.catalog import CONFIGS
from dataset_builder.config.specs import ConfigSpec
from dataset_builder.config.trajectories import poses, subset
from dataset_builder.scene.assemblies import aim_point_m, check_fits, make_assembly
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.errors import MeshError
from rebar_depth_bench.geometry.cameras import camera_centre, ideal_K, pixel_rays, project, right_of_rig, transform


@pytest.fixture(params=["lattice", "lattice-orbit"])
def config(request: pytest.FixtureRequest) -> ConfigSpec:
    return CONFIGS[request.param]()


def test_the_papers_numbers_of_views_and_distances() -> None:
    target = aim_point_m(make_assembly(CONFIGS["lattice"]().scene.assembly))
    assert target.tolist() == [0.0, 0.0, 0.05]
    dome = CONFIGS["lattice"]()
    distances = [np.linalg.norm(camera_centre(pose) - target) for pose in poses(dome.protocol, target, dome.rig)]
    assert len(distances) == 504
    assert min(distances) == pytest.approx(0.22)
    assert max(distances) == pytest.approx(0.43)
    ring = CONFIGS["lattice-orbit"]()
    centres = np.array([camera_centre(pose) for pose in poses(ring.protocol, target, ring.rig)])
    assert len(centres) == 100
    assert np.ptp(centres[:, 2]) < 1e-12


def test_no_two_views_are_the_same(config: ConfigSpec) -> None:
    found = poses(config.protocol, np.array([0.0, 0.0, 0.05]), config.rig)
    assert len({pose.round(9).tobytes() for pose in found}) == len(found)


def test_every_pose_has_the_whole_assembly_in_frame_in_both_eyes(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    vertices = np.concatenate([part.mesh.vertices_m for part in assembly.parts])[::7]
    corners = np.array(np.meshgrid(*zip(vertices.min(0), vertices.max(0), strict=True))).reshape(3, -1).T
    K = ideal_K(config.rig.width, config.rig.height)
    for left in poses(config.protocol, aim_point_m(assembly), config.rig):
        for pose in (left, right_of_rig(left, config.rig.baseline_m)):
            in_camera = transform(pose, corners)
            uv = project(K, in_camera)
            assert (in_camera[:, 2] > 0).all()
            assert (uv >= 0).all()
            assert (uv <= [config.rig.width - 1, config.rig.height - 1]).all()


def test_the_rigs_middle_axis_passes_through_the_target(config: ConfigSpec) -> None:
    target = np.array([0.0, 0.0, 0.05])
    for left in poses(config.protocol, target, config.rig)[::17]:
        seen_left = transform(left, target)
        seen_right = transform(right_of_rig(left, config.rig.baseline_m), target)
        assert seen_left == pytest.approx([config.rig.baseline_m / 2, 0, seen_left[2]], abs=1e-9)
        assert seen_right == pytest.approx([-config.rig.baseline_m / 2, 0, seen_left[2]], abs=1e-9)


def test_steel_covers_as_much_of_the_frame_as_in_the_paper(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    meshes = [part.mesh for part in assembly.parts]
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    steel = WorldMesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(np.int32),
        np.ones(sum(len(mesh.faces) for mesh in meshes), np.uint16),
    )
    caster, rays = RayCaster(steel), pixel_rays(ideal_K(160, 90), 160, 90)
    left_poses = poses(config.protocol, aim_point_m(assembly), config.rig)[::5]
    share = np.mean([caster.cast(rays, pose).mask.mean() for pose in left_poses])
    assert 0.045 <= share <= 0.072


def test_cameras_stand_above_the_board_and_upright(config: ConfigSpec) -> None:
    for left in poses(config.protocol, np.array([0.0, 0.0, 0.05]), config.rig):
        assert camera_centre(left)[2] > 0.05
        assert left[1, 2] < 0  # the camera's y points down


def test_subset_is_spread_evenly_and_whole_when_all_are_wanted() -> None:
    assert subset(504, None) == list(range(504))
    assert subset(504, 504) == list(range(504))
    assert subset(504, 900) == list(range(504))
    assert subset(10, 1) == [5]
    chosen = subset(504, 6)
    assert chosen == [42, 126, 210, 294, 378, 462]
    for wanted in range(1, 60):
        indices = subset(504, wanted)
        assert len(set(indices)) == wanted
        gaps = np.diff(indices)
        assert not len(gaps) or np.ptp(gaps) <= 1


@pytest.mark.parametrize(
    ("scale", "shift_m", "words"),
    [
        (1000, 0.0, "is the unit right"),
        (1, -0.01, "reaches down to z = -0.00995 m, ribs and all, expected 0 or above"),
    ],
)
def test_an_assembly_that_does_not_fit_the_cameras_is_refused(scale: float, shift_m: float, words: str) -> None:
    config = CONFIGS["lattice"]()
    assembly = make_assembly(config.scene.assembly)
    check_fits(assembly, config)
    moved = [
        replace(part, mesh=replace(part.mesh, vertices_m=scale * part.mesh.vertices_m + [0, 0, shift_m]))
        for part in assembly.parts
    ]
    with pytest.raises(MeshError, match=words):
        check_fits(replace(assembly, parts=tuple(moved)), config)
