"""Cameras of a capture from ``cameras.toml`` and from calibrations of other programs, and what is refused."""

from __future__ import annotations

import re
import time
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")

import numpy as np
from PIL import Image

from rebar_depth_bench.base.errors import CalibrationError, InputError
from rebar_depth_bench.captures.calibration import MonoCalibration, StereoCalibration
from rebar_depth_bench.captures.camera_files import read_cameras
from rebar_depth_bench.captures.views import ImageViews, is_capture, open_capture
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import inverse_rigid
from tests.bench.captures import calibration_files as files
from tests.bench.captures.example_capture import write_images

POSES = """
[[pose]]
image = "0001"
cam_from_world = [[1, 0, 0, 0.1], [0, 0, -1, 0.2], [0, 1, 0, 0.5], [0, 0, 0, 1]]
[[pose]]
image = "0002"
cam_from_world = [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
"""
BOARD = '[board]\nmarkers = 12\nmarker_side_m = 0.03\ndictionary = "DICT_4X4_50"\n'


def stereo(root: Path, text: str) -> ImageViews:
    write_images(root, "left", "right")
    (root / "cameras.toml").write_text(text)
    return open_capture(root)


def test_pair_with_board_and_poses(tmp_path: Path) -> None:
    views = stereo(tmp_path / "site", files.TOML + BOARD + POSES)
    assert views.view_ids == ("site/0001", "site/0002")
    assert views.board == BoardSpec(markers=12, marker_side_m=0.03)
    assert not views.board_is_assumed
    assert views.has_poses
    row = next(views.rows("left_rgb", "right_cam_from_world", "left_cam_from_world", "baseline_m", "left_K"))
    assert row["view_id"] == "site/0001"
    assert np.array_equal(row["left_rgb"], np.asarray(Image.open(tmp_path / "site" / "left" / "0001.png")))
    assert np.array_equal(row["left_K"], files.LEFT_K)
    right_from_left = row["right_cam_from_world"] @ inverse_rigid(row["left_cam_from_world"])
    assert np.allclose(right_from_left[:3, :3], files.ROTATION, atol=1e-12)
    assert np.allclose(right_from_left[:3, 3], files.TRANSLATION_M, atol=1e-12)
    assert row["baseline_m"] == pytest.approx(np.linalg.norm(files.TRANSLATION_M))


def test_without_poses_the_world_is_the_left_camera(tmp_path: Path) -> None:
    views = stereo(tmp_path / "site", files.TOML)
    assert not views.has_poses
    assert views.board == BoardSpec()
    assert views.board_is_assumed
    for row in views.rows("left_cam_from_world"):
        assert np.array_equal(row["left_cam_from_world"], np.eye(4))


