"""Appearance variants in all environments: names, and the effect of each on pictures and ground truth.

``probe`` renders in a Blender process; the tests check its arrays.
"""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.variants.props import PROP_BUILDERS
from dataset_builder.scene.variants.registry import (
    IMAGE_LIGHTS,
    IRRADIANCE,
    LIGHT_SLOT,
    PROPS_SLOT,
    SENSOR_SLOT,
    SHADOWS,
    STEEL_SLOT,
    VARIANTS,
    ImageLight,
    check_variants,
    image_light,
)
from dataset_builder.scene.variants.sensor import recorded
from dataset_builder.specs.config_specs import AppearanceSpec, ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.base.errors import BuildError, InputError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at
from tests.builder.scene.cages import square_cage

AZIMUTHS_DEG = (30, 120, 210, 300)
TARGET_M = np.array([0.0, 0.0, 0.05])


def camera_at(pose: Float64[ndarray, "4 4"]) -> Camera:
    return Camera(ideal_K(96, 54), np.zeros(5), pose, 96, 54)


def around_lattice(azimuth_deg: float) -> Camera:
    azimuth = np.deg2rad(azimuth_deg)
    eye_m = np.array([0.26 * np.cos(azimuth), 0.26 * np.sin(azimuth), 0.13])
    return camera_at(look_at_with_rig(eye_m, TARGET_M, 0.12))


LIFE_SIZE_CAMERA = camera_at(look_at(np.array([3.1, -2.4, 1.5]), np.array([0.0, 0.0, 0.7])))
CAMERAS = {
    "laboratory": [around_lattice(azimuth_deg) for azimuth_deg in AZIMUTHS_DEG],
    "outdoors": [camera_at(look_at(np.array([8.4, -6.0, 1.2]), np.array([0.0, 0.0, 3.3])))],
    "hall": [LIFE_SIZE_CAMERA],
    "deck": [LIFE_SIZE_CAMERA],
}
LIGHTS = [None, *(name for name, variant in VARIANTS.items() if variant.slot == LIGHT_SLOT)]
FEW_LIGHTS = [None, "dusk", "spotlight", "backlight", "night"]
RENDERED: dict[str, list[str | None]] = {
    "laboratory": [None, *VARIANTS],
    "outdoors": LIGHTS,
    "hall": FEW_LIGHTS,
    "deck": FEW_LIGHTS,
}
"""Variants that are rendered in each environment."""
WITH_CYCLES_DEPTH = [
    *(f"laboratory/{name}" for name in PROP_BUILDERS),
    "outdoors/None",
    "outdoors/shadows",
    "hall/None",
    "deck/None",
]
COLOUR_ONLY = [name for name in VARIANTS if name not in PROP_BUILDERS]
TURN_DEG = 35.0


def probe(folder: Path) -> dict[str, ndarray]:
    """Render the variants at low resolution and cast their ground truth (runs in the Blender process)."""
    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.render import render_depth
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    assemblies = {
        "laboratory": lattice_assembly(LatticeSpec(pitch_m=0.05)),
        "outdoors": square_cage(4.8, 6.67, 0.1),
        "hall": square_cage(0.6, 1.8, 0.02),
        "deck": square_cage(0.6, 1.8, 0.02),
    }
    arrays: dict[str, ndarray] = {}
    for place, variant in ((place, variant) for place, variants in RENDERED.items() for variant in variants):
        key, board = f"{place}/{variant}", BoardSpec() if place == "laboratory" else None
        appearance = AppearanceSpec((variant,) if variant else ())
        spec = SceneSpec("s", LatticeSpec(), board, place, appearance)
        build_scene(assemblies[place], spec)
        configure_colour(threads=1)
        mesh = evaluated_world_mesh()
        digest = sha256(b"".join(array.tobytes() for array in vars(mesh).values())).digest()
        arrays[f"{key}/mesh"] = np.frombuffer(digest, dtype=np.uint8)
        truths = [RayCaster(mesh).cast(camera) for camera in CAMERAS[place]]
        arrays[f"{key}/bars"] = np.array([truth.bars for truth in truths])
        arrays[f"{key}/depth"] = np.array([truth.depth_m for truth in truths])
        rgb = render_colour(CAMERAS[place][0], truths[0].mask, ColourSpec(2, 2), seed=1, scratch_dir=folder)
        arrays[f"{key}/colour"] = recorded(rgb, spec, seed=1)
        if key in WITH_CYCLES_DEPTH:
            arrays[f"{key}/cycles"] = render_depth(CAMERAS[place][0], scratch_dir=folder)
    return arrays | _panorama(folder)


