"""The named variants: which names go together, and what each does to a picture and to its truth.

Blender runs in a process of its own, ``python -m tests.builder.blender.test_appearance FOLDER``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from dataset_builder.config.rigs import Camera
from dataset_builder.config.specs import AppearanceSpec, ColourSpec, LatticeSpec, SceneSpec
from dataset_builder.config.trajectories import aim_rig
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.variants import LIGHT, STEEL, THINGS, VARIANTS, check_variants
from dataset_builder.scene.variants.props import MAKERS, occluders
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import ideal_K, look_at, pixel_rays
from tests.builder.blender.probe import run_probe
from tests.builder.blender.test_occluders import cage

EYES = {
    azimuth: Camera(
        ideal_K(96, 54),
        np.zeros(5),
        aim_rig(
            np.array([0.26 * np.cos(np.deg2rad(azimuth)), 0.26 * np.sin(np.deg2rad(azimuth)), 0.13]),
            np.array([0.0, 0.0, 0.05]),
            0.12,
        ),
        96,
        54,
    )
    for azimuth in (30, 120, 210, 300)
}
SITE = Camera(ideal_K(96, 54), np.zeros(5), look_at(np.array([8.4, -6.0, 1.2]), np.array([0.0, 0.0, 3.3])), 96, 54)
WITH_NEW_SURFACES = (*(f"laboratory/{name}" for name in MAKERS), "outdoors/None", "outdoors/shadows")
LIT = [None, *(name for name, variant in VARIANTS.items() if variant.slot == LIGHT)]


def probe(folder: Path) -> None:
    """Run inside Blender's process: render every variant tiny, and cast its truth."""
    from dataset_builder.blender.evaluated_mesh import evaluated_world_mesh
    from dataset_builder.blender.render import configure_colour, render_colour, render_depth
    from dataset_builder.blender.scene import build_scene

    arrays: dict[str, ndarray] = {}
    lattice = lattice_assembly(LatticeSpec(pitch_m=0.05))

    def look(key: str, assembly: Assembly, spec: SceneSpec, cameras: dict[int, Camera]) -> None:
        build_scene(assembly, spec)
        configure_colour(ColourSpec(samples=2), threads=1)
        caster = RayCaster(evaluated_world_mesh())
        for azimuth, camera in cameras.items():
            rays_cam = pixel_rays(camera.K, camera.width, camera.height)
            truth = caster.cast(rays_cam, camera.cam_from_world)
            arrays[f"{key}/bars/{azimuth}"] = truth.bars
            arrays[f"{key}/depth/{azimuth}"] = truth.depth_m
        first = next(iter(cameras.values()))
        arrays[f"{key}/colour"] = render_colour(first, seed=1, scratch_dir=folder)
        if key in WITH_NEW_SURFACES:
            arrays[f"{key}/cycles"] = render_depth(first, scratch_dir=folder)

    for name in (None, *VARIANTS):
        appearance = AppearanceSpec((name,) if name else ())
        look(
            f"laboratory/{name}", lattice, SceneSpec("s", LatticeSpec(), BoardSpec(), appearance=appearance), EYES
        )
    for name in LIT:
        appearance = AppearanceSpec((name,) if name else ())
        spec = SceneSpec("s", LatticeSpec(), None, environment="outdoors", appearance=appearance)
        look(f"outdoors/{name}", cage(4.8, 6.67, 0.1), spec, {0: SITE})
    try:
        build_scene(lattice, SceneSpec("s", LatticeSpec(), None, appearance=AppearanceSpec(("dusk", "backlight"))))
    except InputError as error:
        (folder / "refusal.json").write_text(json.dumps(str(error)))
    np.savez(folder / "arrays.npz", **arrays)


