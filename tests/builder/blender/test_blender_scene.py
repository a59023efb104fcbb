"""Blender scene: agreement of Cycles' depth with the evaluated mesh, and byte-identical repeated renders.

Blender runs in a separate process, ``python -m tests.builder.blender.test_blender_scene FOLDER``, which renders
small images of a small lattice into FOLDER; the tests check the results.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.specs.config_specs import ColourSpec, LatticeSpec, SceneSpec
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import Camera, ideal_K, look_at, project, transform
from tests.builder.blender.probe import RunProbe

SCENE = SceneSpec("small", LatticeSpec(pitch_m=0.05), BoardSpec(), seed=3)
NUM_BARS = 12
TARGET_M = np.array([0.0, 0.0, 0.05])

LATTICE_CAMERA = Camera(
    ideal_K(128, 72), np.zeros(5), look_at_with_rig(np.array([0.20, -0.24, 0.15]), TARGET_M, 0.12), 128, 72
)
ANISOTROPIC_CAMERA = Camera(
    np.array([[70.0, 0.0, 40.3], [0.0, 83.0, 61.7], [0.0, 0.0, 1.0]]),
    np.zeros(5),
    look_at(np.array([-0.3, -0.2, 0.3]), TARGET_M),
    110,
    90,
)
TOP_CAMERA = Camera(
    np.array([[360.0, 0.0, 239.5], [0.0, 360.0, 179.5], [0.0, 0.0, 1.0]]),
    np.zeros(5),
    look_at(np.array([0.0, 0.0, 0.44]), np.zeros(3), np.array([0.0, 1.0, 0.0])),
    480,
    360,
)


def probe(folder: Path) -> None:
    """Render, read back and write all results to ``folder`` (runs in the Blender process)."""
    from dataset_builder.blender.camera import place_camera
    from dataset_builder.blender.colour import configure_colour, render_colour
    from dataset_builder.blender.render import render_depth
    from dataset_builder.blender.scene import build_scene, evaluated_world_mesh

    facts: dict[str, Any] = {}
    build_scene(lattice_assembly(SCENE.assembly), SCENE)  # type: ignore[arg-type]

    def picture(camera: Camera, seed: int) -> ndarray:
        return render_colour(camera, caster.cast(camera).mask, ColourSpec(3, 6), seed, folder)

    mesh = evaluated_world_mesh()
    caster = RayCaster(mesh)
    facts["refusal"] = _error_message(lambda: picture(LATTICE_CAMERA, seed=1))
    facts["skew"] = _error_message(
        lambda: place_camera(replace(LATTICE_CAMERA, K=LATTICE_CAMERA.K + np.eye(3, k=1)))
    )
    arrays: dict[str, ndarray] = {"depth_first": render_depth(ANISOTROPIC_CAMERA, scratch_dir=folder)}
    configure_colour(threads=1)
    arrays["colour"] = picture(LATTICE_CAMERA, seed=1)
    arrays["depth_low"] = render_depth(LATTICE_CAMERA, scratch_dir=folder)
    arrays["colour_after_depth"] = picture(LATTICE_CAMERA, seed=1)
    arrays["other_seed"] = picture(LATTICE_CAMERA, seed=2)
    facts["left_over"] = sorted(path.name for path in folder.iterdir())
    build_scene(lattice_assembly(SCENE.assembly), SCENE)  # type: ignore[arg-type]
    repeated_mesh = evaluated_world_mesh()
    configure_colour(threads=2)
    arrays["colour_two_threads"] = picture(LATTICE_CAMERA, seed=1)
    arrays["above"] = picture(TOP_CAMERA, seed=1)
    facts["deviation"] = place_camera(LATTICE_CAMERA)
    facts["mesh_repeats"] = _same_mesh(mesh, repeated_mesh)
    facts["objects"] = _steel_objects()
    _modify_bars()
    _save_mesh(folder / "mesh.npz", mesh)
    _save_mesh(folder / "changed.npz", evaluated_world_mesh())
    np.savez(folder / "arrays.npz", **arrays)
    (folder / "facts.json").write_text(json.dumps(facts))


def _error_message(action: Any) -> str:
    try:
        action()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def _same_mesh(a: WorldMesh, b: WorldMesh) -> bool:
    pairs = [(a.vertices_m, b.vertices_m), (a.faces, b.faces), (a.face_bar_id, b.face_bar_id)]
    return all(x.tobytes() == y.tobytes() for x, y in pairs)


def _steel_objects() -> list[dict[str, Any]]:
    import bpy

    steel = [item for item in bpy.data.objects if item.get("bar_id")]
    return [{"bar_id": item["bar_id"], "rust": item["rust_amount"], "mesh": item.data.name} for item in steel]


def _modify_bars() -> None:
    """Hide bar 1 from renders, rotate and move bar 2, thicken bar 3 with a modifier."""
    import bpy

    by_id = {item.get("bar_id"): item for item in bpy.data.objects}
    by_id[1].hide_render = True
    by_id[2].rotation_euler = (0.1, 0.2, 0.3)
    by_id[2].location.x += 1.0
    by_id[3].modifiers.new("thicker", "DISPLACE").strength = 0.01
    bpy.context.view_layer.update()


def _save_mesh(path: Path, mesh: WorldMesh) -> None:
    np.savez(path, vertices_m=mesh.vertices_m, faces=mesh.faces, face_bar_id=mesh.face_bar_id)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, run_probe: RunProbe) -> Path:
    return run_probe("tests.builder.blender.test_blender_scene", tmp_path_factory.mktemp("blender"))


@pytest.fixture(scope="module")
def arrays(folder: Path) -> dict[str, ndarray]:
    return dict(np.load(folder / "arrays.npz"))


@pytest.fixture(scope="module")
def facts(folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / "facts.json").read_text())
    return loaded


@pytest.fixture(scope="module")
def mesh(folder: Path) -> WorldMesh:
    return WorldMesh(**np.load(folder / "mesh.npz"))


def steel_vertices_m(mesh: WorldMesh, bar_id: int) -> Float64[ndarray, "n 3"]:
    return np.asarray(mesh.vertices_m[np.unique(mesh.faces[mesh.face_bar_id == bar_id])])


@pytest.mark.parametrize("other", ["colour_after_depth", "colour_two_threads"])
def test_repeated_colour_render_is_byte_identical(arrays: dict[str, ndarray], other: str) -> None:
    assert arrays["colour"].shape == (72, 128, 3)
    assert arrays["colour"].dtype == np.uint8
    assert arrays["colour"].tobytes() == arrays[other].tobytes()


def test_seed_changes_only_noise(arrays: dict[str, ndarray]) -> None:
    difference = np.abs(arrays["colour"].astype(int) - arrays["other_seed"])
    assert difference.max() > 0
    assert np.median(difference) <= 3


def test_exposure_is_neither_dark_nor_clipped(arrays: dict[str, ndarray]) -> None:
    assert 90 < arrays["colour"].mean() < 190
    assert (arrays["colour"].min(axis=2) >= 250).mean() < 0.001
    assert arrays["colour"].min() < 60


@pytest.mark.parametrize(("name", "camera"), [("depth_low", LATTICE_CAMERA), ("depth_first", ANISOTROPIC_CAMERA)])
def test_cycles_depth_equals_evaluated_mesh(
    arrays: dict[str, ndarray], mesh: WorldMesh, name: str, camera: Camera
) -> None:
    truth = RayCaster(mesh).cast(camera)
    assert truth.mask.mean() > 0.01
    assert arrays[name].dtype == np.float32
    error_m = np.abs(arrays[name].astype(np.float64) - truth.depth_m)
    assert np.median(error_m) < 1e-6
    assert (error_m > 1e-4).mean() < 1e-3
    assert (error_m[truth.mask] > 1e-5).mean() < 5e-3


def test_steel_mesh_equals_assembly(mesh: WorldMesh) -> None:
    assembly = lattice_assembly(LatticeSpec(pitch_m=0.05))
    assert set(np.unique(mesh.face_bar_id)) == set(range(NUM_BARS + 1))
    for part in assembly.parts:
        assert (mesh.face_bar_id == part.bar_id).sum() == len(part.mesh.faces)
        np.testing.assert_allclose(steel_vertices_m(mesh, part.bar_id), part.mesh.vertices_m, atol=2e-8)


def test_room_surrounds_aruco_board(mesh: WorldMesh) -> None:
    room_m = mesh.vertices_m[np.unique(mesh.faces[mesh.face_bar_id == 0])]
    assert (np.ptp(room_m, axis=0) > [3.0, 3.0, 1.5]).all()
    corners_m = np.array([[sx * 0.21, sy * 0.1485, 0.0] for sx in (-1, 1) for sy in (-1, 1)])
    nearest_m = np.linalg.norm(room_m[None] - corners_m[:, None], axis=2).min(axis=1)
    assert nearest_m.max() < 1e-7


def test_evaluated_mesh_is_deterministic(facts: dict[str, Any]) -> None:
    assert facts["mesh_repeats"]


def test_evaluated_mesh_reflects_object_changes(folder: Path, mesh: WorldMesh) -> None:
    changed = WorldMesh(**np.load(folder / "changed.npz"))
    assert 1 not in changed.face_bar_id
    moved, original = steel_vertices_m(changed, 2), steel_vertices_m(mesh, 2)
    assert moved[:, 0].mean() - original[:, 0].mean() == pytest.approx(1.0, abs=0.05)
    # A rod along x that is rotated by 0.3 rad about the vertical has a larger extent in y.
    assert np.ptp(moved[:, 1]) > np.ptp(original[:, 1]) + 0.02
    thick_m, thin_m = (np.ptp(steel_vertices_m(world_mesh, 3)[:, 1:], axis=0) for world_mesh in (changed, mesh))
    assert (thick_m > thin_m + 0.005).all()
    np.testing.assert_array_equal(steel_vertices_m(changed, 4), steel_vertices_m(mesh, 4))


def test_bar_objects_share_meshes_but_not_rust(facts: dict[str, Any]) -> None:
    objects = facts["objects"]
    assert sorted(item["bar_id"] for item in objects) == list(range(1, NUM_BARS + 1))
    assert len({item["mesh"] for item in objects}) == 6
    assert len({item["rust"] for item in objects}) == NUM_BARS


def test_rendered_markers_match_layout(arrays: dict[str, ndarray]) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detections, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(arrays["above"])
    assert sorted(ids.ravel()) == list(range(6))
    for marker_id, detected in zip(ids.ravel(), detections, strict=True):
        expected_px = project(
            TOP_CAMERA.K, transform(TOP_CAMERA.cam_from_world, marker_corners_m(BoardSpec())[int(marker_id)])
        )
        # With three samples the detector is accurate to 1-2 px; a mirrored or rotated marker is 40 px off.
        np.testing.assert_allclose(detected[0], expected_px, atol=2.0)


def test_blender_camera_has_requested_pose(facts: dict[str, Any]) -> None:
    assert facts["deviation"] < 1e-6


def test_missing_colour_setup_and_skew_raise_errors(facts: dict[str, Any]) -> None:
    assert facts["refusal"].startswith("BuildError: the scene is not set up for colour")
    assert facts["skew"].startswith("ValueError: Blender cameras cannot have skew")


def test_no_scratch_files_remain(facts: dict[str, Any]) -> None:
    assert facts["left_over"] == []


if __name__ == "__main__":
    probe(Path(sys.argv[1]))
