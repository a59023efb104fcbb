"""Raw export: every file format read back with the tool it is meant for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from dataset_builder.cameras.rigs import rig_cameras, zed_rig
from dataset_builder.export import export
from dataset_builder.export.camera_formats import (
    cameras_txt,
    images_txt,
    points_txt,
    quaternion_wxyz,
    transforms_json,
)
from dataset_builder.export.exported_views import CameraView, depth_exr, depth_mm_png
from rebar_depth_bench import load
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import camera_centre, inverse_rigid, look_at, project, transform

pytestmark = pytest.mark.slow
Rows = dict[str, dict[str, Any]]
CAMERA_NAMES = ("left", "right")


@pytest.fixture(scope="module")
def exported(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an export of the whole tiny dataset."""
    to = tmp_path_factory.mktemp("export") / "all"
    export(tiny_root, to)
    return to


@pytest.fixture(scope="module")
def rows(tiny_root: Path) -> Rows:
    """Return the rows of the tiny ``lattice`` config by the number in their view id."""
    return {row["view_id"][-4:]: row for row in load(tiny_root, "lattice")}


@pytest.fixture(scope="module")
def known_points_m(tiny_root: Path) -> np.ndarray:
    """Return known world points, in metres: the ends of the bars and the corners of the markers."""
    ends = [point for bar in read_bars(tiny_root / "bars.parquet")["lattice"] for point in bar.axis_m]
    corners = [corner for four in marker_corners_m(BoardSpec(markers=6)).values() for corner in four]
    return np.array([*ends, *corners])


def zed_views() -> list[CameraView]:
    """Return two raw views of a real first-generation ZED: both lenses distorted, the right camera rotated."""
    rig, views = zed_rig(grid="raw"), []
    for number, centre_m in enumerate(([0.3, -0.2, 0.25], [-0.1, 0.35, 0.2])):
        cameras = rig_cameras(rig, look_at(np.array(centre_m), np.array([0.0, 0.0, 0.05])))
        views.append(CameraView(f"lattice-zed-raw/{number:04d}", rig.baseline_m, cameras))
    return views


