"""``[cameras] views`` of a layout: BOP's ``scene_camera.json`` and nerfstudio's ``transforms.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.export import export
from dataset_builder.importing.config_import import Import, plan_import, run_import
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.cameras import look_at
from tests.builder.importing import source_data as data

WIDTH, HEIGHT = 32, 24
POSES = (look_at(np.array([0.3, -1.2, 0.4]), np.zeros(3)), look_at(np.array([-0.5, -0.9, 0.7]), np.zeros(3)))
UNITS = (500 + np.arange(WIDTH * HEIGHT) % 200).reshape(HEIGHT, WIDTH).astype(np.uint16)
"""Depth maps before scaling: 500, 501, ... in the first row."""
GL = np.diag([1.0, -1.0, -1.0, 1.0])
Document = dict[str, Any]


def write_layout(
    folder: Path,
    document: object,
    names: Sequence[str] = ("000000", "000001"),
    *,
    files: Mapping[str, str] = {},
    tables: str = "",
    units: np.ndarray = UNITS,
) -> Path:
    """Write depth maps and colour of the views, the file of cameras, and a layout; return the layout."""
    patterns = {"left_depth": "depth/{view}.png", "left_rgb": "rgb/{view}.png", **files}
    for name in names:
        data.write(folder / patterns["left_depth"].replace("{view}", name), data.png(units))
        rgb = data.png(np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        data.write(folder / patterns["left_rgb"].replace("{view}", name), rgb)
    (folder / "views.json").write_text(document if isinstance(document, str) else json.dumps(document))
    lines = "".join(f'{key} = "{pattern}"\n' for key, pattern in patterns.items())
    path = folder / "layout.toml"
    path.write_text(f'truth_sigma_m = 0.001\n[files]\n{lines}[cameras]\nviews = "views.json"\n{tables}')
    return path


def planned(layout: Path) -> Import:
    return plan_import(layout, "mock-up")


def bop_entry(pose: np.ndarray | None = None, fx: float = 40.0, scale: float | None = 0.1) -> Document:
    """Return an entry as ``_BopWriterUtility.get_frame_camera`` of BlenderProc writes it: K as Python lists, the
    rotation through a quaternion of float32, the translation in millimetres."""
    entry: Document = {"cam_K": [fx, 0.0, 15.5, 0.0, fx, 11.5, 0.0, 0.0, 1.0], "depth_scale": scale}
    if pose is not None:
        entry["cam_R_w2c"] = pose[:3, :3].astype(np.float32).ravel().tolist()
        entry["cam_t_w2c"] = (1000 * pose[:3, 3]).tolist()
    return {key: value for key, value in entry.items() if value is not None}


def frame(path: str, pose: np.ndarray = POSES[0], **keys: Any) -> Document:
    """Return a frame of ``transforms.json``: camera to world, the camera's y up and z backwards."""
    return {"file_path": path, "transform_matrix": (np.linalg.inv(pose) @ GL).tolist(), **keys}


def nerfstudio(**keys: Any) -> Document:
    """Return a file as ``colmap_to_json`` of nerfstudio writes it, with keys added or, if None, removed."""
    whole = {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "fl_y": 41.0, "cx": 16.0, "cy": 12.5, "camera_model": "OPENCV"}
    lens = {"k1": -0.05, "k2": 0.01, "p1": 0.001, "p2": -0.002}
    frames = [frame(f"./images/00000{n}.png", pose, colmap_im_id=n + 1) for n, pose in enumerate(POSES)]
    document = {**whole, **lens, "frames": frames, "ply_file_path": "sparse_pc.ply", **keys}
    return {key: value for key, value in document.items() if value is not None}


@pytest.mark.slow
def test_output_of_blenderproc_is_imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """BlenderProc, ``write_bop``: ``rgb/000000.png``, ``depth/000000.png`` and one line for each image id."""
    entries = {0: bop_entry(POSES[0]), 1: bop_entry(POSES[1], fx=44.0, scale=1.0), 2: bop_entry(POSES[0])}
    lines = [f'  "{key}": {json.dumps(entry, sort_keys=True)}' for key, entry in entries.items()]
    layout = write_layout(tmp_path / "train_pbr", "{\n" + ",\n".join(lines) + "\n}")
    assert main(["import", str(layout), "--out", str(tmp_path / "out"), "--config", "mock-up"]) == 0
    assert "views.json: 1 of 3 entries are those of no view" in capsys.readouterr().err
    rows = list(rdb.load(tmp_path / "out", "mock-up"))
    for row, pose, fx, unit_mm in zip(rows, POSES, (40, 44), (0.1, 1.0), strict=True):
        assert row["left_depth"] == pytest.approx(UNITS * unit_mm / 1000, rel=1e-6)
        assert row["left_K"].tolist() == [[fx, 0, 15.5], [0, fx, 11.5], [0, 0, 1]]
        assert row["left_cam_from_world"] == pytest.approx(pose, abs=1e-6)
        assert not row["left_distortion"].any()
    assert open_folder(tmp_path / "out").config("mock-up").imported.has_poses  # type: ignore[union-attr]