@pytest.mark.parametrize("folder", ["", "left"])
def test_images_of_one_camera(folder: str, tmp_path: Path) -> None:
    root = tmp_path / "mono"
    write_images(root, folder)
    camera = files.TOML.partition("[right]")[0]
    (root / "cameras.toml").write_text(camera + POSES)
    views = open_capture(root)
    assert views.view_ids == ("mono/0001", "mono/0002")
    assert set(views.columns) == {"left_rgb", "left_K", "left_distortion", "left_cam_from_world"}
    assert views.rectify
    with pytest.raises(InputError, match="sgbm needs right_rgb, but these images have only left_rgb"):
        views.check_columns(("left_rgb", "right_rgb"), "sgbm")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (files.TOML.replace("534.07", "0"), ("invalid", "left.fx")),
        (files.TOML.replace("341.53", "641"), ("invalid", "left.cx")),
        (files.TOML + "[camera]\n", ("unknown", "camera")),
        ('calibration = "a.yml"\n' + files.TOML, ("conflict", "calibration")),
        ('calibration = "../a.yml"\n', ("invalid", "calibration")),
        ('calibration = ["a.yml", "b.yml", "c.yml"]\n', ("invalid", "calibration")),
        ('unit = "inch"\n' + files.TOML, ("invalid", "unit")),
        (files.TOML + "[board]\nmarkers = 7\n", ("invalid", "board.markers")),
        (files.TOML + "[board]\nmarker_side_m = 0.5\n", ("conflict", "board")),
        (files.TOML + POSES.replace("0002", "0001"), ("duplicate", "pose")),
        (files.TOML + POSES.replace("0002", "0003"), ("missing", "pose")),
        (files.TOML + POSES.replace("[0, 1, 0, 0]", "[0, 2, 0, 0]"), ("invalid", "pose 2: cam_from_world")),
        (files.TOML + POSES.replace("[0, 0, 0, 1]", "[0, 0, 0]"), ("invalid", "pose 1: cam_from_world 4")),
        (files.TOML.replace("[stereo]", "[pair]"), ("unknown", "pair")),
        ("[left]\nK = 3\n[right", ("syntax", "")),
    ],
)
def test_invalid_table_is_refused(text: str, expected: tuple[str, str], tmp_path: Path) -> None:
    with pytest.raises(CalibrationError) as caught:
        stereo(tmp_path / "site", text)
    assert "cameras.toml" in str(caught.value)
    problem = caught.value.problems[0]
    assert (problem.code, problem.where) == expected


def test_intrinsics_of_images_of_another_shape_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "site"
    write_images(root, "left", "right", size=(640, 360))
    (root / "cameras.toml").write_text(files.TOML)
    with pytest.raises(CalibrationError, match=r"cameras\.toml") as caught:
        open_capture(root)
    assert [problem.code for problem in caught.value.problems] == ["conflict"]


def test_absent_and_several_calibrations_are_refused_and_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"absent\.yml"):
        stereo(tmp_path, 'calibration = "absent.yml"\n')
    (tmp_path / "cameras.toml").unlink()
    for suffix in ("yml", "xml", "json"):
        files.write_opencv(tmp_path, suffix)
    with pytest.raises(InputError, match=r"stereo\.json, stereo\.xml, stereo\.yml"):
        open_capture(tmp_path)


def read(folder: Path, width: int = files.WIDTH, height: int = files.HEIGHT, *, is_stereo: bool = True) -> Any:
    return read_cameras(folder, ["a"], width, height, is_stereo=is_stereo).calibration


def flat(calibration: StereoCalibration) -> np.ndarray:
    lenses = [astuple(lens) for lens in (calibration.left, calibration.right)]
    numbers = [number for lens in lenses for item in lens for number in np.ravel(item)]
    size = (calibration.width, calibration.height)
    return np.array([*size, *numbers, *calibration.rotation_rad, *calibration.translation_m])


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
def test_opencv_file_is_read(suffix: str, tmp_path: Path) -> None:
    files.write_opencv(tmp_path, suffix)
    assert np.allclose(flat(read(tmp_path)), flat(files.expected_calibration(tmp_path)), rtol=0, atol=1e-12)


def test_rounded_rotation_is_read_as_the_nearest_rotation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "ROTATION", files.ROTATION.round(5))
    files.write_opencv(tmp_path, "yml")
    assert np.allclose(read(tmp_path).rotation_rad, files.ROTATION_RAD, rtol=0, atol=1e-5)


