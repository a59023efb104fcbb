"""Appearance variants: validation of their names and effect of each on images and ground truth.

Blender runs in a separate process, ``python -m tests.builder.blender.test_appearance FOLDER``.
"""

from __future__ import annotations

import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.variants.props import PROP_BUILDERS
from dataset_builder.scene.variants.registry import (
    IMAGE_LIGHTS,
    LIGHT_SLOT,
    PROPS_SLOT,
    SENSOR_SLOT,
    SHADOWS,
    STEEL_SLOT,
    VARIANTS,
    check_variants,
)
from dataset_builder.scene.variants.sensor import recorded
from dataset_builder.specs.config_specs import AppearanceSpec, ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at
from tests.builder.blender.cages import cage
from tests.builder.blender.probe import RunProbe

LATTICE_CAMERAS = {
    azimuth: Camera(
        ideal_K(96, 54),
        np.zeros(5),
        look_at_with_rig(
            np.array([0.26 * np.cos(np.deg2rad(azimuth)), 0.26 * np.sin(np.deg2rad(azimuth)), 0.13]),
            np.array([0.0, 0.0, 0.05]),
            0.12,
        ),
        96,
        54,
    )
    for azimuth in (30, 120, 210, 300)
}
SITE_CAMERA = Camera(
    ideal_K(96, 54), np.zeros(5), look_at(np.array([8.4, -6.0, 1.2]), np.array([0.0, 0.0, 3.3])), 96, 54
)
CASES_WITH_CYCLES_DEPTH = (*(f"laboratory/{name}" for name in PROP_BUILDERS), "outdoors/None", "outdoors/shadows")
LIGHT_VARIANTS = [None, *(name for name, variant in VARIANTS.items() if variant.slot == LIGHT_SLOT)]
WITHOUT_SURFACES = [name for name in VARIANTS if name not in PROP_BUILDERS]
"""Variants that change colour only."""


def probe(folder: Path) -> None:
    """Render every variant at low resolution and cast its ground truth (runs in the Blender process)."""
    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.render import render_depth
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    arrays: dict[str, ndarray] = {}
    lattice = lattice_assembly(LatticeSpec(pitch_m=0.05))

    def render_and_cast(key: str, assembly: Assembly, spec: SceneSpec, cameras: dict[int, Camera]) -> None:
        build_scene(assembly, spec)
        configure_colour(threads=1)
        mesh = evaluated_world_mesh()
        arrays[f"{key}/mesh"] = np.frombuffer(
            sha256(
                b"".join(array.tobytes() for array in (mesh.vertices_m, mesh.faces, mesh.face_bar_id))
            ).digest(),
            dtype=np.uint8,
        )
        caster = RayCaster(mesh)
        truths = {azimuth: caster.cast(camera) for azimuth, camera in cameras.items()}
        for azimuth, ground_truth in truths.items():
            arrays[f"{key}/bars/{azimuth}"] = ground_truth.bars
            arrays[f"{key}/depth/{azimuth}"] = ground_truth.depth_m
        first_camera, mask = next(iter(cameras.values())), next(iter(truths.values())).mask
        rgb = render_colour(first_camera, mask, ColourSpec(2, 2), seed=1, scratch_dir=folder)
        arrays[f"{key}/colour"] = recorded(rgb, spec, seed=1)
        if key in CASES_WITH_CYCLES_DEPTH:
            arrays[f"{key}/cycles"] = render_depth(first_camera, scratch_dir=folder)

    for name in (None, *VARIANTS):
        appearance = AppearanceSpec((name,) if name else ())
        render_and_cast(
            f"laboratory/{name}",
            lattice,
            SceneSpec("s", LatticeSpec(), BoardSpec(), appearance=appearance),
            LATTICE_CAMERAS,
        )
    for name in LIGHT_VARIANTS:
        appearance = AppearanceSpec((name,) if name else ())
        spec = SceneSpec("s", LatticeSpec(), None, environment="outdoors", appearance=appearance)
        render_and_cast(f"outdoors/{name}", cage(4.8, 6.67, 0.1), spec, {0: SITE_CAMERA})
    np.savez(folder / "arrays.npz", **arrays)


def test_variants_have_description_and_slot() -> None:
    assert {variant.slot for variant in VARIANTS.values()} == {LIGHT_SLOT, STEEL_SLOT, PROPS_SLOT, SENSOR_SLOT}
    assert all(name == variant.name and len(variant.description) > 20 for name, variant in VARIANTS.items())
    assert {name for name, variant in VARIANTS.items() if variant.slot == PROPS_SLOT} == set(PROP_BUILDERS) - {
        SHADOWS
    }


@pytest.mark.parametrize(
    ("names", "problems"),
    [
        (("fog",), [("unknown", "'fog'", "no such variant")]),
        (("dusk", "shadows"), [("conflict", "", "dusk, shadows all set the light")]),
        (("city", "sensor", "night", "dusk"), [("conflict", "", "city, night, dusk all set the light")]),
        (("rusted", "clutter", "wet"), [("conflict", "", "rusted, wet all set the steel")]),
        (("clutter", "clutter"), [("duplicate", "'clutter'", "given 2 times")]),
        (("Dusk", ""), [("unknown", "'Dusk'", "no such variant"), ("unknown", "''", "no such variant")]),
    ],
)
def test_invalid_variant_names_are_rejected(names: tuple[str, ...], problems: list[tuple[str, ...]]) -> None:
    with pytest.raises(InputError) as raised:
        check_variants(names)
    assert [(problem.code, problem.where, problem.found) for problem in raised.value.problems] == problems
    with pytest.raises(InputError, match="appearance variants"):
        BuildRequest(configs=("lattice",), variants=names).config_specs()