@pytest.mark.parametrize("eye", CAMERA_NAMES)
def test_colour_bars_and_masks_round_trip(exported: Path, rows: Rows, eye: str) -> None:
    for number, row in rows.items():
        stem = f"{number}_{eye}"
        colour = cv2.imread(str(exported / f"lattice/images/{stem}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(colour[..., ::-1], row[f"{eye}_rgb"])
        bars = cv2.imread(str(exported / f"lattice/bars/{stem}.png"), cv2.IMREAD_UNCHANGED)
        assert bars.dtype == np.uint16
        assert np.array_equal(bars, row[f"{eye}_bars"])
        with Image.open(exported / f"lattice/masks/{stem}.png") as mask:
            assert mask.mode == "L"
            assert np.array_equal(np.asarray(mask), row[f"{eye}_mask"] * np.uint8(255))


def exr_depth(path: Path) -> np.ndarray:
    (channel,) = OpenEXR.File(str(path), separate_channels=True).channels().values()
    return np.asarray(channel.pixels)


@pytest.mark.parametrize("eye", CAMERA_NAMES)
def test_exr_depth_is_bit_exact_in_openexr_and_opencv(
    exported: Path, rows: Rows, eye: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV reads it at its first EXR file.
    for number, row in rows.items():
        path = exported / f"lattice/depth/{number}_{eye}.exr"
        for depth_m in (exr_depth(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)):
            assert depth_m.dtype == np.float32
            assert depth_m.tobytes() == row[f"{eye}_depth"].tobytes()


def test_exr_preserves_all_positive_floats(tmp_path: Path) -> None:
    bits = np.random.default_rng(0).integers(0, 0x7F800000, (45, 80), dtype=np.uint32)  # below infinity
    (tmp_path / "depth.exr").write_bytes(depth_exr(bits.view(np.float32)))
    assert np.array_equal(exr_depth(tmp_path / "depth.exr").view(np.uint32), bits)


def test_depth_mm_is_rounded_without_overflow(exported: Path, rows: Rows, tmp_path: Path) -> None:
    number, row = next(iter(rows.items()))
    depth_mm = cv2.imread(str(exported / f"lattice/depth_mm/{number}_left.png"), cv2.IMREAD_UNCHANGED)
    assert depth_mm.dtype == np.uint16
    assert np.abs(depth_mm / 1000 - row["left_depth"]).max() <= 0.0005001
    assert ((depth_mm == 0) == (row["left_depth"] == 0)).all()
    (tmp_path / "far.png").write_bytes(depth_mm_png(np.array([[0, 0.0016, 65.535, 65.536, 1e9]], np.float32)))
    far = cv2.imread(str(tmp_path / "far.png"), cv2.IMREAD_UNCHANGED)
    assert far.tolist() == [[0, 2, 65535, 0, 0]]


def test_cameras_json_matches_rows_and_files(exported: Path, rows: Rows) -> None:
    cameras_json = json.loads((exported / "lattice/cameras.json").read_text())
    assert len(cameras_json["cameras"]) == 2 * len(rows)
    assert cameras_json["parameters"]["rig"]["width"] == 160
    assert set(cameras_json["conventions"]) >= {"axes", "pixels", "depth", "cam_from_world"}
    for camera in cameras_json["cameras"]:
        row, eye = rows[camera["view_id"][-4:]], camera["eye"]
        for name in ("K", "distortion", "cam_from_world"):
            assert np.array_equal(camera[name], row[f"{eye}_{name}"])
        assert camera["baseline_m"] == row["baseline_m"]
        assert (camera["height"], camera["width"]) == row[f"{eye}_depth"].shape
        for picture in ("image", "depth", "depth_mm", "mask", "bars"):
            assert (exported / "lattice" / camera[picture]).is_file()


def test_pycolmap_projections_match_our_cameras(exported: Path, rows: Rows, known_points_m: np.ndarray) -> None:
    model = pycolmap.Reconstruction(exported / "lattice/sparse/0")
    assert model.num_cameras() == 1  # Both cameras of an ideal rig share their intrinsics.
    assert model.num_reg_images() == 2 * len(rows)
    for image in model.images.values():
        assert (exported / "lattice/images" / image.name).is_file()
        number, eye = image.name.removesuffix(".png").split("_")
        pose, K = rows[number][f"{eye}_cam_from_world"], rows[number][f"{eye}_K"]
        expected_px = project(K, transform(pose, known_points_m)) + 0.5
        colmap_px = np.array([image.project_point(point) for point in known_points_m])
        assert np.abs(colmap_px - expected_px).max() < 1e-6
        assert np.abs(image.projection_center() - camera_centre(pose)).max() < 1e-12


def test_colmap_points_project_onto_steel_masks(exported: Path) -> None:
    model = pycolmap.Reconstruction(exported / "lattice/sparse/0")
    points_m = np.array([point.xyz for point in model.points3D.values()])
    assert 5000 < len(points_m) < 12_000
    for image in model.images.values():
        pixels = np.array([image.project_point(point) for point in points_m[::10]])
        column, row = np.floor(pixels).astype(int).T
        with Image.open(exported / "lattice/masks" / image.name) as picture:
            mask = np.asarray(picture)
        inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
        assert inside.mean() > 0.5
        assert (mask[row[inside], column[inside]] == 255).mean() > 0.97  # Bar ends may miss a pixel centre.


def test_distorted_camera_is_full_opencv_in_colmap(tmp_path: Path, known_points_m: np.ndarray) -> None:
    views = zed_views()
    (tmp_path / "cameras.txt").write_text(cameras_txt(views))
    (tmp_path / "images.txt").write_text(images_txt(views))
    (tmp_path / "points3D.txt").write_text(points_txt([]))
    model = pycolmap.Reconstruction(tmp_path)
    assert [camera.model_name for camera in model.cameras.values()] == ["FULL_OPENCV"] * 2
    assert (model.num_reg_images(), model.num_points3D()) == (4, 0)
    by_name = {image.name: image for image in model.images.values()}
    for view in views:
        for eye, camera in view.cameras.items():
            image = by_name[f"{view.stem(eye)}.png"]
            rotation, translation = cv2.Rodrigues(camera.cam_from_world[:3, :3])[0], camera.cam_from_world[:3, 3]
            expected_px, _ = cv2.projectPoints(known_points_m, rotation, translation, camera.K, camera.distortion)
            colmap_px = np.array([image.project_point(point) for point in known_points_m])
            assert np.abs(colmap_px - (expected_px[:, 0] + 0.5)).max() < 1e-6
            calibrated_K = image.camera.calibration_matrix() - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
            assert np.abs(calibrated_K - camera.K).max() < 1e-12
            assert np.abs(image.cam_from_world().matrix() - camera.cam_from_world[:3]).max() < 1e-12


def test_colmap_extracts_features_only_inside_mask(exported: Path, tmp_path: Path) -> None:
    name = sorted(path.name for path in (exported / "lattice/images").iterdir())[0]
    reader = pycolmap.ImageReaderOptions()
    reader.mask_path = exported / "lattice/masks"
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    options = {"image_names": [name], "reader_options": reader, "device": pycolmap.Device.cpu}
    pycolmap.extract_features(tmp_path / "features.db", exported / "lattice/images", **options)
    with pycolmap.Database.open(tmp_path / "features.db") as database:
        column, row = database.read_keypoints(1)[:, :2].astype(int).T
    with Image.open(exported / "lattice/masks" / name) as mask:
        assert len(row) > 10
        assert (np.asarray(mask)[row, column] == 255).all()


QUATERNION_PART = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-9]), st.floats(-1.0, 1.0))