def test_every_variant_says_what_it_does_and_fills_a_slot() -> None:
    assert {variant.slot for variant in VARIANTS.values()} == {LIGHT, STEEL, THINGS}
    assert all(name == variant.name and len(variant.words) > 20 for name, variant in VARIANTS.items())
    assert {name for name, variant in VARIANTS.items() if variant.slot == THINGS} == set(MAKERS) - {"shadows"}


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("fog",), "no appearance variant 'fog', expected one of dusk, spotlight"),
        (("dusk", "shadows"), "dusk, shadows all set the light"),
        (("rusted", "clutter", "wet"), "rusted, wet all set the steel"),
        (("clutter", "clutter"), "'clutter' is named 2 times"),
        (("Dusk", ""), "no appearance variant ''"),
    ],
)
def test_names_that_do_not_go_are_refused_in_words(names: tuple[str, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_variants(names)
    with pytest.raises(InputError):
        occluders(Assembly((), ()), SceneSpec("s", LatticeSpec(), None, appearance=AppearanceSpec(names)))


def test_names_that_go_are_let_through() -> None:
    check_variants(())
    check_variants(("dusk", "rusted", "clutter", "formwork", "spacers", "tie-wire"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_probe("tests.builder.blender.test_appearance", tmp_path_factory.mktemp("appearance"))


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, ndarray]:
    return dict(np.load(folder / "arrays.npz"))


def mean_change(arrays: dict[str, ndarray], one: str, other: str) -> float:
    return float(np.abs(arrays[f"{one}/colour"].astype(float) - arrays[f"{other}/colour"]).mean())


@pytest.mark.render
@pytest.mark.parametrize("name", VARIANTS)
def test_each_variant_changes_the_picture(arrays: dict[str, ndarray], name: str) -> None:
    assert mean_change(arrays, f"laboratory/{name}", "laboratory/None") > (0.1 if name == "tie-wire" else 0.3)


@pytest.mark.render
@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.slot != THINGS])
def test_light_and_steel_leave_the_ids_alone(arrays: dict[str, ndarray], name: str) -> None:
    for azimuth in EYES:
        np.testing.assert_array_equal(
            arrays[f"laboratory/{name}/bars/{azimuth}"], arrays[f"laboratory/None/bars/{azimuth}"]
        )


@pytest.mark.render
@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.slot == THINGS])
def test_things_take_steel_away_and_add_none(arrays: dict[str, ndarray], name: str) -> None:
    for azimuth in EYES:
        bars, before = (arrays[f"laboratory/{key}/bars/{azimuth}"] for key in (name, "None"))
        assert (bars[bars > 0] == before[bars > 0]).all()
        changed = arrays[f"laboratory/{name}/depth/{azimuth}"] - arrays[f"laboratory/None/depth/{azimuth}"]
        assert changed.max() <= 1e-6, "nothing moves away"


@pytest.mark.render
def test_formwork_hides_steel_from_one_side_only(arrays: dict[str, ndarray]) -> None:
    shares = [
        (arrays[f"laboratory/formwork/bars/{azimuth}"] > 0).sum()
        / (arrays[f"laboratory/None/bars/{azimuth}"] > 0).sum()
        for azimuth in EYES
    ]
    assert min(shares) < 0.85
    assert max(shares) > 0.9


@pytest.mark.render
@pytest.mark.parametrize("key", WITH_NEW_SURFACES)
def test_cycles_sees_what_the_truth_says(arrays: dict[str, ndarray], key: str) -> None:
    azimuth = 30 if key.startswith("laboratory") else 0
    cycles, truth = arrays[f"{key}/cycles"], arrays[f"{key}/depth/{azimuth}"]
    off_m = np.abs(cycles.astype(float) - truth)
    assert (off_m > 1e-4 * np.maximum(truth, 1.0)).mean() < 3e-3


@pytest.mark.render
def test_the_site_has_a_sky_without_depth_and_a_sound_exposure(arrays: dict[str, ndarray]) -> None:
    depth_m, rgb = arrays["outdoors/None/depth/0"], arrays["outdoors/None/colour"]
    assert 0.2 < (depth_m == 0.0).mean() < 0.8
    assert (depth_m[:3] == 0.0).mean() > 0.5
    assert 60 < depth_m.max() < 140
    assert 110 < rgb.mean() < 175
    assert (rgb.min(axis=2) >= 250).mean() < 0.001
    steel = rgb[arrays["outdoors/None/bars/0"] > 0]
    assert 20 < steel.mean() < 160


@pytest.mark.render
@pytest.mark.parametrize("place", ["laboratory", "outdoors"])
def test_light_variants_differ_and_are_dark_where_they_say_so(arrays: dict[str, ndarray], place: str) -> None:
    brightness = {name: arrays[f"{place}/{name}/colour"].mean() for name in LIT}
    assert brightness["dusk"] < 0.5 * brightness[None]
    assert brightness["spotlight"] < 0.6 * brightness[None]
    assert min(brightness.values()) > 8
    for k, one in enumerate(LIT):
        for other in LIT[:k]:
            assert mean_change(arrays, f"{place}/{one}", f"{place}/{other}") > 3


@pytest.mark.render
def test_rivals_are_refused_before_anything_is_built(folder: Path) -> None:
    assert "dusk, backlight all set the light" in json.loads((folder / "refusal.json").read_text())


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
