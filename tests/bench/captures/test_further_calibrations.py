"""Middlebury's and ETH3D's calib.txt, and files that are refused with the lines to write instead.

The files are as their writers or data sets have them, with few digits. The lines of a refusal are written into
``calibration.toml`` and read back; the expected numbers are copied by hand from the file.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench.base.errors import CalibrationError, InputError
from rebar_depth_bench.captures.calibration import Calibration
from rebar_depth_bench.captures.camera_files import read_cameras

# "Motorcycle-perfect" at a quarter of its size, in the format of vision.middlebury.edu/stereo/data/scenes2014.
MIDDLEBURY = """\
cam0=[999.421 0 294.182; 0 999.421 252.932; 0 0 1]
cam1=[999.421 0 326.96; 0 999.421 252.932; 0 0 1]
doffs=32.778
baseline=193.001
width=741
height=497
ndisp=70
isint=0
vmin=8
vmax=64
dyavg=0
dymax=0
"""
# In the format of eth3d.net/documentation, two-view data.
ETH3D = MIDDLEBURY.partition("ndisp")[0].replace("326.96", "294.182").replace("32.778", "0") + "ndisp=64\n"


def read(folder: Path, width: int, height: int, *, is_stereo: bool) -> Calibration:
    return read_cameras(folder, ["a"], width, height, is_stereo=is_stereo).calibration


@pytest.mark.parametrize(("text", "right_cx"), [(MIDDLEBURY, 326.96), (ETH3D, 294.182)])
@pytest.mark.parametrize(
    "cameras", ["", 'calibration = "calib.txt"\n', 'calibration = "calib.txt"\nrectified = true\n']
)
def test_calib_txt_is_a_rectified_pair(text: str, right_cx: float, cameras: str, tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_bytes(text.replace("\n", "\r\n").encode())
    if cameras:
        (tmp_path / "cameras.toml").write_text(cameras)
    calibration: Any = read(tmp_path, 741, 497, is_stereo=True)
    assert calibration.is_rectified
    assert calibration.left.K.tolist() == [[999.421, 0, 294.182], [0, 999.421, 252.932], [0, 0, 1]]
    assert calibration.right.cx == right_cx
    assert calibration.translation_m == (-0.193001, 0, 0)
    assert calibration.notes == ()
    # Depth of disparity d by the format's documentation: Z = baseline * f / (d + doffs), in millimetres.
    disparity = 50.0
    offset_m = calibration.right.cx - calibration.left.cx
    depth_m = calibration.left.fx * calibration.baseline_m / (disparity + offset_m)
    assert depth_m == pytest.approx(193.001 * 999.421 / (50.0 + right_cx - 294.182) / 1000)


def test_calib_txt_is_scaled_and_serves_images_of_one_camera(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(MIDDLEBURY.replace("width=741", "width=742").replace("497", "498"))
    left = read(tmp_path, 371, 249, is_stereo=False).left
    assert (left.fx, left.cx, left.cy) == (499.7105, (294.182 + 0.5) / 2 - 0.5, (252.932 + 0.5) / 2 - 0.5)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("doffs=32.778", "doffs=31.5", "doffs: got 31.5, expected cx of cam1 minus cx of cam0, 32.778"),
        ("baseline=193.001\n", "", "baseline: missing"),
        ("baseline=193.001", "baseline=0.193", "cam0: .*got .*baseline a number from 0.001 to 10 metres"),
        (
            "baseline=193.001",
            "baseline=193001",
            "got -193.001, expected .*metres; the unit .* is stated in cameras.toml",
        ),
        ("; 0 0 1]\ncam1", "]\ncam1", "cam0: got .*expected numbers of shape 3 x 3"),
        ("width=741", "width", "line 5: expected key=value"),
        ("width=741", "doffs=1", "line 5: expected key=value of a calib.txt as Middlebury's, each key once"),
        ("999.421 0 294.182", "999.421 1 294.182", "cam0: K: got"),
        (
            "326.96; 0 999.421 252.932; 0 0 1]\ndoffs=32.778\n",
            "900; 0 999.421 252.932; 0 0 1]\n",
            "cam1: cx: got 900.0",
        ),
    ],
)
def test_damaged_calib_txt_is_refused(old: str, new: str, words: str, tmp_path: Path) -> None:
    assert old in MIDDLEBURY
    (tmp_path / "calib.txt").write_text(MIDDLEBURY.replace(old, new))
    with pytest.raises(CalibrationError, match=words):
        read(tmp_path, 741, 497, is_stereo=True)


def test_unlisted_key_of_calib_txt_is_named(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text(MIDDLEBURY + "gamma=2.2\n")
    assert read(tmp_path, 741, 497, is_stereo=True).notes == (
        "calib.txt: fields without a known meaning are left out: gamma",
    )


EUROC = """\
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0.01486, -0.99988, 0.00414, -0.02164, 0.99955, 0.01496, 0.02571, -0.06467, -0.02577, 0.00375, 0.99966,
         0.00981, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
