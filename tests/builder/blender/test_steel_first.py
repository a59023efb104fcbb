"""Two-pass colour: samples of one sequence, boxes without a seam, and the denoiser of Cycles as reference.

Blender runs in a separate process, ``python -m tests.builder.blender.test_steel_first FOLDER``; the tests check
what it renders.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.rigs import rig_cameras, zed_rig
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.raycast import PixelBox, RayCaster, steel_box
from dataset_builder.specs.config_specs import ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, ideal_K
from tests.builder.blender.probe import RunProbe

SCENE = SceneSpec("small", LatticeSpec(pitch_m=0.05), BoardSpec(), seed=3)
POSE = look_at_with_rig(np.array([0.20, -0.24, 0.15]), np.array([0.0, 0.0, 0.05]), 0.12)
CAMERAS = {
    "pinhole": Camera(ideal_K(256, 144), np.zeros(5), POSE, 256, 144),
    "raw": rig_cameras(zed_rig(256, 144, "raw"), POSE)["left"],
}
_random = np.random.default_rng(1)
BOXES = [
    PixelBox(*map(int, (*sorted(_random.choice(68, 2, False)), *sorted(_random.choice(102, 2, False)))))
    for _ in range(40)
]
"""Boxes of an image of 101 x 67 pixels, whose borders are no exact fractions of it."""
STEEL_FIRST, UNIFORM = ColourSpec(2, 16), ColourSpec(16, 16)


def probe(folder: Path) -> None:
    """Render both cameras with one and two passes (runs in the Blender process)."""
    import bpy

    from dataset_builder.blender.camera import place_camera
    from dataset_builder.blender.colour import BOX_MARGIN_PX, configure_colour, render_colour
    from dataset_builder.blender.render import render_passes, rendered_file, temporary_settings
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    build_scene(lattice_assembly(SCENE.assembly), SCENE)  # type: ignore[arg-type]
    configure_colour(threads=2)
    caster, scene, arrays = RayCaster(evaluated_world_mesh()), bpy.context.scene, {}
    for name, camera in CAMERAS.items():
        mask = caster.cast(camera).mask
        box = steel_box(mask, BOX_MARGIN_PX)
        assert box is not None
        arrays[f"{name}/box"] = np.array([box.top, box.bottom, box.left, box.right])
        place_camera(camera)
        scene.cycles.seed, scene.cycles.samples = 5, 16
        arrays[f"{name}/first"] = render_passes(range(2), None, folder)
        arrays[f"{name}/further in box"] = render_passes(range(2, 6), box, folder)
        arrays[f"{name}/whole"] = render_passes(range(6), None, folder)
        arrays[f"{name}/first again"] = render_passes(range(2), None, folder)
        for setting, spec in (("steel-first", STEEL_FIRST), ("uniform", UNIFORM)):
            arrays[f"{name}/{setting}"] = render_colour(camera, mask, spec, 5, folder)
        for prefilter in ("FAST", "ACCURATE"):
            spec = ColourSpec(4, 4, prefilter)
            arrays[f"{name}/{prefilter}"] = render_colour(camera, mask, spec, 5, folder)
            denoising = {"use_denoising": True, "denoising_prefilter": prefilter, "samples": 4}
            picture = {"file_format": "PNG", "color_mode": "RGB", "color_depth": "8"}
            scene.view_settings.view_transform, scene.view_settings.look = "AgX", "None"
            with (
                temporary_settings(scene.cycles, **denoising),
                rendered_file(folder / "cycles.png", scene, **picture) as path,
            ):
                arrays[f"{name}/{prefilter} of Cycles"] = _levels(path)
    camera = CAMERAS["pinhole"]
    scene.cycles.samples, scene.cycles.seed = 1, 5
    place_camera(replace(camera, width=101, height=67))
    one_sample = render_passes(range(1), None, folder)
    arrays["boxes that differ"] = np.array(
        [
            [box.top, box.bottom, box.left, box.right]
            for box in BOXES
            if not np.array_equal(render_passes(range(1), box, folder), one_sample[box.slices])
        ]
    )
    configure_colour(threads=1)
    camera = CAMERAS["pinhole"]
    arrays["one thread"] = render_colour(camera, caster.cast(camera).mask, STEEL_FIRST, 5, folder)
    without_steel = np.zeros((camera.height, camera.width), bool)
    arrays["no steel"] = render_colour(camera, without_steel, ColourSpec(1, 16), 5, folder)
    arrays["one sample"] = render_colour(camera, without_steel, ColourSpec(1, 1), 5, folder)
    np.savez(folder / "arrays.npz", **arrays)


def _levels(path: Path) -> ndarray:
    from PIL import Image

    with Image.open(path) as image:
        return np.array(image.convert("RGB"))


@pytest.fixture(scope="module")
def arrays(tmp_path_factory: pytest.TempPathFactory, run_probe: RunProbe) -> dict[str, ndarray]:
    folder = run_probe("tests.builder.blender.test_steel_first", tmp_path_factory.mktemp("blender"))
    return dict(np.load(folder / "arrays.npz"))


def box_of(arrays: dict[str, ndarray], name: str) -> PixelBox:
    return PixelBox(*map(int, arrays[f"{name}/box"]))


@pytest.mark.parametrize("name", CAMERAS)
def test_two_passes_add_up_to_uniform_sampling_in_the_box(arrays: dict[str, ndarray], name: str) -> None:
    """Check that both passes see the same grid and share one sequence of samples, also on a distorted lens."""
    inside = box_of(arrays, name).slices
    first, further, whole = (arrays[f"{name}/{part}"] for part in ("first", "further in box", "whole"))
    assert further.shape == whole[inside].shape
    np.testing.assert_allclose((2 * first[inside] + 4 * further) / 6, whole[inside], atol=1e-5)
    assert np.abs(first[inside] - whole[inside]).max() > 0.1
    assert arrays[f"{name}/first again"].tobytes() == first.tobytes()


@pytest.mark.parametrize("prefilter", ["FAST", "ACCURATE"])
@pytest.mark.parametrize("name", CAMERAS)
def test_denoiser_gives_the_picture_of_cycles(arrays: dict[str, ndarray], name: str, prefilter: str) -> None:
    own, of_cycles = (arrays[f"{name}/{key}"].astype(int) for key in (prefilter, f"{prefilter} of Cycles"))
    assert np.abs(own - of_cycles).max() <= 1
    assert (own != of_cycles).mean() < 0.01


def test_steel_first_does_not_depend_on_threads_or_earlier_renders(arrays: dict[str, ndarray]) -> None:
    """Check this after renders with other samples, of which the samples must not depend either."""
    assert arrays["one thread"].tobytes() == arrays["pinhole/steel-first"].tobytes()


def test_every_box_has_its_pixels(arrays: dict[str, ndarray]) -> None:
    assert arrays["boxes that differ"].tolist() == []


def test_view_without_steel_has_one_pass(arrays: dict[str, ndarray]) -> None:
    assert arrays["no steel"].tobytes() == arrays["one sample"].tobytes()


@pytest.mark.parametrize("name", CAMERAS)
def test_border_of_the_box_is_no_edge(arrays: dict[str, ndarray], name: str) -> None:
    """Compare steps across the border of the box with those one to three pixels beside it, both less uniform ones.

    Uniform sampling has no border, so the difference of both pictures shows the border without the scene's edges.
    """
    difference = arrays[f"{name}/steel-first"].astype(float) - arrays[f"{name}/uniform"]
    at_border, beside = steps_across_border(difference, box_of(arrays, name))
    assert at_border.size > 100
    assert rms(at_border) < 1.25 * rms(beside)


def steps_across_border(image: Float64[ndarray, "h w 3"], box: PixelBox) -> tuple[ndarray, ndarray]:
    """Return the steps between pixels on both sides of the border, and those between pixels near the border."""
    height, width, _ = image.shape
    at_border, beside = [], []
    for axis, ends, across in ((0, (box.top, box.bottom), height), (1, (box.left, box.right), width)):
        steps = np.diff(image[:, box.left : box.right] if axis == 0 else image[box.top : box.bottom], axis=axis)
        for end in ends:
            if 4 <= end <= across - 4:
                at_border.append(steps.take(end - 1, axis=axis))
                beside += [steps.take(end - 1 + offset, axis=axis) for offset in (-3, -2, 2, 3)]
    return np.concatenate(at_border), np.concatenate(beside)


def rms(values: ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
