"""Fields that change the geometry: regions, binning, rectified pictures, and notes of what is left out.

Files are as written by ``rostopic echo`` (ROS 1), ``ros2 topic echo`` (ROS 2), camera_calibration (YAML), OpenCV's
samples ``calibration`` and ``stereo_calib`` and its tutorial ``camera_calibration.cpp`` (FileStorage).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
import yaml

from rebar_depth_bench.base.errors import CalibrationError
from rebar_depth_bench.captures.calibration import Calibration, MonoCalibration, StereoCalibration
from rebar_depth_bench.captures.camera_files import read_cameras
from tests.bench.captures import calibration_files as files

K = [405.0, 0.0, 633.2, 0.0, 405.0, 377.5, 0.0, 0.0, 1.0]
D = [-0.02, 0.03, 0.0, 0.0, 0.0]
IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
LOWER = {"D": "d", "K": "k", "R": "r", "P": "p"}


def projection(fx: float, cx: float, cy: float, x: float = 0.0) -> list[float]:
    return [fx, 0.0, cx, x, 0.0, fx, cy, 0.0, 0.0, 0.0, 1.0, 0.0]


def message(changes: dict[str, Any] | None = None, *, ros2: bool = False, **others: Any) -> str:
    """Return a printed ``sensor_msgs/CameraInfo``, with the field names of ROS 1 or of ROS 2."""
    fields = {"height": 800, "width": 1280, "distortion_model": "plumb_bob", "D": D, "K": K, "R": IDENTITY}
    fields |= (
        {"P": projection(405.0, 633.2, 377.5), "binning_x": 0, "binning_y": 0, "roi": region()}
        | others
        | (changes or {})
    )
    named = {LOWER.get(key, key) if ros2 else key: value for key, value in fields.items() if value is not None}
    header = {"header": {"seq": 3, "stamp": {"secs": 1, "nsecs": 2}, "frame_id": "left_optical"}}
    return f"{yaml.safe_dump(header | named, sort_keys=False)}---\n"


def region(x: int = 0, y: int = 0, width: int = 0, height: int = 0, *, do_rectify: bool = False) -> dict[str, Any]:
    return {"x_offset": x, "y_offset": y, "height": height, "width": width, "do_rectify": do_rectify}


def mono(folder: Path, text: str, width: int, height: int, cameras: str = "") -> Calibration:
    (folder / "info.yaml").write_text(text)
    if cameras:
        (folder / "cameras.toml").write_text(f'calibration = "info.yaml"\n{cameras}')
    return read_cameras(folder, ["a"], width, height, is_stereo=False).calibration


def pinhole(calibration: Calibration) -> tuple[float, ...]:
    left = calibration.left
    return left.fx, left.fy, left.cx, left.cy


WINDOW = region(320, 200, 640, 400)


@pytest.mark.parametrize("ros2", [False, True])
@pytest.mark.parametrize(
    ("changes", "size", "expected"),
    [
        ({"roi": WINDOW}, (640, 400), (405, 405, 633.2 - 320, 377.5 - 200)),
        ({"roi": WINDOW, "binning_x": 1, "binning_y": 1}, (640, 400), (405, 405, 313.2, 177.5)),
        ({"roi": region(320, 200, 640, 400, do_rectify=True)}, (640, 400), (405, 405, 313.2, 177.5)),
        # The region is cropped first, in pixels of the sensor. Pixel 0 of the pictures has its centre at 320.5.
        ({"roi": WINDOW, "binning_x": 2, "binning_y": 2}, (320, 200), (202.5, 202.5, (633.2 - 320.5) / 2, 88.5)),
        (
            {"roi": region(320, 200, 641, 401), "binning_x": 2, "binning_y": 2},
            (320, 200),
            (202.5, 202.5, 156.35, 88.5),
        ),
        ({"binning_x": 4, "binning_y": 4}, (320, 200), (101.25, 101.25, (633.2 - 1.5) / 4, (377.5 - 1.5) / 4)),
        ({"width": 1281, "binning_x": 2, "binning_y": 2}, (640, 400), (202.5, 202.5, (633.2 - 0.5) / 2, 188.5)),
        ({"roi": WINDOW}, (1280, 800), (405, 405, 633.2, 377.5)),
        ({"roi": region(0, 0, 1280, 800)}, (1280, 800), (405, 405, 633.2, 377.5)),
        ({"roi": region(0, 0, 1280, 800)}, (640, 400), (202.5, 202.5, (633.2 - 0.5) / 2, (377.5 - 0.5) / 2)),
        ({"roi": WINDOW, "P": None, "R": None}, (640, 400), (405, 405, 313.2, 177.5)),
        ({"roi": WINDOW, "width": None, "height": None}, (640, 400), (405, 405, 313.2, 177.5)),
        ({"roi": None, "binning_x": None}, (1280, 800), (405, 405, 633.2, 377.5)),
    ],
)
def test_matrix_is_that_of_the_pictures(
    changes: dict[str, Any], size: tuple[int, int], expected: tuple[float, ...], ros2: bool, tmp_path: Path
) -> None:
    calibration = mono(tmp_path, message(ros2=ros2, **changes), *size)
    assert (calibration.width, calibration.height) == size
    assert np.allclose(pinhole(calibration), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "size", "words"),
    [
        ({"roi": WINDOW, "width": 640, "height": 400}, (640, 400), "not inside width x height"),
        ({"roi": region(700, 0, 640, 400)}, (640, 400), "not inside width x height"),
        ({"roi": region(320, 200)}, (1280, 800), "not inside width x height"),
        ({"roi": WINDOW}, (320, 200), "the pictures have 320 x 200 pixels, expected 640 x 400"),
        ({"roi": WINDOW, "binning_x": 2, "binning_y": 2}, (640, 400), "expected 320 x 200"),
        ({"roi": region(-320, 200, 640, 400)}, (640, 400), "whole numbers x_offset"),
        ({"roi": "all"}, (640, 400), "whole numbers x_offset"),
        ({"roi": region(1000, 200, 200, 400)}, (200, 400), "cx: got"),
    ],
)
def test_region_that_cannot_be_that_of_the_pictures_is_refused(
    changes: dict[str, Any], size: tuple[int, int], words: str, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match=words):
        mono(tmp_path, message(**changes), *size)


def test_region_and_binning_that_do_not_apply_are_named(tmp_path: Path) -> None:
    notes = mono(tmp_path, message(roi=WINDOW, D=[0.0] * 5), 1280, 800).notes
    assert notes == ("info.yaml: the pictures show all of the sensor; roi and binning are left out",)


RECTIFIED_P = projection(380.0, 640.0, 400.0)


def test_rectified_pictures_of_one_camera_have_the_projection_matrix(tmp_path: Path) -> None:
    text = message(P=RECTIFIED_P, distortion_model="equidistant", D=[0.1, 0.2, 0.0, 0.0])
    calibration = mono(tmp_path, text, 1280, 800, "rectified = true\n")
    assert pinhole(calibration) == (380.0, 380.0, 640.0, 400.0)
    assert not any(calibration.left.distortion)
    assert not calibration.notes
    cropped = mono(tmp_path, message(P=RECTIFIED_P, roi=WINDOW), 640, 400, "rectified = true\n")
    assert pinhole(cropped) == (380.0, 380.0, 320.0, 200.0)


@pytest.mark.parametrize("cameras", ["", "rectified = false\n"])
def test_pictures_are_not_rectified_unless_that_is_stated(cameras: str, tmp_path: Path) -> None:
    calibration = mono(tmp_path, message(P=RECTIFIED_P), 1280, 800, cameras)
    assert pinhole(calibration) == (405.0, 405.0, 633.2, 377.5)
    assert calibration.left.distortion == tuple(D)
    assert [("rectified = true" in note) for note in calibration.notes] == ([] if cameras else [True])


UNDISTORTED = {"D": [0.0] * 5, "P": RECTIFIED_P}


@pytest.mark.parametrize("changes", [UNDISTORTED, UNDISTORTED | {"D": []}, UNDISTORTED | {"distortion_model": ""}])
def test_two_matrices_without_distortion_must_be_told_apart(changes: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"P: differs .* rectified = true .* or rectified = false"):
        mono(tmp_path, message(**changes), 1280, 800)
    for answer, fx in (("true", 380.0), ("false", 405.0)):
        assert mono(tmp_path, message(**changes), 1280, 800, f"rectified = {answer}\n").left.fx == fx


def test_uncalibrated_projection_says_nothing(tmp_path: Path) -> None:
    calibration = mono(tmp_path, message(P=[0.0] * 12, D=[0.0] * 5), 1280, 800)
    assert pinhole(calibration) == (405.0, 405.0, 633.2, 377.5)
    with pytest.raises(CalibrationError, match="expected the matrix P of rectified pictures"):
        mono(tmp_path, message(P=[0.0] * 12, D=[0.0] * 5), 1280, 800, "rectified = true\n")


def rectified_pair(folder: Path, names: list[str], unit: str = "m") -> StereoCalibration:
    (folder / "cameras.toml").write_text(f'calibration = {names}\nrectified = true\nunit = "{unit}"\n')
    calibration = read_cameras(folder, ["a"], files.WIDTH, files.HEIGHT, is_stereo=True).calibration
    assert isinstance(calibration, StereoCalibration)
    return calibration


def check_rectified(calibration: StereoCalibration, alpha: float) -> None:
    """Check a calibration by OpenCV's rectification of the pair, and by the baseline of the pair."""
    stereo = (files.LEFT_K, files.LEFT_D, files.RIGHT_K, files.RIGHT_D, (files.WIDTH, files.HEIGHT))
    P1 = cv2.stereoRectify(*stereo, files.ROTATION, files.TRANSLATION_M, alpha=alpha)[2]
    assert calibration.is_rectified
    assert pinhole(calibration) == pytest.approx((P1[0, 0], P1[1, 1], P1[0, 2], P1[1, 2]), abs=1e-7)
    assert calibration.translation_m == pytest.approx(
        (-float(np.linalg.norm(files.TRANSLATION_M)), 0, 0), abs=1e-9
    )


