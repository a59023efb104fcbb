"""Exports as a ZED capture and as KITTI's raw data: what methods read of them is what the dataset holds."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dataset_builder.export import export
from dataset_builder.export.calibration_text import kitti_cam_to_cam, stereolabs_conf
from dataset_builder.export.kitti import kitti_depth_png
from dataset_builder.export.run import LAYOUTS
from rebar_depth_bench import load
from rebar_depth_bench.captures.folder import open_capture
from rebar_depth_bench.captures.kitti import open_kitti
from rebar_depth_bench.captures.kitti_calibration import read_pair
from rebar_depth_bench.captures.kitti_images import read_images
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.geometry.calibration import read_calibration
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration
from rebar_depth_bench.methods import Views
from rebar_depth_bench.methods.runner import dataset_views
from tests.bench.geometry.calibrations import SHIPPED_CALIBRATION

STEREO = ("left_rgb", "right_rgb", "left_K", "right_K", "left_distortion", "right_distortion", "baseline_m")
DAY = "2000_01_01"


def rows(views: Views, columns: Sequence[str]) -> list[dict[str, Any]]:
    return [{**row} for row in views.rows(*columns)]


@pytest.fixture(scope="module")
def dataset_rows(tiny_root: Path) -> list[dict[str, Any]]:
    [views] = dataset_views(open_folder(tiny_root), ["lattice"], "test")
    return rows(views, (*STEREO, "left_depth"))


@pytest.fixture(scope="module")
def zed(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(tiny_root, tmp_path_factory.mktemp("zed") / "out", ["lattice"], layout="zed").folder / "lattice"


@pytest.fixture(scope="module")
def kitti(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kitti") / "out"
    return export(tiny_root, folder, ["lattice"], layout="kitti").folder / "lattice"


def assert_same(read: Sequence[dict[str, Any]], expected: Sequence[dict[str, Any]]) -> None:
    assert len(read) == len(expected) > 0
    for one, other in zip(read, expected, strict=True):
        for name in STEREO:
            assert np.array_equal(one[name], other[name]), (one["view_id"], name)


def test_method_reads_the_same_arrays_from_a_capture(zed: Path, dataset_rows: list[dict[str, Any]]) -> None:
    read = rows(open_capture(zed), STEREO)
    assert [row["view_id"] for row in read] == [row["view_id"] for row in dataset_rows]
    assert_same(read, dataset_rows)


def test_method_reads_the_same_arrays_from_kitti(kitti: Path, dataset_rows: list[dict[str, Any]]) -> None:
    [views] = open_kitti(kitti, read_images(kitti / "images.txt"))
    read = rows(views, STEREO)
    assert [row["view_id"][-6:] for row in read] == [f"{row['view_id'][-4:]}_l" for row in dataset_rows]
    assert_same(read, dataset_rows)


def test_poses_and_board_of_a_capture_are_those_of_a_real_one(zed: Path) -> None:
    views = open_capture(zed)
    assert not views.has_poses
    assert not views.board_is_assumed


def archive_depths(path: Path) -> list[bytes]:
    with zipfile.ZipFile(path) as archive:
        return [archive.read(name) for name in sorted(archive.namelist()) if name != "submission.json"]


@pytest.mark.slow
def test_sgbm_predicts_the_same_depth_from_every_layout(
    tiny_root: Path, zed: Path, kitti: Path, tmp_path: Path
) -> None:
    inputs = {
        "dataset": [str(tiny_root), "--config", "lattice"],
        "zed": [str(zed)],
        "kitti": [str(kitti), "--images", str(kitti / "images.txt")],
    }
    depths = {}
    for name, data in inputs.items():
        archive = tmp_path / f"{name}.zip"
        assert main(["predict", "sgbm", "--data", *data, "--out", str(archive)]) == 0
        depths[name] = archive_depths(archive)
    assert depths["dataset"] == depths["zed"] == depths["kitti"]
    assert len(set(depths["dataset"])) == len(depths["dataset"]) == 9
    assert main(["score", str(tmp_path / "zed.zip"), "--data", str(tiny_root)]) == 0


def test_kitti_study_scores_an_exported_tree(
    kitti: Path, dataset_rows: list[dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    predictions = tmp_path / "exact"
    predictions.mkdir()
    for row in dataset_rows:
        name = f"{DAY}_drive_0001_sync_{int(row['view_id'][-4:]):010d}_l"
        np.save(predictions / f"{name}.npy", np.where(row["left_depth"] > 0, row["left_depth"], 1))
    command = ["study", "kitti", "--predictions", str(predictions), "--kitti", str(kitti)]
    options = ["--ground-truth", "improved", "--images", str(kitti / "images.txt"), "--crop", "none"]
    assert main([*command, *options, "--csv", "-"]) == 0
    [header, native, *_] = capsys.readouterr().out.splitlines()
    table = dict(zip(header.split(","), native.split(","), strict=True))
    abs_rel = float(table["abs_rel"])
    assert 0 < abs_rel < 0.5 / 256 / 0.2  # Half of a unit of the PNG files, at 0.2 m.


def test_kitti_depth_has_the_resolution_of_its_format() -> None:
    depth_m = np.array([[0, 0.001, 0.3, 255.99, 300]], np.float32)
    decoded = cv2.imdecode(np.frombuffer(kitti_depth_png(depth_m), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded.dtype == np.uint16
    assert decoded.tolist() == [[0, 1, 77, 65533, 0]]


FOCAL, TERM = st.floats(100, 5000), st.floats(-0.4, 0.4)
LENS = st.builds(
    Lens,
    *(FOCAL, FOCAL, st.floats(10, 300), st.floats(10, 150)),
    st.tuples(TERM, TERM, TERM, TERM, TERM),
)
ANGLES = st.tuples(*[st.floats(-0.1, 0.1)] * 3)


@given(LENS, LENS, ANGLES, st.floats(0.02, 2), st.sampled_from([(320, 180), (640, 360), (1280, 720), (333, 222)]))
def test_stated_numbers_are_read_back(
    left: Lens, right: Lens, rotation_rad: Any, baseline_m: float, size: tuple[int, int]
) -> None:
    left, right = (replace(lens, distortion=(0.0,) * 5) for lens in (left, right))
    calibration = StereoCalibration(*size, left, right, rotation_rad, (-baseline_m, 0.0, 0.0))
    rectified = replace(calibration, right=replace(left, cx=right.cx), rotation_rad=(0.0, 0.0, 0.0))
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.conf").write_text(stereolabs_conf(calibration))
        (folder / "calib_cam_to_cam.txt").write_text(kitti_cam_to_cam(rectified))
        assert_equal_or_next(read_calibration(folder / "a.conf", *size), calibration)
        assert_equal_or_next(read_pair(folder), rectified)


def assert_equal_or_next(read: StereoCalibration, expected: StereoCalibration) -> None:
    """Compare calibrations; some numbers are no result of the reader, only the next one is."""
    for lens, expected_lens in ((read.left, expected.left), (read.right, expected.right)):
        numbers, expected_numbers = ((one.fx, one.fy, one.cx, one.cy) for one in (lens, expected_lens))
        assert numbers == pytest.approx(expected_numbers, rel=1e-15)
        assert lens.distortion == expected_lens.distortion
    assert read.rotation_rad == expected.rotation_rad
    assert read.translation_m == pytest.approx(expected.translation_m, rel=1e-15)


def test_raw_calibration_is_exported_as_it_was_read(tmp_path: Path) -> None:
    for size in ((1280, 720), (640, 360), (320, 180)):
        calibration = read_calibration(SHIPPED_CALIBRATION, *size)
        (tmp_path / "a.conf").write_text(stereolabs_conf(calibration))
        assert read_calibration(tmp_path / "a.conf", *size) == calibration


@pytest.mark.parametrize("layout", ["zed", "kitti"])
def test_config_without_colour_is_refused(layout: str, tiny_root: Path) -> None:
    config = open_folder(tiny_root).config("lattice")
    LAYOUTS[layout].check(config)
    with pytest.raises(InputError, match="without colour"):
        LAYOUTS[layout].check(config.model_copy(update={"colour": None}))


def test_raw_grid_is_refused_for_kitti(tiny_root: Path) -> None:
    config = open_folder(tiny_root).config("lattice")
    assert config.scene.rig is not None
    scene = config.scene.model_copy(update={"rig": config.scene.rig.model_copy(update={"grid": "raw"})})
    raw = config.model_copy(update={"scenes": (scene,)})
    LAYOUTS["zed"].check(raw)
    with pytest.raises(InputError, match="raw grid"):
        LAYOUTS["kitti"].check(raw)


def test_export_is_resumed_in_its_own_layout_only(tiny_root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export(tiny_root, out, ["lattice-orbit"], layout="zed")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    (out / "lattice-orbit" / "left" / "0025.png").unlink()
    export(tiny_root, out, ["lattice-orbit"], layout="zed")
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    with pytest.raises(InputError):
        export(tiny_root, out, ["lattice-orbit"], layout="kitti")
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


def test_pictures_are_lossless(zed: Path, tiny_root: Path) -> None:
    for row in load(tiny_root, "lattice"):
        name = row["view_id"].partition("/")[2]
        for eye in ("left", "right"):
            assert np.array_equal(np.asarray(Image.open(zed / eye / f"{name}.png")), row[f"{eye}_rgb"])