def test_two_files_of_the_opencv_sample_are_read_with_the_unit_of_their_squares(tmp_path: Path) -> None:
    files.write_opencv_sample(tmp_path)
    (tmp_path / "cameras.toml").write_text('calibration = ["intrinsics.yml", "extrinsics.yml"]\nunit = "cm"\n')
    expected = files.expected_calibration(tmp_path)
    x_m, y_m, z_m = expected.translation_m
    in_squares = (x_m * 0.4, y_m * 0.4, z_m * 0.4)  # 1 cm is 0.4 squares.
    assert np.allclose(flat(read(tmp_path)), flat(replace(expected, translation_m=in_squares)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("as_message", [False, True])
def test_ros_camera_info_is_read(as_message: bool, tmp_path: Path) -> None:
    for name, text in files.ros_texts(as_message=as_message).items():
        (tmp_path / name).write_text(text)
    assert np.allclose(flat(read(tmp_path)), flat(files.expected_calibration(tmp_path)), rtol=0, atol=1e-7)


def test_calibration_is_scaled_to_the_images(tmp_path: Path) -> None:
    files.write_opencv(tmp_path, "yml")
    with pytest.raises(CalibrationError, match=r"fx is 0\.\d+ times fy|cx"):  # The file does not state its size.
        read(tmp_path, 320, 240)
    (tmp_path / "stereo.yml").unlink()
    for name, text in files.ros_texts(as_message=False).items():
        (tmp_path / name).write_text(text)
    half = files.expected_calibration(tmp_path, 320, 240)
    assert np.allclose(flat(read(tmp_path, 320, 240)), flat(half), rtol=0, atol=1e-7)


def test_one_ros_camera_serves_images_of_one_camera_only(tmp_path: Path) -> None:
    (tmp_path / "ost.yaml").write_text(files.ros_texts(as_message=False)["left.yaml"])
    calibration = read(tmp_path, is_stereo=False)
    assert isinstance(calibration, MonoCalibration)
    assert calibration.left == files.expected_calibration(tmp_path).left
    with pytest.raises(CalibrationError) as caught:
        read(tmp_path)
    assert [problem.code for problem in caught.value.problems] == ["missing"]


def write_all(folder: Path, name: str) -> None:
    """Write the files of the program whose file is called ``name``."""
    if name == "stereo.yml":
        files.write_opencv(folder, "yml")
        return
    for file, text in files.ros_texts(as_message=False).items():
        (folder / file).write_text(text)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert re.search(old, text)
    path.write_text(re.sub(old, new, text, count=1))


@pytest.mark.parametrize(
    ("name", "old", "new", "key"),
    [
        ("right.yaml", r"326\.61", "900", "camera_matrix"),
        ("left.yaml", "image_width: 640", "image_width: 640.5", "camera_matrix"),
        ("right.yaml", "image_width: 640", "image_width: 1280", "image_size"),
        ("right.yaml", r"data: \[(\S+), 0\.0+, (\S+), -", r"data: [\1, 0.0, \2, ", "projection_matrix"),
        ("right.yaml", "camera_matrix", "camera", "camera_matrix"),
        ("stereo.yml", r"534\.07\d*", ".Nan", "M1"),
        ("stereo.yml", "T: ", "X: ", "T"),
    ],
)
def test_invalid_file_is_refused(name: str, old: str, new: str, key: str, tmp_path: Path) -> None:
    write_all(tmp_path, name)
    edit(tmp_path / name, old, new)
    with pytest.raises(CalibrationError) as caught:
        read(tmp_path)
    assert caught.value.problems[0].where == f"{name}: {key}"


def test_two_files_with_different_values_of_a_key_are_refused(tmp_path: Path) -> None:
    for name, focal in (("a.yml", 500), ("b.yml", 501)):
        matrix = [focal, 0, 320, 0, focal, 240, 0, 0, 1]
        (tmp_path / name).write_text(f"%YAML:1.0\n---\ncamera_matrix: {matrix}\n")
    with pytest.raises(CalibrationError) as caught:
        read(tmp_path, is_stereo=False)
    [problem] = caught.value.problems
    assert (problem.code, problem.where) == ("duplicate", "b.yml: camera_matrix")


LAUGHS = "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"
HOSTILE = {
    "aliases.yaml": LAUGHS,
    "python.yaml": "M1: !!python/object/apply:os.system ['true']\n",
    "nested.yaml": "M1: " + "[" * 5000 + "]" * 5000,
    "tabs.yaml": "M1:\t[1\n",
    "list.yaml": "- 1\n- 2\n",
    "empty.yaml": "",
    "huge.yaml": f"M1: [{'9' * 5000}, 0, 1, 0, 1, 1, 0, 0, 1]\nD1: [0, 0, 0, 0]\n",
    "anchor.xml": '<!DOCTYPE x [<!ENTITY a "b">]><opencv_storage><M1>&a;</M1></opencv_storage>',
    "file.xml": '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><opencv_storage><M1>&a;</M1></opencv_storage>',
    "open.xml": "<opencv_storage><M1>",
    "comments.xml": "<opencv_storage>" + "<!--" * 250_000,
    "other.xml": "<svg/>",
    "huge.xml": "<opencv_storage>"
    + "".join(f"<{name}>500 0 320 0 500 240 0 0 1</{name}>" for name in ("M1", "M2"))
    + "<R>1e300 0 0 0 1 0 0 0 1</R><T>-0.1 0 0</T></opencv_storage>",
    "nested.xml": "<opencv_storage>" + "<a>" * 100_000 + "</a>" * 100_000 + "</opencv_storage>",
    "twice.json": '{"M1": 1, "M1": 2}',
    "nan.json": '{"M1": NaN}',
    "nested.json": "[" * 100_000,
    "binary.yml": "\udcff\udcfe\0",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_file_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(HOSTILE[name].encode(errors="surrogateescape"))
    start = time.process_time()
    with pytest.raises(CalibrationError) as caught:
        read(tmp_path, is_stereo=False)
    assert time.process_time() - start < 10  # 1 s; a time that grows with the square of the size is minutes.
    assert caught.value.problems
    assert name in str(caught.value)
    assert len(str(caught.value)) < 5000


KALIBR = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.29, 0.1, 0.001, -0.0003]
  distortion_model: radtan
  intrinsics: [534.07, 534.11, 341.53, 232.94]
  resolution: [640, 480]
"""
UNREAD = {"chain.yaml": KALIBR, "calib.txt": "cam0=[534 0 341; 0 534 232; 0 0 1]\n", "readme.md": ""}


@pytest.mark.parametrize("name", UNREAD)
@pytest.mark.parametrize("cameras", ["", 'calibration = "{}"\n'])
def test_other_files_are_refused_with_a_table_that_can_be_read(name: str, cameras: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(UNREAD[name])
    if cameras:
        (tmp_path / "cameras.toml").write_text(cameras.format(name))
    with pytest.raises(InputError, match=r"Stereolabs.*FileStorage or ROS camera_info") as caught:
        read(tmp_path)
    table = tmp_path / "calibration.toml"
    table.write_text(str(caught.value).partition("calibration.toml:\n")[2])
    (tmp_path / "cameras.toml").write_text('calibration = "calibration.toml"\n')
    calibration = read(tmp_path, 1280, 720)
    assert (calibration.left.fx, calibration.right.cx, calibration.baseline_m) == (701.88, 633.5, 0.12)
    one_camera = tmp_path / "one"
    one_camera.mkdir()
    (one_camera / "calibration.toml").write_text(table.read_text().partition("[right]")[0])
    assert read(one_camera, 1280, 720, is_stereo=False).left == calibration.left
    with pytest.raises(CalibrationError, match="right: missing"):
        read(one_camera, 1280, 720)


def test_images_beside_another_calibration_are_a_capture(tmp_path: Path) -> None:
    write_images(tmp_path, "")
    (tmp_path / "calib.txt").write_text(UNREAD["calib.txt"])
    assert is_capture(tmp_path)
    with pytest.raises(InputError, match="the calibration files are none, expected"):
        open_capture(tmp_path)


def test_two_files_of_which_one_is_not_read_are_refused(tmp_path: Path) -> None:
    files.write_opencv(tmp_path, "yml")
    (tmp_path / "right.conf").write_text("")
    (tmp_path / "cameras.toml").write_text('calibration = ["stereo.yml", "right.conf"]\n')
    with pytest.raises(CalibrationError, match=r"right\.conf: the file suffix is '\.conf', expected"):
        read(tmp_path)
