"""Small lattice in Blender: its mesh, depth and colour, on pinhole and distorted cameras.

Cycles' depth must agree with the evaluated mesh, repeated renders must be byte-identical, and both passes of
colour must share one sequence of samples. ``probe`` renders in a Blender process; the tests check its arrays.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.rigs import rig_cameras, zed_rig
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import PixelBox, RayCaster, steel_box
from dataset_builder.specs.config_specs import ColourSpec, LatticeSpec, SceneSpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import detected_corners_px
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at, project, transform

LATTICE = LatticeSpec(pitch_m=0.05)
SCENE = SceneSpec("small", LATTICE, BoardSpec(), seed=3)
NUM_BARS = 12
WITHOUT_COLOUR = [
    BuildRequest(("lattice", "pile", "pier")),
    BuildRequest(("lattice", "pier"), variants=("rusted", "dusk", "clutter")),
    BuildRequest(("lattice",), variants=("tie-wire",)),
]
"""Scenes that are built with and without colour."""

POSE = look_at_with_rig(np.array([0.20, -0.24, 0.15]), np.array([0.0, 0.0, 0.05]), 0.12)
RAW = rig_cameras(zed_rig(256, 144, "raw"), POSE)
TANGENTIAL = Camera(
    np.array([[70.0, 0.0, 40.3], [0.0, 83.0, 61.7], [0.0, 0.0, 1.0]]),
    np.array([-0.15, 0.05, 0.02, -0.03, -0.004]),
    look_at(np.array([-0.3, -0.2, 0.3]), np.array([0.0, 0.0, 0.05])),
    110,
    90,
)
"""Large value of every distortion term, non-square pixels and a principal point far from the image centre."""
CAMERAS = {
    "pinhole": Camera(ideal_K(256, 144), np.zeros(5), POSE, 256, 144),
    "raw": RAW["left"],
    "raw right": RAW["right"],
    "raw without distortion": replace(RAW["left"], distortion=np.zeros(5)),
    "tangential": TANGENTIAL,
    "non-square pixels": replace(TANGENTIAL, distortion=np.zeros(5)),
}
COLOUR_CAMERAS = ("pinhole", "raw")
TOP_CAMERA = rig_cameras(
    zed_rig(640, 360, "raw"), look_at(np.array([0.0, 0.0, 0.52]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
)["left"]
STEEL_FIRST, UNIFORM = ColourSpec(2, 16), ColourSpec(16, 16)
_random = np.random.default_rng(1)
BOXES = [
    PixelBox(*map(int, (*sorted(_random.choice(68, 2, False)), *sorted(_random.choice(102, 2, False)))))
    for _ in range(40)
]
"""Boxes of an image of 101 x 67 pixels, whose borders are no exact fractions of it."""


def probe(folder: Path) -> dict[str, ndarray]:
    """Render depth and colour of the lattice, and build scenes without colour (runs in the Blender process)."""
    import bpy

    from dataset_builder.blender.camera import place_camera
    from dataset_builder.blender.colour import BOX_MARGIN_PX, configure_colour, render_colour
    from dataset_builder.blender.render import render_depth, render_passes
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    build_scene(lattice_assembly(LATTICE), SCENE)
    mesh = evaluated_world_mesh()
    caster, cycles = RayCaster(mesh), bpy.context.scene.cycles
    facts: dict[str, Any] = {}
    arrays = {f"mesh/{name}": array for name, array in vars(mesh).items()}

    def colour(camera: Camera, spec: ColourSpec, seed: int = 5, *, has_steel: bool = True) -> ndarray:
        return render_colour(camera, caster.cast(camera).mask & has_steel, spec, seed, folder)

    facts["without setup"] = _error_of(lambda: colour(CAMERAS["pinhole"], UNIFORM))
    facts["skew"] = _error_of(lambda: place_camera(replace(TANGENTIAL, K=TANGENTIAL.K + np.eye(3, k=1))))
    configure_colour(threads=2)
    for name, camera in CAMERAS.items():
        arrays[f"{name}/depth"] = render_depth(camera, folder)
    for name in COLOUR_CAMERAS:
        camera = CAMERAS[name]
        box = steel_box(caster.cast(camera).mask, BOX_MARGIN_PX)
        assert box is not None
        arrays[f"{name}/box"] = np.array([box.top, box.bottom, box.left, box.right])
        place_camera(camera)
        cycles.seed, cycles.samples = 5, 16
        arrays[f"{name}/first"] = render_passes(range(2), None, folder)
        arrays[f"{name}/further in box"] = render_passes(range(2, 6), box, folder)
        arrays[f"{name}/whole"] = render_passes(range(6), None, folder)
        arrays[f"{name}/first again"] = render_passes(range(2), None, folder)
        arrays[f"{name}/steel-first"], arrays[f"{name}/uniform"] = (
            colour(camera, STEEL_FIRST),
            colour(camera, UNIFORM),
        )
        for prefilter in ("FAST", "ACCURATE"):
            arrays[f"{name}/{prefilter}"] = colour(camera, ColourSpec(4, 4, prefilter))
            arrays[f"{name}/{prefilter} of Cycles"] = _denoised_by_cycles(prefilter, folder)
    pinhole = CAMERAS["pinhole"]
    arrays["other seed"] = colour(pinhole, STEEL_FIRST, seed=6)
    arrays["no steel"] = colour(pinhole, ColourSpec(1, 16), has_steel=False)
    arrays["one sample"] = colour(pinhole, ColourSpec(1, 1), has_steel=False)
    arrays["above"] = colour(TOP_CAMERA, ColourSpec(8, 8))
    place_camera(replace(pinhole, width=101, height=67))
    cycles.samples, cycles.seed = 1, 5
    whole = render_passes(range(1), None, folder)
    crops = [(box, render_passes(range(1), box, folder)) for box in BOXES]
    facts["boxes that differ"] = [str(box) for box, crop in crops if not np.array_equal(crop, whole[box.slices])]

    build_scene(lattice_assembly(LATTICE), SCENE)
    arrays |= {f"mesh again/{name}": array for name, array in vars(evaluated_world_mesh()).items()}
    configure_colour(threads=1)
    for name in COLOUR_CAMERAS:
        arrays[f"{name}/again"] = colour(CAMERAS[name], STEEL_FIRST)
    facts["deviation"] = place_camera(pinhole)
    steel = {item["bar_id"]: item for item in bpy.data.objects if item.get("bar_id")}
    facts["objects"] = [[bar_id, item.data.name, item["rust_amount"]] for bar_id, item in steel.items()]
    _change_bars(steel)
    arrays |= {f"changed mesh/{name}": array for name, array in vars(evaluated_world_mesh()).items()}

    for scene in (spec.scene for request in WITHOUT_COLOUR for spec in request.config_specs()):
        made = []
        for is_coloured in (True, False):
            build_scene(make_assembly(scene.assembly), scene, colour=is_coloured)
            digest = sha256(
                b"".join(array.tobytes() for array in vars(evaluated_world_mesh()).values())
            ).hexdigest()
            kinds = (bpy.data.materials, bpy.data.lights, bpy.data.images, bpy.data.worlds)
            made.append([digest, [len(kind) for kind in kinds]])
        facts.setdefault("without colour", {})[scene.name] = made
    return arrays | {"facts": np.array(json.dumps(facts))}


def _error_of(action: Callable[[], object]) -> str:
    try:
        action()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _denoised_by_cycles(prefilter: str, folder: Path) -> ndarray:
    """Return the picture of the placed camera as Cycles itself denoises it."""
    import bpy
    from PIL import Image

    from dataset_builder.blender.render import rendered_file, temporary_settings

    scene = bpy.context.scene
    denoising = {"use_denoising": True, "denoising_prefilter": prefilter, "samples": 4}
    picture = {"file_format": "PNG", "color_mode": "RGB", "color_depth": "8"}
    scene.view_settings.view_transform, scene.view_settings.look = "AgX", "None"
    with (
        temporary_settings(scene.cycles, **denoising),
        rendered_file(folder / "cycles.png", scene, **picture) as path,
        Image.open(path) as image,
    ):
        return np.array(image.convert("RGB"))


def _change_bars(by_id: dict[int, Any]) -> None:
    """Hide bar 1 from renders, rotate and move bar 2, thicken bar 3 with a modifier."""
    import bpy

    by_id[1].hide_render = True
    by_id[2].rotation_euler = (0.1, 0.2, 0.3)
    by_id[2].location.x += 1.0
    by_id[3].modifiers.new("thicker", "DISPLACE").strength = 0.01
    bpy.context.view_layer.update()


@pytest.fixture(scope="module")
def facts(rendered: dict[str, ndarray]) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(str(rendered["facts"]))
    return loaded


def mesh_of(rendered: dict[str, ndarray], name: str = "mesh") -> WorldMesh:
    return WorldMesh(**{field: rendered[f"{name}/{field}"] for field in ("vertices_m", "faces", "face_bar_id")})


def bar_vertices_m(mesh: WorldMesh, bar_id: int) -> Float64[ndarray, "n 3"]:
    return np.asarray(mesh.vertices_m[np.unique(mesh.faces[mesh.face_bar_id == bar_id])])


def test_mesh_is_that_of_the_assembly_each_time(rendered: dict[str, ndarray]) -> None:
    mesh, again = mesh_of(rendered), mesh_of(rendered, "mesh again")
    assert all(
        one.tobytes() == other.tobytes()
        for one, other in zip(vars(mesh).values(), vars(again).values(), strict=True)
    )
    assert set(np.unique(mesh.face_bar_id)) == set(range(NUM_BARS + 1))
    for part in lattice_assembly(LATTICE).parts:
        assert (mesh.face_bar_id == part.bar_id).sum() == len(part.mesh.faces)
        np.testing.assert_allclose(bar_vertices_m(mesh, part.bar_id), part.mesh.vertices_m, atol=2e-8)


def test_room_surrounds_the_board(rendered: dict[str, ndarray]) -> None:
    room_m = bar_vertices_m(mesh_of(rendered), 0)
    assert (np.ptp(room_m, axis=0) > [3.0, 3.0, 1.5]).all()
    corners_m = np.array([[sx * 0.21, sy * 0.1485, 0.0] for sx in (-1, 1) for sy in (-1, 1)])
    assert np.linalg.norm(room_m[None] - corners_m[:, None], axis=2).min(axis=1).max() < 1e-7


def test_mesh_reflects_changes_of_objects(rendered: dict[str, ndarray]) -> None:
    mesh, changed = mesh_of(rendered), mesh_of(rendered, "changed mesh")
    assert 1 not in changed.face_bar_id
    moved, original = bar_vertices_m(changed, 2), bar_vertices_m(mesh, 2)
    assert moved[:, 0].mean() - original[:, 0].mean() == pytest.approx(1.0, abs=0.05)
    # A rod along x that is rotated by 0.3 rad about the vertical has a larger extent in y.
    assert np.ptp(moved[:, 1]) > np.ptp(original[:, 1]) + 0.02
    thick_m, thin_m = (np.ptp(bar_vertices_m(world_mesh, 3)[:, 1:], axis=0) for world_mesh in (changed, mesh))
    assert (thick_m > thin_m + 0.005).all()
    np.testing.assert_array_equal(bar_vertices_m(changed, 4), bar_vertices_m(mesh, 4))


def test_bar_objects_share_meshes_but_not_rust(facts: dict[str, Any]) -> None:
    bar_ids, meshes, rust = zip(*facts["objects"], strict=True)
    assert sorted(bar_ids) == list(range(1, NUM_BARS + 1))
    assert len(set(meshes)) == 6
    assert len(set(rust)) == NUM_BARS


def test_scenes_without_colour_have_the_same_mesh_and_nothing_else(facts: dict[str, Any]) -> None:
    assert len(facts["without colour"]) == 6
    for (with_colour, made), (without, nothing) in facts["without colour"].values():
        assert with_colour == without
        assert made[0] > 1 <= made[1]
        assert nothing == [0, 0, 0, 0]


def test_camera_has_the_requested_pose_and_no_skew(facts: dict[str, Any]) -> None:
    assert facts["deviation"] < 1e-6
    assert facts["skew"].startswith("ValueError: Blender cameras cannot have skew")


@pytest.mark.parametrize("name", CAMERAS)
def test_depth_of_cycles_is_that_of_the_mesh(rendered: dict[str, ndarray], name: str) -> None:
    truth, cycles_m = RayCaster(mesh_of(rendered)).cast(CAMERAS[name]), rendered[f"{name}/depth"]
    assert (cycles_m.dtype, cycles_m.shape) == (np.float32, truth.depth_m.shape)
    assert truth.mask.mean() > 0.01
    error_m = np.abs(cycles_m.astype(np.float64) - truth.depth_m)
    assert np.median(error_m) < (1e-6 if not CAMERAS[name].distortion.any() else 2e-6)
    assert (error_m > 1e-4).mean() < 1e-3
    assert (error_m[truth.mask] > 1e-5).mean() < 5e-3


def test_distortion_changes_depth(rendered: dict[str, ndarray]) -> None:
    assert np.median(np.abs(rendered["raw/depth"] - rendered["raw without distortion/depth"])) > 1e-3


@pytest.mark.parametrize("name", COLOUR_CAMERAS)
def test_colour_does_not_depend_on_threads_or_earlier_renders(rendered: dict[str, ndarray], name: str) -> None:
    """Check this with a scene that is built anew after renders with other cameras and samples."""
    assert (rendered[f"{name}/again"].dtype, rendered[f"{name}/again"].shape) == (np.uint8, (144, 256, 3))
    assert rendered[f"{name}/again"].tobytes() == rendered[f"{name}/steel-first"].tobytes()


def test_seed_changes_only_noise(rendered: dict[str, ndarray]) -> None:
    difference = np.abs(rendered["pinhole/steel-first"].astype(int) - rendered["other seed"])
    assert difference.max() > 0
    assert np.median(difference) <= 3


def test_exposure_is_neither_dark_nor_clipped_on_any_lens(rendered: dict[str, ndarray]) -> None:
    pinhole, raw = (rendered[f"{name}/steel-first"].astype(float) for name in COLOUR_CAMERAS)
    assert 90 < pinhole.mean() < 190
    assert (pinhole.min(axis=2) >= 250).mean() < 0.001
    assert pinhole.min() < 60
    assert abs(raw.mean() - pinhole.mean()) < 12
    assert np.abs(raw - pinhole).mean() > 2  # The pictures themselves differ.


def test_markers_are_where_the_lens_shows_them(rendered: dict[str, ndarray]) -> None:
    detected, layout = (
        detected_corners_px(rendered["above"], BoardSpec().dictionary),
        marker_corners_m(BoardSpec()),
    )
    assert sorted(detected) == list(range(6))
    off_px = {
        is_distorted: np.array(
            [
                detected[marker]
                - project(
                    TOP_CAMERA.K,
                    transform(TOP_CAMERA.cam_from_world, corners_m),
                    is_distorted * TOP_CAMERA.distortion,
                )
                for marker, corners_m in layout.items()
            ]
        )
        for is_distorted in (True, False)
    }
    # A mirrored or rotated marker would be 40 px off; the tone curve moves corners inward by half a pixel.
    assert np.abs(off_px[True]).max() < 2
    # Centres are not affected by that.
    assert rms(off_px[True].mean(axis=1)) < 0.15
    assert rms(off_px[False].mean(axis=1)) > 0.8


def test_colour_without_setup_is_refused(facts: dict[str, Any]) -> None:
    assert facts["without setup"].startswith("BuildError: the scene is not set up for colour")


def box_of(rendered: dict[str, ndarray], name: str) -> PixelBox:
    return PixelBox(*map(int, rendered[f"{name}/box"]))


@pytest.mark.parametrize("name", COLOUR_CAMERAS)
def test_two_passes_add_up_to_uniform_sampling_in_the_box(rendered: dict[str, ndarray], name: str) -> None:
    """Check that both passes see the same grid and share one sequence of samples, also on a distorted lens."""
    inside = box_of(rendered, name).slices
    first, further, whole = (rendered[f"{name}/{part}"] for part in ("first", "further in box", "whole"))
    assert further.shape == whole[inside].shape
    np.testing.assert_allclose((2 * first[inside] + 4 * further) / 6, whole[inside], atol=1e-5)
    assert np.abs(first[inside] - whole[inside]).max() > 0.1
    assert rendered[f"{name}/first again"].tobytes() == first.tobytes()


@pytest.mark.parametrize("prefilter", ["FAST", "ACCURATE"])
@pytest.mark.parametrize("name", COLOUR_CAMERAS)
def test_denoiser_gives_the_picture_of_cycles(rendered: dict[str, ndarray], name: str, prefilter: str) -> None:
    own, of_cycles = (rendered[f"{name}/{key}"].astype(int) for key in (prefilter, f"{prefilter} of Cycles"))
    assert np.abs(own - of_cycles).max() <= 1
    assert (own != of_cycles).mean() < 0.01


def test_every_box_has_its_pixels(facts: dict[str, Any]) -> None:
    assert facts["boxes that differ"] == []


def test_view_without_steel_has_one_pass(rendered: dict[str, ndarray]) -> None:
    assert rendered["no steel"].tobytes() == rendered["one sample"].tobytes()


@pytest.mark.parametrize("name", COLOUR_CAMERAS)
def test_border_of_the_box_is_no_edge(rendered: dict[str, ndarray], name: str) -> None:
    """Compare steps across the border of the box with those one to three pixels beside it, both less uniform ones.

    Uniform sampling has no border, so the difference of both pictures shows the border without the scene's edges.
    """
    difference, box = (
        rendered[f"{name}/steel-first"].astype(float) - rendered[f"{name}/uniform"],
        box_of(rendered, name),
    )
    at_border, beside = [], []
    for axis, ends in ((0, (box.top, box.bottom)), (1, (box.left, box.right))):
        along_box = difference[:, box.left : box.right] if axis == 0 else difference[box.top : box.bottom]
        steps = np.moveaxis(np.diff(along_box, axis=axis), axis, 0)
        for end in ends:
            if 4 <= end <= len(steps) - 3:
                at_border.append(steps[end - 1].ravel())
                beside += [steps[end - 1 + offset].ravel() for offset in (-3, -2, 2, 3)]
    assert np.concatenate(at_border).size > 100
    assert rms(np.concatenate(at_border)) < 1.25 * rms(np.concatenate(beside))


def rms(values: ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
