"""Distorted camera in Blender: Cycles' rays equal the lens model's rays, and colour is aligned with them.

Blender runs in a separate process, ``python -m tests.builder.blender.test_distorted_camera FOLDER``.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from dataset_builder.cameras.rigs import rig_cameras, zed_rig
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.specs.config_specs import ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import Camera, look_at, project, transform
from tests.builder.blender.probe import RunProbe

SCENE = SceneSpec("small", LatticeSpec(pitch_m=0.05), BoardSpec(), seed=3)
TARGET_M = np.array([0.0, 0.0, 0.05])

_CAMERAS = rig_cameras(zed_rig(160, 90, "raw"), look_at_with_rig(np.array([0.20, -0.24, 0.15]), TARGET_M, 0.12))
LEFT, RIGHT = _CAMERAS["left"], _CAMERAS["right"]
PINHOLE_CAMERA = replace(LEFT, distortion=np.zeros(5))
TANGENTIAL_CAMERA = Camera(
    np.array([[70.0, 0.0, 40.3], [0.0, 83.0, 61.7], [0.0, 0.0, 1.0]]),
    np.array([-0.15, 0.05, 0.02, -0.03, -0.004]),
    look_at(np.array([-0.3, -0.2, 0.3]), TARGET_M),
    110,
    90,
)
"""Large value of every distortion term, non-square pixels and a principal point far from the image centre."""
TOP_CAMERA = rig_cameras(
    zed_rig(640, 360, "raw"), look_at(np.array([0.0, 0.0, 0.52]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
)["left"]
SPEC = ColourSpec(2, 4)
DEPTH_CAMERAS = {"left": LEFT, "right": RIGHT, "tangential": TANGENTIAL_CAMERA, "pinhole": PINHOLE_CAMERA}


def probe(folder: Path) -> None:
    """Render depth and colour with distorted and pinhole cameras in turn (runs in the Blender process)."""
    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.render import render_depth
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    build_scene(lattice_assembly(SCENE.assembly), SCENE)  # type: ignore[arg-type]
    configure_colour(threads=1)
    mesh = evaluated_world_mesh()
    caster = RayCaster(mesh)

    def picture(camera: Camera, spec: ColourSpec = SPEC) -> ndarray:
        return render_colour(camera, caster.cast(camera).mask, spec, seed=1, scratch_dir=folder)

    arrays: dict[str, ndarray] = {"pinhole_first": picture(PINHOLE_CAMERA)}
    arrays["raw"] = picture(LEFT)
    for name, camera in DEPTH_CAMERAS.items():
        arrays[f"depth_{name}"] = render_depth(camera, scratch_dir=folder)
    arrays["pinhole_again"] = picture(PINHOLE_CAMERA)
    arrays["raw_again"] = picture(LEFT)
    build_scene(lattice_assembly(SCENE.assembly), SCENE)  # type: ignore[arg-type]
    configure_colour(threads=2)
    arrays["raw_two_threads"] = picture(LEFT)
    arrays["above"] = picture(TOP_CAMERA, ColourSpec(8, 8))
    np.savez(folder / "arrays.npz", **arrays)
    np.savez(folder / "mesh.npz", vertices_m=mesh.vertices_m, faces=mesh.faces, face_bar_id=mesh.face_bar_id)
    left_over = sorted(path.name for path in folder.iterdir())
    (folder / "facts.json").write_text(json.dumps({"left_over": left_over}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_probe: RunProbe) -> Path:
    return run_probe("tests.builder.blender.test_distorted_camera", tmp_path_factory.mktemp("blender"))


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, ndarray]:
    return dict(np.load(folder / "arrays.npz"))


@pytest.fixture(scope="module")
def caster(folder: Path) -> RayCaster:
    return RayCaster(WorldMesh(**np.load(folder / "mesh.npz")))


@pytest.mark.parametrize("name", DEPTH_CAMERAS)
def test_cycles_depth_follows_distorted_rays(arrays: dict[str, ndarray], caster: RayCaster, name: str) -> None:
    camera, cycles_m = DEPTH_CAMERAS[name], arrays[f"depth_{name}"]
    truth = caster.cast(camera)
    assert cycles_m.dtype == np.float32
    assert cycles_m.shape == truth.depth_m.shape
    assert truth.mask.mean() > 0.01
    error_m = np.abs(cycles_m.astype(np.float64) - truth.depth_m)
    assert np.median(error_m) < 2e-6
    assert (error_m > 1e-4).mean() < 1e-3
    assert (error_m[truth.mask] > 1e-5).mean() < 5e-3


def test_distortion_changes_depth(arrays: dict[str, ndarray]) -> None:
    """Check that the same camera without distortion gives different depth."""
    assert np.median(np.abs(arrays["depth_left"] - arrays["depth_pinhole"])) > 1e-3


@pytest.mark.parametrize(
    ("one", "other"),
    [("raw", "raw_again"), ("raw", "raw_two_threads"), ("pinhole_first", "pinhole_again")],
)
def test_repeated_colour_render_is_byte_identical(arrays: dict[str, ndarray], one: str, other: str) -> None:
    assert arrays[one].shape == (90, 160, 3)
    assert arrays[one].tobytes() == arrays[other].tobytes()


def test_colour_brightness_equals_pinhole_brightness(arrays: dict[str, ndarray]) -> None:
    raw, pinhole = arrays["raw"].astype(float), arrays["pinhole_first"].astype(float)
    assert abs(raw.mean() - pinhole.mean()) < 12
    assert np.abs(raw - pinhole).mean() > 2  # The images themselves differ.


def test_rendered_markers_follow_distortion(arrays: dict[str, ndarray]) -> None:
    offsets_px = marker_offsets_px(arrays["above"], TOP_CAMERA)
    assert rms(offsets_px.reshape(-1, 2)) < 0.3
    # Marker centres are not affected by the apparent shrinking of dark squares.
    assert rms(offsets_px.mean(axis=1)) < 0.1
    assert (
        rms(marker_offsets_px(arrays["above"], replace(TOP_CAMERA, distortion=np.zeros(5))).reshape(-1, 2)) > 1.0
    )


def rms(offsets_px: Float64[ndarray, "n 2"]) -> float:
    return float(np.sqrt((offsets_px**2).sum(axis=1).mean()))


def marker_offsets_px(picture: UInt8[ndarray, "h w 3"], camera: Camera) -> Float64[ndarray, "m 4 2"]:
    """Return detected minus expected corner positions of each marker, in pixels.

    A corner is detected as the intersection of the lines fitted to two adjacent marker edges. The film curve lifts
    bright greys; the fourth power of the grey value is about linear in light, so that the edge is at half its
    range.
    """
    light = (picture.mean(axis=2) / picture.max()).astype(np.float32) ** 4
    offsets = []
    for corners_m in marker_corners_m(BoardSpec()).values():
        expected = project(camera.K, transform(camera.cam_from_world, corners_m), camera.distortion)
        sides = [edge_line(light, expected[n], expected[(n + 1) % 4]) for n in range(4)]
        corners_uvw = np.array([np.cross(sides[n - 1], sides[n]) for n in range(4)])
        offsets.append(corners_uvw[:, :2] / corners_uvw[:, 2:] - expected)
    return np.array(offsets)


def edge_line(light: Float32[ndarray, "h w"], start: ndarray, end: ndarray) -> Float64[ndarray, 3]:
    """Return the homogeneous line of the white-to-black edge near a segment that has white on its left."""
    tangent = (end - start) / np.linalg.norm(end - start)
    normal = np.array([-tangent[1], tangent[0]])
    offsets_px = np.arange(-3.0, 3.01, 0.1)
    points = []
    for share in np.linspace(0.12, 0.88, 25):
        base = start + share * (end - start)
        u, v = (base + offsets_px[:, None] * normal).astype(np.float32).T
        profile = cv2.remap(light, u[None], v[None], cv2.INTER_LINEAR)[0]
        half = (profile[:8].mean() + profile[-8:].mean()) / 2
        inside = int(np.argmax(profile < half))
        subpixel = (profile[inside - 1] - half) / (profile[inside - 1] - profile[inside])
        points.append(base + (offsets_px[inside - 1] + 0.1 * subpixel) * normal)
    middle = np.mean(points, axis=0)
    direction = np.linalg.svd(points - middle)[2][0]
    return np.asarray(np.cross([*middle, 1.0], [*(middle + direction), 1.0]))


def test_no_scratch_files_remain(folder: Path) -> None:
    assert json.loads((folder / "facts.json").read_text())["left_over"] == ["arrays.npz", "mesh.npz"]


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
