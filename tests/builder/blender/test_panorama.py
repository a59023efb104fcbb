"""Panoramas as light: constants against the files of the wheel, direction, manifest parameters and refusals.

Blender runs in a separate process, ``python -m tests.builder.blender.test_panorama FOLDER``.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.plan import config_parameters
from dataset_builder.scene.variants.registry import (
    IMAGE_LIGHTS,
    IRRADIANCE,
    LIGHT_SLOT,
    VARIANTS,
    ImageLight,
    image_light,
)
from dataset_builder.specs.config_specs import AppearanceSpec, ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.geometry.cameras import Camera, look_at
from tests.builder.blender.probe import RunProbe

TURN_DEG = 35.0


def scene_with(*variants: str, seed: int = 0) -> SceneSpec:
    return SceneSpec("s", LatticeSpec(), None, appearance=AppearanceSpec(variants), seed=seed)


def light_of(name: str) -> ImageLight:
    light = image_light(scene_with(name))
    assert light is not None
    return light


def panorama_pixels(name: str) -> np.ndarray:
    bpy = find_spec("bpy")
    assert bpy is not None
    assert bpy.origin is not None
    [path] = Path(bpy.origin).parent.glob(f"*/datafiles/studiolights/world/{name}.exr")
    with OpenEXR.File(str(path)) as file:
        return np.array(file.channels()["RGB"].pixels, dtype=np.float64)[..., :3]


def solid_angle_sr(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the polar angle of each row, and the solid angle of each of its pixels."""
    polar_rad = (np.arange(rows) + 0.5) / rows * np.pi
    return polar_rad, np.sin(polar_rad) * (np.pi / rows) * (2 * np.pi / columns)


def brightest_direction(rgb: np.ndarray) -> np.ndarray:
    """Return the direction of the brightest pixel; the middle column is +x and azimuths decrease to the right."""
    rows, columns = rgb.shape[:2]
    row, column = np.unravel_index(rgb.sum(axis=2).argmax(), (rows, columns))
    azimuth, elevation = (0.5 - (column + 0.5) / columns) * 2 * np.pi, (0.5 - (row + 0.5) / rows) * np.pi
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def probe(folder: Path) -> None:
    """Render the sun of a turned panorama, and the opposite direction (runs in the Blender process)."""
    import bpy

    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.lights import add_panorama

    bpy.ops.wm.read_factory_settings(use_empty=True)
    light = replace(light_of("sunrise"), strength=0.02, turn_deg=TURN_DEG)
    add_panorama(light)
    configure_colour(threads=1)
    no_steel = np.zeros((16, 16), dtype=bool)
    turn = np.deg2rad(TURN_DEG)
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    towards = turned @ brightest_direction(panorama_pixels("sunrise"))
    K = np.array([[20.0, 0, 7.5], [0, 20.0, 7.5], [0, 0, 1]])
    for name, sign in (("sun", 1.0), ("opposite", -1.0)):
        camera = Camera(K, np.zeros(5), look_at(np.zeros(3), sign * towards * [1, 1, sign]), 16, 16)
        np.save(folder / f"{name}.npy", render_colour(camera, no_steel, ColourSpec(4, 4), 1, folder))
    try:
        add_panorama(replace(light, sha256="0" * 64))
    except BuildError as error:
        (folder / "refusal.json").write_text(json.dumps(str(error)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_probe: RunProbe) -> Path:
    return run_probe("tests.builder.blender.test_panorama", tmp_path_factory.mktemp("panorama"))


def test_panoramas_are_variants_of_the_light() -> None:
    assert set(IMAGE_LIGHTS) == {
        "city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset"
    }  # fmt: skip
    assert all(VARIANTS[name].slot == LIGHT_SLOT for name in IMAGE_LIGHTS)


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGE_LIGHTS)
def test_strength_gives_stated_irradiance_of_horizontal_surface(blender: None, name: str) -> None:
    luminance = panorama_pixels(name) @ [0.2126, 0.7152, 0.0722]
    polar_rad, pixel_sr = solid_angle_sr(*luminance.shape)
    irradiance = (luminance.sum(axis=1) * pixel_sr * np.clip(np.cos(polar_rad), 0, None)).sum()
    assert light_of(name).strength * irradiance == pytest.approx(IRRADIANCE, rel=2e-3)


def test_seed_determines_turn() -> None:
    lights = [image_light(scene_with("city", seed=seed)) for seed in (0, 0, 1)]
    assert lights[0] == lights[1] != lights[2]
    assert image_light(scene_with()) is None
    assert image_light(scene_with("dusk", "sensor")) is None


def test_manifest_records_panorama_and_sensor() -> None:
    [spec] = BuildRequest(configs=("lattice",), variants=("sensor", "night"), seed=3).config_specs()
    assert spec.name == "lattice-night-sensor"
    appearance = config_parameters(spec)["scene"]["appearance"]
    assert appearance["variants"] == ["night", "sensor"]
    assert appearance["image_light"]["image"] == "night"
    assert len(appearance["image_light"]["sha256"]) == 64
    assert 0 <= appearance["image_light"]["turn_deg"] < 360
    assert appearance["sensor"]["gain_db"] == 18.0
    [standard] = BuildRequest(configs=("lattice",)).config_specs()
    assert set(config_parameters(standard)["scene"]["appearance"]) == {"variants"}


def test_sun_is_where_the_turn_puts_it(folder: Path) -> None:
    sun, opposite = (np.load(folder / f"{name}.npy").astype(int).sum(axis=2) for name in ("sun", "opposite"))
    brightest = np.unravel_index(sun.argmax(), sun.shape)
    assert np.abs(np.array(brightest) - 7.5).max() <= 1.5
    assert opposite.max() < 0.2 * sun.max()


def test_other_file_of_the_wheel_is_refused(folder: Path) -> None:
    message = json.loads((folder / "refusal.json").read_text())
    assert "sunrise.exr: the panorama has sha256 6a1180" in message
    assert f"expected {'0' * 64}" in message


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