@pytest.mark.parametrize("as_message", [False, True])
def test_rectified_pair_of_ros_has_the_baseline_of_its_projections(as_message: bool, tmp_path: Path) -> None:
    for name, text in files.ros_texts(as_message=as_message).items():
        (tmp_path / name).write_text(text)
    check_rectified(rectified_pair(tmp_path, ["left.yaml", "right.yaml"]), alpha=0)


def test_rectified_pair_of_the_opencv_sample(tmp_path: Path) -> None:
    files.write_opencv_sample(tmp_path)  # Lengths are in squares of 25 mm.
    calibration = rectified_pair(tmp_path, ["intrinsics.yml", "extrinsics.yml"], "cm")
    check_rectified(replace(calibration, translation_m=(calibration.translation_m[0] * 2.5, 0, 0)), alpha=-1)


def test_pair_with_projections_is_read_as_not_rectified_with_a_note(tmp_path: Path) -> None:
    files.write_opencv_sample(tmp_path)
    calibration = read_cameras(tmp_path, ["a"], files.WIDTH, files.HEIGHT, is_stereo=True).calibration
    assert calibration.left.distortion == tuple(files.LEFT_D)
    assert len(calibration.notes) == 1
    assert "rectified = true" in calibration.notes[0]


def test_rectified_without_a_projection_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(files.TOML)
    files.write_opencv(tmp_path, "yml")
    for name in ("a.toml", "stereo.yml"):
        with pytest.raises(CalibrationError, match="rectified pictures"):
            rectified_pair(tmp_path, [name])
    (tmp_path / "cameras.toml").write_text("rectified = true\n" + files.TOML)
    with pytest.raises(CalibrationError, match="rectified: given without calibration"):
        read_cameras(tmp_path, ["a"], files.WIDTH, files.HEIGHT, is_stereo=True)