def test_bop_without_poses_converts_range_by_the_camera_of_each_view(tmp_path: Path) -> None:
    """bop_toolkit, ``docs/bop_datasets_format.md``: poses and ``view_level`` are optional. Keys may have zeros."""
    document = {
        "000012": {**bop_entry(), "view_level": 2},
        "3": {**bop_entry(fx=20.0, scale=1.0), "elevation": 10},
    }
    source = planned(write_layout(tmp_path, document, ("12", "0003"), tables="[depth]\nkind = 'range'\n"))
    assert not source.views.has_poses
    for name, fx, unit_mm in (("12", 40.0, 0.1), ("0003", 20.0, 1.0)):
        columns = source.views.decode(name)
        ray = math.sqrt(1 + (15.5 / fx) ** 2 + (11.5 / fx) ** 2)  # Of the pixel (0, 0), whose centre is (0, 0).
        assert columns["left_depth"][0, 0] == pytest.approx(500 * unit_mm / 1000 / ray, rel=1e-6)
        assert np.array_equal(columns["left_cam_from_world"], np.eye(4))


def test_unit_of_the_layout_is_used_if_the_file_states_none(tmp_path: Path) -> None:
    document = {"0": bop_entry(scale=None), "1": bop_entry(scale=None)}
    columns = planned(write_layout(tmp_path, document, tables="[depth]\nunit = 'cm'\n")).views.decode("000000")
    assert columns["left_depth"][0, 1] == pytest.approx(5.01)


