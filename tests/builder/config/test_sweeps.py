"""Sweeps of distance: built by name alone, the same directions at every distance, steel to score in every view."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from dataset_builder.cli import argument_parser
from dataset_builder.config.catalog import CONFIGS, SWEEPS, BuildRequest
from dataset_builder.config.scene_file import LABORATORY_CAMERAS_M, OUTDOORS_CAMERAS_M
from dataset_builder.config.specs import ConfigSpec, SweepSpec
from dataset_builder.config.trajectories import offsets_m, poses, subset
from dataset_builder.scene.assemblies import aim_point_m, check_fits, make_assembly
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import ideal_K, pixel_rays
from rebar_depth_bench.scoring.protocol import scored_pixels

RANGES_M = {"lattice-distance": (0.22, 1.6), "pile-distance": (0.5, 2.2), "pier-distance": (5.0, 17.0)}


@pytest.fixture(params=list(RANGES_M))
def config(request: pytest.FixtureRequest) -> ConfigSpec:
    [spec] = BuildRequest(configs=(request.param,)).config_specs()
    return spec


def test_sweeps_are_built_where_they_are_named_and_not_by_default() -> None:
    assert set(SWEEPS) == set(RANGES_M)
    assert not set(SWEEPS) & set(CONFIGS)
    assert [spec.name for spec in BuildRequest().config_specs()] == list(CONFIGS)
    options = argument_parser().parse_args(["--out", "root", "--config", *RANGES_M])
    assert [spec.name for spec in BuildRequest(configs=tuple(options.config)).config_specs()] == list(RANGES_M)
    [dusk] = BuildRequest(configs=("pile-distance",), variants=("dusk",)).config_specs()
    assert dusk.name == "pile-distance-dusk"


def test_a_sweep_has_the_scene_of_its_dome(config: ConfigSpec) -> None:
    dome = CONFIGS[config.name.removesuffix("-distance")]()
    assert (config.scene, config.rig, config.colour) == (dome.scene, dome.rig, dome.colour)


def test_twelve_distances_in_equal_ratios_and_eight_directions_at_each(config: ConfigSpec) -> None:
    offsets = np.array(offsets_m(config.protocol)).reshape(12, 8, 3)
    radii_m = np.linalg.norm(offsets, axis=2)
    assert np.ptp(radii_m, axis=1).max() < 1e-9
    assert (radii_m[0, 0], radii_m[-1, 0]) == pytest.approx(RANGES_M[config.name])
    ratios = radii_m[1:, 0] / radii_m[:-1, 0]
    assert np.ptp(ratios) < 0.01
    directions = offsets / radii_m[..., None]
    assert np.abs(directions - directions[0]).max() < 1e-12, "distance alone changes"
    assert len({tuple(direction) for direction in directions[0].round(6).tolist()}) == 8
    assert np.abs(directions[0][:, :2]).min() > 0.1, "no camera looks along the lattice's rods"


def test_a_subset_of_twelve_takes_every_distance_once() -> None:
    assert [index // 8 for index in subset(96, 12)] == list(range(12))


def test_cameras_stand_where_the_scene_has_room(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    check_fits(assembly, config)
    room_m = {"laboratory": LABORATORY_CAMERAS_M, "outdoors": OUTDOORS_CAMERAS_M}[config.scene.environment]
    centres_m = aim_point_m(assembly) + np.array(offsets_m(config.protocol))
    assert np.linalg.norm(centres_m[:, :2], axis=1).max() <= room_m
    assert centres_m[:, 2].min() > 0.1


def test_even_the_farthest_views_have_a_thousand_pixels_to_score(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    meshes = [part.mesh for part in assembly.parts]
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)])
    ids = np.ones(len(faces), np.uint16)
    caster = RayCaster(
        WorldMesh(np.concatenate([mesh.vertices_m for mesh in meshes]), faces.astype(np.int32), ids)
    )
    rays = pixel_rays(ideal_K(1280, 720), 1280, 720)
    views = poses(config.protocol, aim_point_m(assembly), config.rig)
    scored = [scored_pixels(truth.mask, truth.depth_m) for truth in (caster.cast(rays, views[i]) for i in (0, 95))]
    assert len(scored[0]) > len(scored[1]) > 1000


def test_a_sweep_is_told_in_the_manifest() -> None:
    spec = SweepSpec((0.2, 0.4), 40.0, 8)
    assert asdict(spec) == {"radii_m": (0.2, 0.4), "elevation_deg": 40.0, "azimuths": 8, "kind": "sweep"}