def test_compatible_variant_names_are_accepted() -> None:
    check_variants(())
    check_variants(("dusk", "rusted", "clutter", "formwork", "spacers", "tie-wire"))
    check_variants(("sunset", "wet", "clutter", "sensor"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_probe: RunProbe) -> Path:
    return run_probe("tests.builder.blender.test_appearance", tmp_path_factory.mktemp("appearance"))


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, ndarray]:
    return dict(np.load(folder / "arrays.npz"))


def mean_change(arrays: dict[str, ndarray], variant: str, reference: str) -> float:
    return float(np.abs(arrays[f"{variant}/colour"].astype(float) - arrays[f"{reference}/colour"]).mean())


@pytest.mark.parametrize("name", VARIANTS)
def test_each_variant_changes_the_image(arrays: dict[str, ndarray], name: str) -> None:
    assert mean_change(arrays, f"laboratory/{name}", "laboratory/None") > (0.1 if name == "tie-wire" else 0.3)


@pytest.mark.parametrize("name", WITHOUT_SURFACES)
def test_light_steel_and_sensor_variants_keep_ground_truth(arrays: dict[str, ndarray], name: str) -> None:
    places = ["laboratory", "outdoors"] if name in LIGHT_VARIANTS else ["laboratory"]
    truth = [key for key in arrays if key.partition("/")[0] in places and "/None/" in key and "colour" not in key]
    for key in truth:
        if not key.endswith("/cycles"):
            np.testing.assert_array_equal(arrays[key.replace("None", name)], arrays[key])
    assert len(truth) >= 9


def test_shadow_screen_keeps_bar_ids(arrays: dict[str, ndarray]) -> None:
    for azimuth in LATTICE_CAMERAS:
        np.testing.assert_array_equal(
            arrays[f"laboratory/{SHADOWS}/bars/{azimuth}"], arrays[f"laboratory/None/bars/{azimuth}"]
        )


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.slot == PROPS_SLOT])
def test_props_occlude_steel_and_add_none(arrays: dict[str, ndarray], name: str) -> None:
    for azimuth in LATTICE_CAMERAS:
        bars, bars_before = (arrays[f"laboratory/{key}/bars/{azimuth}"] for key in (name, "None"))
        assert (bars[bars > 0] == bars_before[bars > 0]).all()
        depth_change_m = arrays[f"laboratory/{name}/depth/{azimuth}"] - arrays[f"laboratory/None/depth/{azimuth}"]
        assert depth_change_m.max() <= 1e-6, "nothing moves away"


def test_formwork_hides_steel_from_one_side_only(arrays: dict[str, ndarray]) -> None:
    shares = [
        (arrays[f"laboratory/formwork/bars/{azimuth}"] > 0).sum()
        / (arrays[f"laboratory/None/bars/{azimuth}"] > 0).sum()
        for azimuth in LATTICE_CAMERAS
    ]
    assert min(shares) < 0.85
    assert max(shares) > 0.9


@pytest.mark.parametrize("key", CASES_WITH_CYCLES_DEPTH)
def test_cycles_depth_equals_ground_truth(arrays: dict[str, ndarray], key: str) -> None:
    azimuth = 30 if key.startswith("laboratory") else 0
    cycles_m, truth_m = arrays[f"{key}/cycles"], arrays[f"{key}/depth/{azimuth}"]
    error_m = np.abs(cycles_m.astype(float) - truth_m)
    assert (error_m > 1e-4 * np.maximum(truth_m, 1.0)).mean() < 3e-3


def test_outdoor_scene_has_sky_without_depth_and_exposure(arrays: dict[str, ndarray]) -> None:
    depth_m, rgb = arrays["outdoors/None/depth/0"], arrays["outdoors/None/colour"]
    assert 0.2 < (depth_m == 0.0).mean() < 0.8
    assert (depth_m[:3] == 0.0).mean() > 0.5
    assert 60 < depth_m.max() < 140
    assert 110 < rgb.mean() < 175
    assert (rgb.min(axis=2) >= 250).mean() < 0.001
    steel = rgb[arrays["outdoors/None/bars/0"] > 0]
    assert 20 < steel.mean() < 160


@pytest.mark.parametrize("place", ["laboratory", "outdoors"])
def test_light_variants_differ_and_dark_ones_are_dark(arrays: dict[str, ndarray], place: str) -> None:
    brightness = {name: arrays[f"{place}/{name}/colour"].mean() for name in LIGHT_VARIANTS}
    assert brightness["dusk"] < 0.5 * brightness[None]
    assert brightness["spotlight"] < 0.6 * brightness[None]
    assert min(brightness.values()) > 8
    for k, name in enumerate(LIGHT_VARIANTS):
        for other_name in LIGHT_VARIANTS[:k]:
            assert mean_change(arrays, f"{place}/{name}", f"{place}/{other_name}") > 3


@pytest.mark.parametrize("place", ["laboratory", "outdoors"])
@pytest.mark.parametrize("name", IMAGE_LIGHTS)
def test_panoramas_expose_like_standard_light(arrays: dict[str, ndarray], place: str, name: str) -> None:
    surface = arrays[f"{place}/None/depth/{30 if place == 'laboratory' else 0}"] > 0
    rgb, standard = (arrays[f"{place}/{key}/colour"][surface] for key in (name, None))
    assert abs(rgb.mean() - standard.mean()) < 40
    assert (rgb.min(axis=1) >= 250).mean() < 0.02
    assert (rgb.max(axis=1) <= 8).mean() < 0.02


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