# o3d.io.write_pinhole_camera_intrinsic and Open3D's RealSense recorder: Eigen's order, column by column.
OPEN3D = """{
    "height" : 480,
    "intrinsic_matrix" :
    [
        612.5, 0.0, 0.0,
        0.0, 611.25, 0.0,
        322.5, 238.75, 1.0
    ],
    "width" : 640
}"""
SCANNET = """\
axisAlignment = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
colorHeight = 968
colorWidth = 1296
fx_color = 1170.187988
fx_depth = 571.623718
fy_color = 1170.187988
mx_color = 647.750000
my_color = 483.750000
numDepthFrames = 3
"""
INTRINSIC_COLOR = """1169.621094 0.000000 646.295044 0.000000
0.000000 1167.105103 489.927032 0.000000
0.000000 0.000000 1.000000 0.000000
0.000000 0.000000 0.000000 1.000000
"""
KITTI = """\
P0: 7.188560e+02 0.0 6.071928e+02 0.0 0.0 7.188560e+02 1.852157e+02 0.0 0.0 0.0 1.0 0.0
P1: 7.188560e+02 0.0 6.071928e+02 -3.861448e+02 0.0 7.188560e+02 1.852157e+02 0.0 0.0 0.0 1.0 0.0
P2: 7.188560e+02 0.0 6.071928e+02 4.538225e+01 0.0 7.188560e+02 1.852157e+02 -1.13e-01 0.0 0.0 1.0 3.77e-03
P3: 7.188560e+02 0.0 6.071928e+02 -3.372877e+02 0.0 7.188560e+02 1.852157e+02 2.369 0.0 0.0 1.0 4.9e-03
Tr: 4.2768e-04 -9.9997e-01 -8.0845e-03 -1.1985e-02 -7.2e-03 8.0e-03 -9.9e-01 -5.4e-02 9.9e-01 4.8e-04 -7.2e-03 0.3
"""
KITTI_RAW = "calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 1.242000e+03 3.750000e+02\n" + KITTI.replace(
    "P", "P_rect_0"
)
COLMAP = """\
# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
"""
KITTI_BASELINE_M = (45.38225 + 337.2877) / 718.856
CASES: dict[str, tuple[str, str, tuple[int, int], tuple[float, ...], list[float]]] = {
    "euroc": (
        "sensor.yaml",
        EUROC,
        (752, 480),
        (458.654, 457.296, 367.215, 248.375),
        [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    ),
    "open3d": ("intrinsic.json", OPEN3D, (640, 480), (612.5, 611.25, 322.5, 238.75), []),
    "open3d view": (
        "view.json",
        f'{{"class_name": "PinholeCameraParameters", "intrinsic": {OPEN3D}}}',
        (640, 480),
        (612.5, 611.25, 322.5, 238.75),
        [],
    ),
    "scannet scene": ("scene0000_00.txt", SCANNET, (1296, 968), (1170.187988, 1170.187988, 647.75, 483.75), []),
    "scannet matrix": (
        "intrinsic_color.txt",
        INTRINSIC_COLOR,
        (1296, 968),
        (1169.621094, 1167.105103, 646.295044, 489.927032),
        [],
    ),
    "kitti odometry": ("calib.txt", KITTI, (1241, 376), (718.856, 718.856, 607.1928, 185.2157), []),
    "kitti raw": ("calib_cam_to_cam.txt", KITTI_RAW, (1242, 375), (718.856, 718.856, 607.1928, 185.2157), []),
    "colmap opencv": (
        "cameras.txt",
        COLMAP + "1 OPENCV 640 480 500.5 501.5 320.5 240.5 -0.1 0.02 0.001 -0.002\n",
        (640, 480),
        (500.5, 501.5, 320.0, 240.0),
        [-0.1, 0.02, 0.001, -0.002],
    ),
    "colmap pinhole": (
        "cameras.txt",
        COLMAP + "1 PINHOLE 640 480 500.5 501.5 320.5 240.5\n2 PINHOLE 640 480 1 1 1 1\n",
        (640, 480),
        (500.5, 501.5, 320.0, 240.0),
        [],
    ),
    "colmap simple": (
        "cameras.txt",
        COLMAP + "1 SIMPLE_RADIAL 640 480 500.5 320.5 240.5 -0.021\n",
        (640, 480),
        (500.5, 500.5, 320.0, 240.0),
        [-0.021],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_recognised_file_is_refused_with_lines_that_can_be_read(case: str, tmp_path: Path) -> None:
    name, text, (width, height), expected, terms = CASES[case]
    (tmp_path / name).write_text(text)
    is_pair = case.startswith("kitti")
    with pytest.raises(CalibrationError) as caught:
        read(tmp_path, width, height, is_stereo=is_pair)
    (problem,) = caught.value.problems
    assert problem.where == name
    assert problem.found.startswith("is ")
    first, *lines = problem.expected.splitlines()
    assert first == "calibration.toml with these lines:"
    (tmp_path / "calibration.toml").write_text("\n".join(lines))
    calibration: Any = read(tmp_path, width, height, is_stereo=is_pair)
    left = calibration.left
    assert (left.fx, left.fy, left.cx, left.cy) == expected
    assert left.distortion == (*terms, *[0.0] * (5 - len(terms)))
    if is_pair:
        assert calibration.is_rectified
        assert calibration.baseline_m == pytest.approx(KITTI_BASELINE_M)


COLMAP_BIN = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, 500.0, 500.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("calib.json", '{"batchTime": 1, "cameraData": [[0, {"cameraType": 0}]]}', "DepthAI.*getBaselineDistance"),
        (
            "rgb.txt",
            "# color images\n# file: 'rgbd_dataset_freiburg1_xyz.bag'\n# timestamp filename\n",
            "TUM.*page",
        ),
        (
            "camera.txt",
            "0.349 0.436 0.493 0.499 0.933\n1280 1024\ncrop\n640 480\n",
            "FOV.*rectified",
        ),
        ("sensor.yaml", EUROC.replace("radial-tangential", "equidistant"), "EuRoC.*'equidistant'.*rectify"),
        ("cameras.txt", COLMAP + "1 OPENCV_FISHEYE 640 480 5 5 3 2 0.1 0 0 0\n", "'OPENCV_FISHEYE'.*rectify"),
        ("cameras.txt", COLMAP + f"1 FULL_OPENCV 640 480 5 5 3 2 {'0.1 ' * 8}\n", "8 terms.*rectify"),
        ("cameras.txt", COLMAP + "1 FULL_OPENCV 640 480 5 5 3 2 .1 .1 0 0 0 .1 0 0\n", "8 terms.*rectify"),
        ("cameras.txt", COLMAP + "1 OPENCV 640 480 5 5 3 2 0.1 nan 0 0\n", "toml with its first OPENCV camera"),
        ("cameras.bin", COLMAP_BIN, "COLMAP.*model_converter"),
        ("0.hdf5", b"\x89HDF\r\n\x1a\n" + bytes(2 << 20), "HDF5.*get_intrinsics_as_K_matrix"),
        (
            "calib.txt",
            KITTI.replace("P2: 7.188560e+02", "P2: 0"),
            "KITTI.*calibration.toml with the numbers of image_2",
        ),
        ("calib.txt", "hello\n", "line 1: expected key=value"),
    ],
)
def test_file_without_numbers_to_take_over_names_the_remedy(
    name: str, content: str | bytes, words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    for folder in (False, True):
        if folder:
            (tmp_path / "cameras.toml").write_text(f'calibration = "{name}"\n')
        with pytest.raises(CalibrationError, match=words):
            read(tmp_path, 640, 480, is_stereo=False)


def test_other_texts_are_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "readme.txt").write_text("2024-05-01 site\n")
    with pytest.raises(InputError, match="the calibration files are none, expected"):
        read(tmp_path, 640, 480, is_stereo=False)


def test_calibration_toml_may_have_one_camera(tmp_path: Path) -> None:
    text = "[left]\nfx = 500.0\nfy = 500.0\ncx = 320.0\ncy = 240.0\ndistortion = [0, 0, 0, 0]\n"
    (tmp_path / "calibration.toml").write_text(text)
    assert np.array_equal(
        read(tmp_path, 640, 480, is_stereo=False).left.K, [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
    )
    with pytest.raises(CalibrationError, match="right: missing"):
        read(tmp_path, 640, 480, is_stereo=True)
    (tmp_path / "calibration.toml").write_text(text.replace("fx = 500.0", "fx = 0"))
    with pytest.raises(CalibrationError, match=r"left\.fx: got 0"):
        read(tmp_path, 640, 480, is_stereo=False)