def _panorama(folder: Path) -> dict[str, ndarray]:
    """Render the sun of a turned panorama, and the opposite direction."""
    import bpy

    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.scene import add_panorama

    bpy.ops.wm.read_factory_settings(use_empty=True)
    light = replace(light_of("sunrise"), strength=0.02, turn_deg=TURN_DEG)
    add_panorama(light)
    configure_colour(threads=1)
    towards = sun_direction(panorama_pixels("sunrise"), TURN_DEG)
    K = np.array([[20.0, 0, 7.5], [0, 20.0, 7.5], [0, 0, 1]])
    no_steel = np.zeros((16, 16), dtype=bool)
    arrays = {}
    for name, direction in (("sun", towards), ("opposite", towards * [-1, -1, 1])):
        camera = Camera(K, np.zeros(5), look_at(np.zeros(3), direction), 16, 16)
        arrays[name] = render_colour(camera, no_steel, ColourSpec(4, 4), 1, folder)
    try:
        add_panorama(replace(light, sha256="0" * 64))
    except BuildError as error:
        arrays["refusal"] = np.array(str(error))
    return arrays


def scene_with(*variants: str, seed: int = 0) -> SceneSpec:
    return SceneSpec("s", LatticeSpec(), None, appearance=AppearanceSpec(variants), seed=seed)


def light_of(name: str) -> ImageLight:
    light = image_light(scene_with(name))
    assert light is not None
    return light


def panorama_pixels(name: str) -> Float64[ndarray, "h w 3"]:
    bpy = find_spec("bpy")
    assert bpy is not None
    assert bpy.origin is not None
    [path] = Path(bpy.origin).parent.glob(f"*/datafiles/studiolights/world/{name}.exr")
    with OpenEXR.File(str(path)) as file:
        return np.array(file.channels()["RGB"].pixels, dtype=np.float64)[..., :3]


def sun_direction(rgb: Float64[ndarray, "h w 3"], turn_deg: float) -> Float64[ndarray, " 3"]:
    """Return the direction of the brightest pixel of a turned panorama.

    The middle column is +x, and azimuths decrease to the right.
    """
    rows, columns = rgb.shape[:2]
    row, column = np.unravel_index(rgb.sum(axis=2).argmax(), (rows, columns))
    azimuth = (0.5 - (column + 0.5) / columns) * 2 * np.pi + np.deg2rad(turn_deg)
    elevation = (0.5 - (row + 0.5) / rows) * np.pi
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def test_variants_have_description_and_slot() -> None:
    assert {variant.slot for variant in VARIANTS.values()} == {LIGHT_SLOT, STEEL_SLOT, PROPS_SLOT, SENSOR_SLOT}
    assert all(name == variant.name and variant.description for name, variant in VARIANTS.items())
    props = {name for name, variant in VARIANTS.items() if variant.slot == PROPS_SLOT}
    assert props == set(PROP_BUILDERS) - {SHADOWS}
    panoramas = ["city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset"]
    assert sorted(IMAGE_LIGHTS) == panoramas
    assert {VARIANTS[name].slot for name in panoramas} == {LIGHT_SLOT}


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
def test_invalid_variant_names_are_refused(names: tuple[str, ...], problems: list[tuple[str, ...]]) -> None:
    with pytest.raises(InputError) as raised:
        check_variants(names)
    assert [(problem.code, problem.where, problem.found) for problem in raised.value.problems] == problems
    with pytest.raises(InputError, match="appearance variants"):
        BuildRequest(configs=("lattice",), variants=names).config_specs()


def mean_change(rendered: dict[str, ndarray], one: str, other: str) -> float:
    return float(np.abs(rendered[f"{one}/colour"].astype(float) - rendered[f"{other}/colour"]).mean())


@pytest.mark.parametrize("name", VARIANTS)
def test_each_variant_changes_the_picture(rendered: dict[str, ndarray], name: str) -> None:
    changed = mean_change(rendered, f"laboratory/{name}", "laboratory/None")
    assert changed > (0.1 if name == "tie-wire" else 0.3)


@pytest.mark.parametrize("name", COLOUR_ONLY)
def test_variants_of_light_steel_and_sensor_keep_the_ground_truth(rendered: dict[str, ndarray], name: str) -> None:
    for place in ("laboratory", "outdoors") if name in LIGHTS else ("laboratory",):
        for kind in ("mesh", "bars", "depth"):
            np.testing.assert_array_equal(rendered[f"{place}/{name}/{kind}"], rendered[f"{place}/None/{kind}"])


def test_shadow_screen_keeps_bar_ids(rendered: dict[str, ndarray]) -> None:
    np.testing.assert_array_equal(rendered["laboratory/shadows/bars"], rendered["laboratory/None/bars"])


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.slot == PROPS_SLOT])
def test_props_occlude_steel_and_add_none(rendered: dict[str, ndarray], name: str) -> None:
    bars, bars_before = (rendered[f"laboratory/{variant}/bars"] for variant in (name, None))
    assert (bars[bars > 0] == bars_before[bars > 0]).all()
    change_m = rendered[f"laboratory/{name}/depth"] - rendered["laboratory/None/depth"]
    assert change_m.max() <= 1e-6, "nothing moves away"


def test_formwork_hides_steel_from_one_side_only(rendered: dict[str, ndarray]) -> None:
    seen, seen_before = ((rendered[f"laboratory/{name}/bars"] > 0).sum(axis=(1, 2)) for name in ("formwork", None))
    assert (seen / seen_before).min() < 0.85
    assert (seen / seen_before).max() > 0.9