def test_output_of_ns_process_data_is_read(tmp_path: Path) -> None:
    """nerfstudio, ``colmap_to_json``: OpenCV's lens, and a pose in the world that ``applied_transform`` moved."""
    document = nerfstudio(applied_transform=[[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [-0.0, -0.0, -1.0, -0.0]])
    source = planned(write_layout(tmp_path, document, tables="[depth]\nunit = 'mm'\n"))
    assert source.views.notes == ()
    for name, pose in zip(source.views.names, POSES, strict=True):
        columns = source.views.decode(name)
        assert columns["left_K"].tolist() == [[40, 0, 15.5], [0, 41, 12.0], [0, 0, 1]]
        assert columns["left_distortion"].tolist() == [-0.05, 0.01, 0.001, -0.002, 0]
        assert columns["left_cam_from_world"] == pytest.approx(pose, abs=1e-12)
        assert columns["left_depth"][0, 0] == np.float32(0.5)


def test_synthetic_scene_of_nerf_is_read(tmp_path: Path) -> None:
    """NeRF's ``transforms_train.json``: field of view, paths without a suffix, K by the size of the images."""
    angle = 0.6911112070083618
    frames = [{**frame(f"./train/r_{n}", pose), "rotation": 0.0126} for n, pose in enumerate(POSES)]
    files = {"left_depth": "train/{view}_depth_0001.png", "left_rgb": "train/{view}.png"}
    layout = write_layout(tmp_path, {"camera_angle_x": angle, "frames": frames}, ("r_0", "r_1"), files=files)
    columns = planned(layout).views.decode("r_1")
    fx = 0.5 * WIDTH / math.tan(0.5 * angle)
    assert columns["left_K"] == pytest.approx(np.array([[fx, 0, 15.5], [0, fx, 11.5], [0, 0, 1]]), rel=1e-12)
    assert columns["left_cam_from_world"] == pytest.approx(POSES[1], abs=1e-12)


BLENDER_NERF = {
    "camera_angle_x": 2 * math.atan(16 / 40),
    "camera_angle_y": 0.4710899591445923,  # That of the sensor, whose aspect ratio is another one.
    "fl_x": 40.0,
    "fl_y": 40.0,
    **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
    "cx": 16.0,
    "cy": 12.0,
    "w": 32.0,
    "h": 24.0,
    "aabb_scale": 4,
}
"""Head of a file of BlenderNeRF, ``get_camera_intrinsics``."""


@pytest.mark.parametrize(
    ("document", "fy"),
    [
        ({**BLENDER_NERF, "frames": [frame("images_train/0001.png", POSES[0].astype(np.float32))]}, 40),
        # instant-ngp, ``colmap2nerf.py``, and its ``nerf_loader.cu``: separators of Windows, fl_y is that of x.
        ({"fl_x": 40.0, "cx": 16, "cy": 12, "frames": [frame(".\\images\\0001.jpg", sharpness=9.5)]}, 40),
        # The intrinsics of each frame: nerfstudio's dataparser, and Polycam's and Record3D's files.
        ({"frames": [frame("a/0001.png", fl_x=40.0, fl_y=41.0, cx=16.0, cy=12.0, w=32, h=24)]}, 41),
        (
            {"camera_angle_y": 2 * math.atan(12 / 41), "fl_x": 40, "cx": 16, "cy": 12, "frames": [frame("0001")]},
            41,
        ),
    ],
)
def test_intrinsics_of_other_writers_are_read(document: Document, fy: float, tmp_path: Path) -> None:
    columns = planned(write_layout(tmp_path, document, ("0001",))).views.decode("0001")
    assert columns["left_K"] == pytest.approx(np.array([[40, 0, 15.5], [0, fy, 11.5], [0, 0, 1]]), rel=1e-12)
    assert columns["left_cam_from_world"] == pytest.approx(POSES[0], abs=1e-6)


def test_poses_that_were_scaled_are_in_metres(tmp_path: Path) -> None:
    """nerfstudio, ``nerfstudio_dataparser``: ``applied_scale`` multiplied the positions of the cameras."""
    frames = []
    for n, pose in enumerate(POSES):
        world_from_cam = np.linalg.inv(pose) @ GL
        world_from_cam[:3, 3] *= 0.25
        frames.append({"file_path": f"00000{n}.png", "transform_matrix": world_from_cam[:3].tolist()})
    source = planned(write_layout(tmp_path, nerfstudio(frames=frames, applied_scale=0.25)))
    assert source.views.decode("000001")["left_cam_from_world"] == pytest.approx(POSES[1], abs=1e-12)


@pytest.mark.parametrize(
    ("stated", "unit_m", "noted"),
    [(None, 0.01, False), ("depth/000000.png", 0.01, False), ("depth_mm/000000.tif", 1.0, True)],
)
def test_unit_of_depth_is_that_of_the_depth_map_that_the_frame_names(
    stated: str | None, unit_m: float, noted: bool, tmp_path: Path
) -> None:
    keys: Document = {} if stated is None else {"depth_file_path": stated}
    document = nerfstudio(frames=[frame("000000.png", **keys)], depth_unit_scale_factor=0.01)
    views = planned(write_layout(tmp_path, document, ("000000",))).views
    assert views.decode("000000")["left_depth"][0, 1] == pytest.approx(501 * unit_m)
    assert ("views.json: depth_unit_scale_factor is that of other depth maps" in " ".join(views.notes)) == noted


@pytest.mark.slow
def test_export_of_a_config_is_imported_again(tiny_root: Path, tmp_path: Path) -> None:
    [part] = export(tiny_root, tmp_path / "export", ["lattice"], views=3)
    folder = tmp_path / "export" / "lattice"
    names = {"left_depth": "depth/{view}_left.exr", "left_rgb": "images/{view}_left.png"}
    names |= {"left_mask": "masks/{view}_left.png", "left_bars": "bars/{view}_left.png"}
    lines = "".join(f'{key} = "{pattern}"\n' for key, pattern in names.items())
    layout = folder / "layout.toml"
    layout.write_text(f'truth_sigma_m = 0.001\n[files]\n{lines}[cameras]\nviews = "transforms.json"\n')
    source = planned(layout)
    run_import(source, tmp_path / "out")
    expected = {row["view_id"]: row for row in rdb.load(tiny_root, "lattice")}
    rows = list(rdb.load(tmp_path / "out", "mock-up"))
    assert len(rows) == part.views == 3
    for row, name in zip(rows, source.views.names, strict=True):
        original = expected[f"lattice/{name}"]
        for column in ("left_depth", "left_rgb", "left_mask", "left_bars"):
            assert np.array_equal(row[column], original[column]), column
        for column in ("left_K", "left_distortion", "left_cam_from_world"):
            assert np.allclose(row[column], original[column], rtol=0, atol=1e-12), column
    rounded = layout.read_text().replace("depth/{view}_left.exr", "depth_mm/{view}_left.png")
    layout.write_text(rounded)
    depth_m = planned(layout).views.decode(source.views.names[0])["left_depth"]
    assert np.abs(depth_m - rows[0]["left_depth"]).max() <= 0.00051


def test_other_cameras_are_other_data(tmp_path: Path) -> None:
    document = {"0": bop_entry(), "1": bop_entry()}
    run_import(planned(write_layout(tmp_path, document)), tmp_path / "out")
    document["1"] = bop_entry(scale=0.2)
    layout = write_layout(tmp_path, document)
    with pytest.raises(InputError, match="other data"):
        run_import(planned(layout), tmp_path / "out")
    run_import(planned(layout), tmp_path / "out", overwrite=["mock-up"])
    assert rdb.load(tmp_path / "out", "mock-up")[1]["left_depth"][0, 0] == pytest.approx(0.1)


def test_unknown_fields_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    layout = write_layout(tmp_path, nerfstudio(shutter_speed=3, frames=[frame("000000", iso=100)]), ("000000",))
    assert main(["import", str(layout), "--out", str(tmp_path / "o"), "--config", "mock-up", "--dry-run"]) == 0
    errors = " ".join(capsys.readouterr().err.split())
    assert "views.json: fields without a known meaning are left out: shutter_speed, iso" in errors