def write_storage(path: Path, values: dict[str, Any]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()


TUTORIAL: dict[str, Any] = {  # In the order of OpenCV's tutorial camera_calibration.cpp, saveCameraParams.
    "calibration_time": "Thu Nov 26 09:00:00 2026",
    "nr_of_frames": 20,
    "image_width": 640,
    "image_height": 480,
    "board_width": 9,
    "board_height": 6,
    "square_size": 50.0,
    "fix_aspect_ratio": 1.0,
    "flags": 2,
    "fisheye_model": 0,
    "camera_matrix": files.LEFT_K,
    "distortion_coefficients": files.LEFT_D[:, None],
    "avg_reprojection_error": 0.2,
    "per_view_reprojection_errors": np.full((20, 1), 0.2, np.float32),
    "extrinsic_parameters": np.zeros((20, 6)),
    "image_points": np.zeros((20, 54, 2), np.float32),
    "grid_points": np.zeros((54, 3), np.float32),
}


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_known_fields_of_opencv_are_left_without_a_note(suffix: str, tmp_path: Path) -> None:
    values = {key: value.reshape(-1, 2) if key == "image_points" else value for key, value in TUTORIAL.items()}
    write_storage(tmp_path / f"out_camera_data.{suffix}", values)
    calibration = read_cameras(tmp_path, ["a"], 640, 480, is_stereo=False).calibration
    assert isinstance(calibration, MonoCalibration)
    assert np.array_equal(calibration.left.K, files.LEFT_K)
    assert calibration.left.distortion == tuple(files.LEFT_D)
    assert calibration.notes == ()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (message(D=[0.0] * 5, exposure=3, Gain=1), "exposure, Gain"),
        (message({f"field_{at:02}": at for at in range(13)}, D=[0.0] * 5), "field_08, field_09 and 3 more"),
    ],
)
def test_unlisted_fields_are_named(text: str, named: str, tmp_path: Path) -> None:
    (note,) = mono(tmp_path, text, 1280, 800).notes
    assert note.startswith("info.yaml: fields without a known meaning are left out: ")
    assert note.endswith(named)


def test_missing_distortion_is_named(tmp_path: Path) -> None:
    notes = mono(tmp_path, yaml.safe_dump({"K": K, "distorsion": D}), 1280, 800).notes
    assert "info.yaml: no distortion is stated, taken as 0" in notes
    assert any("left out: distorsion" in note for note in notes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (yaml.safe_dump({"K": K, "camera_matrix": [*K[:2], 600.0, *K[3:]], "D": D}), "differs from that in K"),
        (yaml.safe_dump({"K": [[K[at + 3 * row] for row in range(3)] for at in range(3)], "D": D}), "are columns"),
    ],
)
def test_ambiguous_matrix_is_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=words):
        mono(tmp_path, text, 1280, 800)