@pytest.mark.parametrize("key", WITH_CYCLES_DEPTH)
def test_depth_of_cycles_is_the_ground_truth(rendered: dict[str, ndarray], key: str) -> None:
    cycles_m, truth_m = rendered[f"{key}/cycles"], rendered[f"{key}/depth"][0]
    assert np.isfinite(truth_m).all()
    error_m = np.abs(cycles_m.astype(float) - truth_m)
    assert (error_m > 1e-4 * np.maximum(truth_m, 1.0)).mean() < 3e-3


def test_sky_has_no_depth_and_the_hall_has_no_sky(rendered: dict[str, ndarray]) -> None:
    depth_m = {place: rendered[f"{place}/None/depth"][0] for place in RENDERED}
    assert 0.2 < (depth_m["outdoors"] == 0.0).mean() < 0.8
    assert (depth_m["outdoors"][:3] == 0.0).mean() > 0.5
    assert 60 < depth_m["outdoors"].max() < 140
    assert (depth_m["deck"] > 0).mean() > 0.7
    assert (depth_m["hall"] > 0).all()


@pytest.mark.parametrize(
    ("place", "mean", "steel"),
    [("outdoors", (110, 175), (20, 160)), ("hall", (80, 175), (50, 160)), ("deck", (80, 175), (50, 160))],
)
def test_exposure_suits_the_standard_light(
    rendered: dict[str, ndarray], place: str, mean: tuple[float, float], steel: tuple[float, float]
) -> None:
    rgb = rendered[f"{place}/None/colour"]
    assert mean[0] < rgb.mean() < mean[1]
    assert steel[0] < rgb[rendered[f"{place}/None/bars"][0] > 0].mean() < steel[1]
    assert (rgb.min(axis=2) >= 250).mean() < (0.001 if place == "outdoors" else 0.02)


@pytest.mark.parametrize(
    ("place", "dusk", "spotlight"),
    [("laboratory", 0.5, 0.6), ("outdoors", 0.5, 0.6), ("hall", 0.6, 0.75), ("deck", 0.6, 0.75)],
)
def test_lights_differ_and_dark_ones_are_dark(
    rendered: dict[str, ndarray], place: str, dusk: float, spotlight: float
) -> None:
    lights = [light for light in RENDERED[place] if light in LIGHTS]
    brightness = {light: rendered[f"{place}/{light}/colour"].mean() for light in lights}
    assert brightness["dusk"] < dusk * brightness[None]
    assert brightness["spotlight"] < spotlight * brightness[None]
    assert min(brightness.values()) > 8
    for one, other in combinations(lights, 2):
        assert mean_change(rendered, f"{place}/{one}", f"{place}/{other}") > 3, (one, other)
    if place in ("hall", "deck"):
        assert all((rendered[f"{place}/{light}/colour"].min(axis=2) >= 250).mean() < 0.02 for light in lights)


@pytest.mark.parametrize("place", ["laboratory", "outdoors"])
@pytest.mark.parametrize("name", IMAGE_LIGHTS)
def test_panoramas_expose_like_standard_light(rendered: dict[str, ndarray], place: str, name: str) -> None:
    surface = rendered[f"{place}/None/depth"][0] > 0
    rgb, standard = (rendered[f"{place}/{light}/colour"][surface] for light in (name, None))
    assert abs(rgb.mean() - standard.mean()) < 40
    assert (rgb.min(axis=1) >= 250).mean() < 0.02
    assert (rgb.max(axis=1) <= 8).mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGE_LIGHTS)
def test_strength_gives_stated_irradiance_of_horizontal_surface(blender: None, name: str) -> None:
    luminance = panorama_pixels(name) @ [0.2126, 0.7152, 0.0722]
    rows, columns = luminance.shape
    polar_rad = (np.arange(rows) + 0.5) / rows * np.pi
    pixel_sr = np.sin(polar_rad) * (np.pi / rows) * (2 * np.pi / columns)
    irradiance = (luminance.sum(axis=1) * pixel_sr * np.clip(np.cos(polar_rad), 0, None)).sum()
    assert light_of(name).strength * irradiance == pytest.approx(IRRADIANCE, rel=2e-3)


def test_seed_determines_turn_of_the_panorama() -> None:
    lights = [image_light(scene_with("city", seed=seed)) for seed in (0, 0, 1)]
    assert lights[0] == lights[1] != lights[2]
    assert image_light(scene_with()) is None
    assert image_light(scene_with("dusk", "sensor")) is None


def test_sun_is_where_the_turn_puts_it(rendered: dict[str, ndarray]) -> None:
    sun, opposite = (rendered[name].astype(int).sum(axis=2) for name in ("sun", "opposite"))
    brightest = np.unravel_index(sun.argmax(), sun.shape)
    assert np.abs(np.array(brightest) - 7.5).max() <= 1.5
    assert opposite.max() < 0.2 * sun.max()


def test_other_file_of_the_wheel_is_refused(rendered: dict[str, ndarray]) -> None:
    message = str(rendered["refusal"])
    assert "sunrise.exr: the panorama has sha256 6a1180" in message
    assert f"expected {'0' * 64}" in message