@given(st.tuples(*[QUATERNION_PART] * 4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternion_represents_same_rotation_as_matrix(q: tuple[float, ...]) -> None:
    matrix = Rotation.from_quat(q).as_matrix()
    w, x, y, z = quaternion_wxyz(matrix)
    assert w >= 0
    assert Rotation.from_quat([x, y, z, w]).as_matrix() == pytest.approx(matrix, abs=1e-14)


def nerfstudio_points_m(meta: dict[str, Any], frame: dict[str, Any], depth_m: np.ndarray) -> np.ndarray:
    """Return world points of planar depth by nerfstudio's convention: pixel + 0.5, y up, view along -z."""
    height, width = depth_m.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    intrinsics = {**meta, **frame}
    across = (x - intrinsics["cx"]) / intrinsics["fl_x"]
    up = -(y - intrinsics["cy"]) / intrinsics["fl_y"]
    directions = np.stack([across, up, -np.ones_like(across)], axis=-1)
    world_from_cam = np.array(frame["transform_matrix"])
    return np.asarray((directions * depth_m[..., None]) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3])


def test_depth_with_nerfstudio_cameras_is_on_board_plane(exported: Path, rows: Rows) -> None:
    folder, board = exported / "lattice", BoardSpec(markers=6)
    meta = json.loads((folder / "transforms.json").read_text())
    assert meta["camera_model"] == "OPENCV"
    assert len(meta["frames"]) == 2 * len(rows)
    for frame in meta["frames"]:
        assert (folder / frame["file_path"]).is_file()
        assert (folder / frame["mask_path"]).is_file()
        number, eye = Path(frame["file_path"]).stem.split("_")
        row = rows[number]
        points_m = nerfstudio_points_m(meta, frame, row[f"{eye}_depth"].astype(np.float64))
        inner_m = np.array([board.width_m, board.height_m]) / 2 - 0.001  # excluding the sides of the sheet
        within = (np.abs(points_m[..., :2]) < inner_m).all(axis=-1)
        on_board = within & ~row[f"{eye}_mask"] & (row[f"{eye}_depth"] > 0)
        assert on_board.sum() > 100
        assert np.abs(points_m[on_board][:, 2]).max() < 1e-6
        depth_mm = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        points_of_mm_depth_m = nerfstudio_points_m(meta, frame, depth_mm * meta["depth_unit_scale_factor"])
        assert np.abs(points_of_mm_depth_m[on_board][:, 2]).max() < 0.001


def test_nerfstudio_intrinsics_are_per_frame_if_different() -> None:
    views = zed_views()
    meta = json.loads(transforms_json(views))
    assert not {"fl_x", "k1", "w"} & set(meta)
    images = [(view, eye) for view in views for eye in CAMERA_NAMES]
    for frame, (view, eye) in zip(meta["frames"], images, strict=True):
        camera = view.cameras[eye]
        assert frame["file_path"] == f"images/{view.stem(eye)}.png"
        assert [frame[k] for k in ("k1", "k2", "p1", "p2", "k3")] == camera.distortion.tolist()
        assert (frame["cx"], frame["cy"]) == (camera.K[0, 2] + 0.5, camera.K[1, 2] + 0.5)
        assert (frame["fl_x"], frame["w"], frame["h"]) == (camera.K[0, 0], 1280, 720)
        world_from_cam = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        assert world_from_cam == pytest.approx(inverse_rigid(camera.cam_from_world), abs=1e-12)
