"""Random cameras round generated cages: clear of steel, steel in both eyes, and independent of each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dataset_builder.cameras.camera_placement import MAX_ROLL_DEG, RANDOM_RULES, with_random_stations
from dataset_builder.cameras.rigs import STEREO_CAMERAS, focal_of_view_px, rig_cameras
from dataset_builder.cameras.trajectories import camera_offsets_m, look_at_with_rig, poses, view_count
from dataset_builder.scene.cages.generate import FAMILIES
from dataset_builder.scene.environments.surroundings import CameraSpace
from dataset_builder.scene.model import Assembly
from dataset_builder.specs.config_specs import FocalRigSpec, GeneratedCageSpec, RandomViewsSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.geometry.cameras import camera_centre, ideal_K

SPACE = CameraSpace(20.0, clear_radius_m=20.0)
VIEWS = 6
SPEC = RandomViewsSpec(VIEWS, seed=4)
RIG = STEREO_CAMERAS["Luxonis OAK-D"]


@pytest.fixture(scope="module")
def cages() -> Mapping[str, Assembly]:
    return {family: make_assembly(GeneratedCageSpec("train", 0, 3, family)) for family in FAMILIES}


@pytest.fixture(scope="module")
def views(cages: Mapping[str, Assembly]) -> Mapping[str, RandomViewsSpec]:
    return {name: placed(SPEC, cage) for name, cage in cages.items()}


def placed(spec: RandomViewsSpec, cage: Assembly, space: CameraSpace = SPACE) -> RandomViewsSpec:
    return with_random_stations(spec, cage, space, RIG, "cage")


def steel(assembly: Assembly) -> trimesh.Trimesh:
    return trimesh.util.concatenate(
        [trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False) for part in assembly.parts]
    )


@pytest.mark.parametrize("family", FAMILIES)
def test_eyes_are_clear_of_steel_and_see_it(
    cages: Mapping[str, Assembly], views: Mapping[str, RandomViewsSpec], family: str
) -> None:
    mesh, cage = steel(cages[family]), cages[family]
    rays = 40, 30
    rig = FocalRigSpec(*rays, baseline_m=RIG.baseline_m, camera=RIG.camera, focal_px=RIG.focal_px)
    assert view_count(views[family]) == VIEWS
    for pose in poses(views[family], np.zeros(3), RIG, cage.bars):
        for camera in rig_cameras(rig, pose).values():
            eye_m = camera_centre(camera.cam_from_world)
            assert np.linalg.norm(mesh.vertices - eye_m, axis=1).min() > RANDOM_RULES.clearance_m(
                SPEC.distances_m[0]
            )
            assert eye_m[2] >= 0.1
            directions = camera.rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
            is_hit = mesh.ray.intersects_any(np.tile(eye_m, (len(directions), 1)), directions)
            assert is_hit.mean() > RANDOM_RULES.min_steel_share / 2  # Other rays than those of the placement.


def test_views_of_a_longer_list_begin_with_those_of_a_shorter_one(
    cages: Mapping[str, Assembly], views: Mapping[str, RandomViewsSpec]
) -> None:
    family = next(iter(FAMILIES))
    fewer = placed(replace(SPEC, views=2), cages[family])
    assert fewer.stations == views[family].stations[:2]
    other = placed(RandomViewsSpec(2, seed=5), cages[family])
    assert not set(other.stations) & set(views[family].stations)


def test_distances_aims_and_rolls_vary(views: Mapping[str, RandomViewsSpec]) -> None:
    stations = [station for spec in views.values() for station in spec.stations]
    rolls_deg = np.array([roll_deg for _, _, roll_deg in stations])
    assert rolls_deg.std() > 5
    assert (np.abs((rolls_deg + 45) % 90 - 45) <= MAX_ROLL_DEG).all()
    distances_m = [np.linalg.norm(np.subtract(centre, aimed)) for centre, aimed, _ in stations]
    assert min(distances_m) < 0.7
    assert max(distances_m) > 3
    offsets = [camera_offsets_m(spec, np.ones(3), ()) for spec in views.values()]
    assert np.allclose(np.concatenate(offsets) + 1, [centre for centre, _, _ in stations])


def test_cage_without_space_for_cameras_is_refused(cages: Mapping[str, Assembly]) -> None:
    cage = next(iter(cages.values()))
    with pytest.raises(InputError, match="view 0"):
        placed(SPEC, cage, CameraSpace(0.01, clear_radius_m=0.01))


def test_rolled_rig_turns_about_its_line_of_sight() -> None:
    centre_m, target_m, baseline_m = np.array([2.0, 1.0, 1.5]), np.array([0.1, 0.2, 0.3]), 0.1
    upright = look_at_with_rig(centre_m, target_m, baseline_m)
    rolled = look_at_with_rig(centre_m, target_m, baseline_m, 90.0)
    for pose in (upright, rolled):
        np.testing.assert_allclose(camera_centre(pose), centre_m, atol=1e-12)
        seen_m = pose[:3, :3] @ target_m + pose[:3, 3]
        np.testing.assert_allclose(seen_m[:2], [baseline_m / 2, 0.0], atol=1e-12)
    # A camera turned clockwise by 90 degrees has its x axis where its y axis, downwards, was.
    np.testing.assert_allclose(rolled[0, :3] @ upright[1, :3], 1.0, atol=0.01)


@pytest.mark.parametrize("camera", STEREO_CAMERAS.values(), ids=STEREO_CAMERAS)
def test_rig_of_a_named_camera_has_its_focal_length(camera: FocalRigSpec) -> None:
    eyes = rig_cameras(camera, np.eye(4))
    assert eyes["left"].K[0, 0] == eyes["left"].K[1, 1] == camera.focal_px
    assert eyes["right"].cam_from_world[0, 3] == -camera.baseline_m
    half = ideal_K(640, 360, camera.focal_px)
    assert (half[0, 0], half[0, 2]) == (camera.focal_px / 2, 319.5)


def test_field_of_view_gives_the_focal_length() -> None:
    assert focal_of_view_px(90.0) == 640.0
    assert focal_of_view_px(2 * np.degrees(np.arctan(640 / 882.5))) == 882.5
