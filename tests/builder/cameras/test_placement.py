"""Survey cameras and random ones round generated cages: properties of the stations, from bars and meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy import ndarray
from scipy.spatial import cKDTree

from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.cameras.camera_placement import (
    MAX_ROLL_DEG,
    NEAR,
    RANDOM_RULES,
    SIGHT_TOLERANCE_M,
    SURVEY_RULES,
    with_random_stations,
    with_stations,
)
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, camera_offsets_m, poses, view_count
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.scene.cages.generate import FAMILIES
from dataset_builder.scene.environments.surroundings import GROUND_CLEARANCE_M, CameraSpace
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.point_sets import SurfaceSampler
from dataset_builder.scene.shapes.solids import merge_meshes, world_mesh
from dataset_builder.specs.config_specs import (
    STEREO_CAMERAS,
    ConfigSpec,
    FocalRigSpec,
    GeneratedCageSpec,
    RandomViewsSpec,
    RigSpec,
    SurveySpec,
)
from dataset_builder.user_files.cage_file import cage_file_spec, load_cage
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.geometry.cameras import camera_centre, inverse_rigid
from rebar_depth_bench.scoring.protocol import scored_pixels
from tests.builder.cameras.survey_cages import (
    bar_table,
    column,
    girder,
    scene,
    surface_distance_m,
    two_walls,
    wall,
)
from tests.builder.catalog.scene_files import scene_config, write_scene

pytestmark = pytest.mark.slow

DISTANCES_M = (0.5, 1.0, 4.0)
VIEWS = 20
KEYS = f"distances = [500, 1000, 4000]\nviews_per_distance = {VIEWS}"
SITE = CameraSpace(20.5, clear_radius_m=20.5)


@dataclass(frozen=True, eq=False)
class Placed:
    """A config with survey cameras, its assembly, and the places of its views, world metres."""

    config: ConfigSpec
    assembly: Assembly

    @property
    def survey(self) -> SurveySpec:
        assert isinstance(self.config.protocol, SurveySpec)
        return self.config.protocol

    @property
    def left_m(self) -> ndarray:
        return np.array([centre_m for centre_m, _ in self.survey.stations])

    @property
    def aimed_m(self) -> ndarray:
        return np.array([aimed_m for _, aimed_m in self.survey.stations])

    @property
    def distances_m(self) -> ndarray:
        return np.repeat(self.survey.distances_m, self.survey.views_per_distance)

    @property
    def rigs(self) -> list[dict]:
        return [rig_cameras(self.config.rig, pose) for pose in poses(self.survey, np.zeros(3), self.config.rig)]

    def eyes_m(self, eye: str) -> ndarray:
        return np.array([camera_centre(rig[eye].cam_from_world) for rig in self.rigs])


def place(folder: Path, content: str) -> Placed:
    config = scene_config(write_scene(folder, content))
    return Placed(config, make_assembly(config.scene.assembly))


@pytest.fixture(scope="module", params=[column, wall, two_walls], ids=["column", "wall", "two walls"])
def placed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Placed:
    bars: Callable[[], Sequence[str]] = request.param
    return place(tmp_path_factory.mktemp("survey"), scene(bars(), KEYS))


def test_cameras_have_stated_distances_from_steel_that_they_aim_at(placed: Placed) -> None:
    assert view_count(placed.survey) == len(placed.survey.stations) == 3 * VIEWS
    assert placed.survey.distances_m == DISTANCES_M
    np.testing.assert_allclose(
        np.linalg.norm(placed.left_m - placed.aimed_m, axis=1), placed.distances_m, atol=2e-6
    )
    assert np.abs(surface_distance_m(placed.aimed_m, placed.assembly.bars)).max() < 2e-4  # Bars are prisms.
    assert (np.round(placed.left_m, 6) == placed.left_m).all()
    np.testing.assert_allclose(placed.eyes_m("left"), placed.left_m, atol=1e-9)
    offsets_m = camera_offsets_m(placed.survey, np.array([1.0, 2.0, 3.0]), placed.assembly.bars)
    np.testing.assert_allclose(offsets_m + np.array([1.0, 2.0, 3.0]), placed.left_m, atol=1e-12)
    for rig, aimed_m in zip(placed.rigs, placed.aimed_m, strict=True):
        x, y, z = (rig["left"].cam_from_world @ [*aimed_m, 1])[:3]
        assert (x, y) == (pytest.approx(RigSpec.baseline_m / 2, abs=1e-9), pytest.approx(0, abs=1e-9))
        assert z > 0


@pytest.mark.parametrize("eye", ["left", "right"])
def test_eyes_are_above_ground_and_clear_of_all_steel(placed: Placed, eye: str) -> None:
    eyes_m = placed.eyes_m(eye)
    least_m = np.array([SURVEY_RULES.clearance_m(distance_m) for distance_m in placed.distances_m])
    assert least_m.tolist() == [0.25] * VIEWS + [0.3] * 2 * VIEWS
    assert (surface_distance_m(eyes_m, placed.assembly.bars) >= least_m).all()
    assert eyes_m[:, 2].min() >= GROUND_CLEARANCE_M
    assert np.hypot(*eyes_m[:, :2].T).max() <= 20.5


@pytest.mark.parametrize("eye", ["left", "right"])
def test_lines_of_sight_are_free(placed: Placed, eye: str) -> None:
    for eye_m, aimed_m in zip(placed.eyes_m(eye), placed.aimed_m, strict=True):
        length_m = float(np.linalg.norm(aimed_m - eye_m))
        along_m = np.append(np.arange(0, length_m - SIGHT_TOLERANCE_M, 0.002), length_m - SIGHT_TOLERANCE_M)
        line_m = eye_m + along_m[:, None] * (aimed_m - eye_m) / length_m
        assert surface_distance_m(line_m, placed.assembly.bars).min() > 0


@pytest.mark.parametrize("eye", ["left", "right"])
def test_near_steel_covers_little_of_each_image(placed: Placed, eye: str) -> None:
    """March the rays of another image to half the distance; the shares differ by up to 2 % of the image."""
    rig = replace(placed.config.rig, width=40, height=24)
    for pose, distance_m in zip(poses(placed.survey, np.zeros(3), rig), placed.distances_m, strict=True):
        camera = rig_cameras(rig, pose)[eye]
        world_from_eye = inverse_rigid(camera.cam_from_world)
        rays = camera.rays().reshape(-1, 3) @ world_from_eye[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        range_m, is_near = np.zeros(len(rays)), np.zeros(len(rays), bool)
        for _ in range(40):  # Each step is the distance from steel, so that no bar is passed.
            step_m = surface_distance_m(world_from_eye[:3, 3] + range_m[:, None] * rays, placed.assembly.bars)
            is_near |= (step_m < 5e-4) & (range_m < NEAR * distance_m)
            range_m += np.maximum(step_m, 0)
            if (is_near | (range_m >= NEAR * distance_m)).all():
                break
        assert is_near.mean() <= 0.04


def test_points_are_spread_evenly(placed: Placed) -> None:
    """Compare with as many random points of the surface: least distances, and distances of the steel from them."""
    sampler = SurfaceSampler(merge_meshes([part.mesh for part in placed.assembly.parts]))
    rng = np.random.default_rng(1)
    steel_m = sampler.sample(4000, rng).points_m

    def spread_m(points_m: ndarray) -> tuple[float, float]:
        nearest_m = cKDTree(points_m).query(points_m, k=2)[0][:, 1]
        return float(nearest_m.mean()), float(np.quantile(cKDTree(points_m).query(steel_m)[0], 0.95))

    random = np.array([spread_m(sampler.sample(VIEWS, rng).points_m) for _ in range(50)])
    for points_m in np.split(placed.aimed_m, 3):
        apart_m, left_out_m = spread_m(points_m)
        assert apart_m > random[:, 0].max()
        assert left_out_m < np.median(random[:, 1])


def test_consecutive_cameras_are_close_to_each_other(placed: Placed) -> None:
    rng = np.random.default_rng(2)
    for centres_m in np.split(placed.left_m, 3):
        random_m = [np.linalg.norm(np.diff(rng.permutation(centres_m), axis=0), axis=1).sum() for _ in range(50)]
        assert np.linalg.norm(np.diff(centres_m, axis=0), axis=1).sum() < 0.75 * min(random_m)


def test_stations_depend_on_scene_and_seed_only(placed: Placed) -> None:
    survey = replace(placed.survey, stations=())
    assert with_stations(survey, placed.assembly, SITE, RigSpec(), "a") == placed.survey
    other = with_stations(replace(survey, seed=1), placed.assembly, SITE, RigSpec(), "a")
    assert not set(other.stations) & set(placed.survey.stations)


def test_cameras_within_reach_fit_and_screen_among_them_does_not(placed: Placed) -> None:
    reach_m = np.linalg.norm(placed.assembly.vertices_m - aim_point_m(placed.assembly), axis=1).max()
    assert reach_m > np.linalg.norm(placed.left_m - aim_point_m(placed.assembly), axis=1).min()
    check_fits(placed.assembly, placed.config)
    [shadows] = BuildRequest(configs=(), scenes=(placed.config,), variants=("shadows",)).config_specs()
    check_fits(placed.assembly, shadows)
    survey = replace(placed.survey, stations=(((30.0, 0.0, 1.0), (29.0, 0.0, 1.0)),))
    with pytest.raises(InputError, match="the screen of the variant 'shadows' would be among the cameras"):
        check_fits(placed.assembly, replace(shadows, protocol=survey))


def test_cage_of_12_m_gets_a_survey_outdoors_by_default(tmp_path: Path) -> None:
    placed = place(tmp_path, scene(girder(12_000)))
    assert replace(placed.survey, stations=()) == SurveySpec()
    assert view_count(placed.survey) == 504
    assert (placed.config.scene.environment, placed.config.scene.board) == ("outdoors", None)
    thirds = np.histogram(placed.aimed_m[:, 0], bins=[-6.1, -2, 2, 6.1])[0]
    assert thirds.min() > 504 / 4
    assert surface_distance_m(placed.left_m, placed.assembly.bars).min() >= 0.25


def test_survey_of_small_cage_is_in_the_laboratory_above_the_objects_on_its_bench(tmp_path: Path) -> None:
    bars = girder(700)
    placed = place(tmp_path, scene(bars, "distances = [300, 800]\nviews_per_distance = 30"))
    assert placed.config.scene.environment == "laboratory"
    for eye in ("left", "right"):
        eyes_m = placed.eyes_m(eye)
        plan_m = np.hypot(*eyes_m[:, :2].T)
        assert plan_m.max() <= 1.6
        assert eyes_m[plan_m > 0.6, 2].min() >= 0.2 + GROUND_CLEARANCE_M
    far = scene(bars, "distances = [300, 1600]\nviews_per_distance = 2")
    assert place(tmp_path, far).config.scene.environment == "outdoors"
    with pytest.raises(
        InputError, match=r"cameras are .* from the world's origin, expected at most 1\.6 m in .* laboratory"
    ):
        place(tmp_path, f'environment = "laboratory"\n{far}')


def test_too_few_places_are_told_with_distance_and_numbers(tmp_path: Path) -> None:
    content = scene(girder(12_000), "distances = [1000, 200000, 300000]\nviews_per_distance = 7")
    path = write_scene(tmp_path, content)
    with pytest.raises(InputError) as raised:
        scene_config(path)
    assert [(problem.code, problem.where) for problem in raised.value.problems] == [("conflict", "cameras")] * 2
    for problem, distance in zip(raised.value.problems, ("200 m", "300 m"), strict=True):
        assert problem.found == f"0 survey views can be placed {distance} from the steel"
        assert problem.expected.startswith("7: ")
    assert str(raised.value).startswith(f"{path}: 2 problems")


def test_steel_behind_other_steel_is_not_aimed_at(tmp_path: Path) -> None:
    """Put a bar inside a closed drum of bars that touch: only the drum can be seen."""
    feet_mm = [(300 * cos(radians(turn)), 300 * sin(radians(turn))) for turn in range(0, 360, 3)]
    drum = [bar_table(32, [(x, y, 10), (x, y, 2000)]) for x, y in feet_mm]
    inner = bar_table(20, [(0, 0, 10), (0, 0, 2000)])
    assembly = load_cage(cage_file_spec(write_scene(tmp_path, scene([*drum, inner]))))
    placed = with_stations(SurveySpec((1.0,), 40), assembly, SITE, RigSpec(), "a")
    aimed_m = np.array([aimed_m for _, aimed_m in placed.stations])
    centres_m = np.array([centre_m for centre_m, _ in placed.stations])
    assert np.hypot(*aimed_m[:, :2].T).min() > 0.28
    assert np.hypot(*centres_m[:, :2].T).min() > 0.5


def test_space_leaves_out_objects_floor_and_roof() -> None:
    space = CameraSpace(2.0, clear_radius_m=1.0, objects_m=0.3)
    points_m = np.array(
        [[0, 0, 0.1], [0, 0, 0.09], [0, 1.0, 0.1], [0, 1.01, 0.1], [0, -1.01, 0.4], [2, 0, 0.4], [1.5, 1.5, 5]]
    )
    assert space.contains(points_m).tolist() == [True, False, True, False, True, True, False]
    below_roof = replace(space, ceiling_m=5.0)
    assert below_roof.contains(np.array([[0, 0, 5.0], [0, 0, 5.01]])).tolist() == [True, False]


SPACE = CameraSpace(20.0, clear_radius_m=20.0)
RANDOM_VIEWS = 6
SPEC = RandomViewsSpec(RANDOM_VIEWS, seed=4)
RIG = STEREO_CAMERAS["Luxonis OAK-D"]


@pytest.fixture(scope="module")
def cages() -> Mapping[str, Assembly]:
    return {family: make_assembly(GeneratedCageSpec("train", 0, 3, family)) for family in FAMILIES}


@pytest.fixture(scope="module")
def views(cages: Mapping[str, Assembly]) -> Mapping[str, RandomViewsSpec]:
    return {name: randomly_placed(SPEC, cage) for name, cage in cages.items()}


def randomly_placed(
    spec: RandomViewsSpec, cage: Assembly, space: CameraSpace = SPACE, rig: RigSpec = RIG
) -> RandomViewsSpec:
    return with_random_stations(spec, cage, space, rig, "cage")


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
    assert view_count(views[family]) == RANDOM_VIEWS
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
    fewer = randomly_placed(replace(SPEC, views=2), cages[family])
    assert fewer.stations == views[family].stations[:2]
    other = randomly_placed(RandomViewsSpec(2, seed=5), cages[family])
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


def scored_counts(assembly: Assembly, views: SurveySpec | RandomViewsSpec, rig: RigSpec) -> list[int]:
    """Cast all rays of the left images of views, as a build does, and count their scored pixels."""
    caster = RayCaster(
        world_mesh([part.mesh for part in assembly.parts], [part.bar_id for part in assembly.parts])
    )
    eyes = [caster.cast(rig_cameras(rig, pose)["left"]) for pose in poses(views, np.zeros(3), rig)]
    return [len(scored_pixels(eye.mask, eye.depth_m)) for eye in eyes]


def test_random_views_have_scored_pixels_in_small_images(cages: Mapping[str, Assembly]) -> None:
    rig = replace(RIG, width=96, height=54)
    large, small = [], []
    for cage in cages.values():
        drawn = [randomly_placed(replace(SPEC, views=12), cage, rig=size) for size in (RIG, rig)]
        large += scored_counts(cage, drawn[0], rig)
        small += scored_counts(cage, drawn[1], rig)
    assert min(small) > 0
    assert large.count(0) > 5  # Such views are drawn again.
    with pytest.raises(InputError, match=r"none of .* random views .* has a scored pixel"):
        randomly_placed(SPEC, next(iter(cages.values())), rig=replace(RIG, width=3, height=3))


@pytest.mark.parametrize("diameter_mm", [5, 1])
def test_survey_of_thin_bars_prefers_views_with_scored_pixels(tmp_path: Path, diameter_mm: float) -> None:
    bars = [bar_table(diameter_mm, [(-1000, y, 50), (1000, y, 50)]) for y in (-300, 0, 300)]
    keys = "distances = [500, 1500]\nviews_per_distance = 10"
    placed = place(tmp_path, scene(bars, keys))
    assert view_count(placed.survey) == 20
    scored = scored_counts(placed.assembly, placed.survey, placed.config.rig)
    assert (min(scored) > 0) == (diameter_mm == 5)


def test_cage_without_space_for_cameras_is_refused(cages: Mapping[str, Assembly]) -> None:
    cage = next(iter(cages.values()))
    with pytest.raises(InputError, match="view 0"):
        randomly_placed(SPEC, cage, CameraSpace(0.01, clear_radius_m=0.01))
