"""Distance sweeps: opt-in configs with the same directions at every distance and scored pixels in every view."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.cameras.trajectories import aim_point_m, camera_offsets_m, poses, subset
from dataset_builder.catalog.named_configs import CONFIGS, SWEEPS, BuildRequest
from dataset_builder.cli.main import argument_parser
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.specs.config_specs import ConfigSpec, DistanceSweepSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.geometry.cameras import Camera, ideal_K
from rebar_depth_bench.scoring.protocol import scored_pixels

DISTANCE_RANGES_M = {"lattice-distance": (0.22, 1.6), "pile-distance": (0.5, 2.2), "pier-distance": (5.0, 17.0)}


@pytest.fixture(params=list(DISTANCE_RANGES_M))
def config(request: pytest.FixtureRequest) -> ConfigSpec:
    [spec] = BuildRequest(configs=(request.param,)).config_specs()
    return spec


def test_sweeps_are_built_only_when_named() -> None:
    assert set(SWEEPS) == set(DISTANCE_RANGES_M)
    assert not set(SWEEPS) & set(CONFIGS)
    assert [spec.name for spec in BuildRequest().config_specs()] == list(CONFIGS)
    options = argument_parser().parse_args(["build", "--out", "root", "--config", *DISTANCE_RANGES_M])
    assert [spec.name for spec in BuildRequest(configs=tuple(options.config)).config_specs()] == list(
        DISTANCE_RANGES_M
    )
    [dusk] = BuildRequest(configs=("pile-distance",), variants=("dusk",)).config_specs()
    assert dusk.name == "pile-distance-dusk"


def test_sweep_has_scene_of_dome_config(config: ConfigSpec) -> None:
    dome = CONFIGS[config.name.removesuffix("-distance")]()
    assert (config.scene, config.rig, config.colour) == (dome.scene, dome.rig, dome.colour)


def test_sweep_has_12_distances_and_8_directions(config: ConfigSpec) -> None:
    offsets = np.array(camera_offsets_m(config.protocol, np.zeros(3), ())).reshape(12, 8, 3)
    radii_m = np.linalg.norm(offsets, axis=2)
    assert np.ptp(radii_m, axis=1).max() < 1e-9
    assert (radii_m[0, 0], radii_m[-1, 0]) == pytest.approx(DISTANCE_RANGES_M[config.name])
    ratios = radii_m[1:, 0] / radii_m[:-1, 0]
    assert np.ptp(ratios) < 0.01
    directions = offsets / radii_m[..., None]
    assert np.abs(directions - directions[0]).max() < 1e-12, "distance alone changes"
    assert len({tuple(direction) for direction in directions[0].round(6).tolist()}) == 8
    assert np.abs(directions[0][:, :2]).min() > 0.1, "no camera looks along the lattice's rods"


def test_subset_of_12_has_every_distance_once() -> None:
    assert [index // 8 for index in subset(96, 12)] == list(range(12))


def test_cameras_are_inside_environment(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    check_fits(assembly, config)
    max_radius_m = SURROUNDINGS[config.scene.environment].cameras.radius_m
    aim_m = aim_point_m(assembly)
    centres_m = aim_m + np.array(camera_offsets_m(config.protocol, aim_m, assembly.bars))
    assert np.linalg.norm(centres_m[:, :2], axis=1).max() <= max_radius_m
    assert centres_m[:, 2].min() > 0.1


@pytest.mark.slow
def test_farthest_views_have_1000_scored_pixels(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    meshes = [part.mesh for part in assembly.parts]
    vertex_offsets = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, vertex_offsets, strict=False)])
    ids = np.ones(len(faces), np.uint16)
    caster = RayCaster(
        WorldMesh(np.concatenate([mesh.vertices_m for mesh in meshes]), faces.astype(np.int32), ids)
    )
    views = poses(config.protocol, aim_point_m(assembly), config.rig)
    cameras = [Camera(ideal_K(1280, 720), np.zeros(5), views[i], 1280, 720) for i in (0, 95)]
    scored = [scored_pixels(truth.mask, truth.depth_m) for truth in map(caster.cast, cameras)]
    assert len(scored[0]) > len(scored[1]) > 1000


def test_sweep_spec_serialises_for_manifest() -> None:
    spec = DistanceSweepSpec((0.2, 0.4), 40.0, 8)
    assert asdict(spec) == {"radii_m": (0.2, 0.4), "elevation_deg": 40.0, "azimuths": 8, "kind": "sweep"}
