"""Calibrations of one stereo pair as OpenCV and ROS write them, and the same in ``calibration.toml``."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import yaml

from rebar_depth_bench.captures.calibration import StereoCalibration
from rebar_depth_bench.captures.calibration_files import read_calibration

WIDTH, HEIGHT = 640, 480
LEFT_K = np.array([[534.07, 0, 341.53], [0, 534.11, 232.94], [0, 0, 1]])
RIGHT_K = np.array([[537.39, 0, 326.61], [0, 536.95, 250.12], [0, 0, 1]])
LEFT_D = np.array([-0.2929, 0.1077, 0.0013, -0.0003, 0.0004])
RIGHT_D = np.array([-0.2902, 0.1074, -0.0006, -0.0002, -0.0003])
ROTATION_RAD = np.array([0.0047, -0.0021, 0.0013])
TRANSLATION_M = np.array([-0.1205, 0.0013, -0.0004])
ROTATION = cv2.Rodrigues(ROTATION_RAD)[0]
TOML = f"""\
width = {WIDTH}
height = {HEIGHT}
[left]
K = {LEFT_K.tolist()}
distortion = {LEFT_D.tolist()}
[right]
K = {RIGHT_K.tolist()}
distortion = {RIGHT_D.tolist()}
[stereo]
rotation = {ROTATION_RAD.tolist()}
translation_m = {TRANSLATION_M.tolist()}
"""


def expected_calibration(folder: Path, width: int = WIDTH, height: int = HEIGHT) -> StereoCalibration:
    """Return the calibration, read from TOML."""
    path = folder / "expected.toml"
    path.write_text(TOML)
    calibration = read_calibration(path, width, height)
    path.unlink()
    return calibration


def write_opencv(folder: Path, suffix: str) -> None:
    """Write one file with a pair through OpenCV's FileStorage."""
    storage = cv2.FileStorage(str(folder / f"stereo.{suffix}"), cv2.FILE_STORAGE_WRITE)
    values = {"M1": LEFT_K, "D1": LEFT_D, "M2": RIGHT_K, "D2": RIGHT_D, "R": ROTATION, "T": TRANSLATION_M}
    for name, value in values.items():
        storage.write(name, value)
    if suffix != "json":  # OpenCV writes comments that JSON does not have.
        storage.writeComment("a comment")
    storage.write("E", np.eye(3))
    storage.release()


def write_opencv_sample(folder: Path) -> None:
    """Write the two files of OpenCV's sample ``stereo_calib``, whose unit is the edge of a square, 25 mm here."""
    square_m = 0.025
    storage = cv2.FileStorage(str(folder / "intrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    # The sample calibrates with CALIB_RATIONAL_MODEL off and writes five terms as one row.
    for name, value in {"M1": LEFT_K, "D1": LEFT_D[None], "M2": RIGHT_K, "D2": RIGHT_D[None]}.items():
        storage.write(name, value)
    storage.release()
    rectified = cv2.stereoRectify(
        LEFT_K, LEFT_D, RIGHT_K, RIGHT_D, (WIDTH, HEIGHT), ROTATION, TRANSLATION_M / square_m
    )
    values = {"R": ROTATION, "T": TRANSLATION_M[:, None] / square_m}
    values |= dict(zip(("R1", "R2", "P1", "P2", "Q"), rectified, strict=False))
    storage = cv2.FileStorage(str(folder / "extrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()


def _rows(values: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.9f}' for value in values.ravel())}]"


def ros_texts(*, as_message: bool) -> dict[str, str]:
    """Return ``camera_info`` of both cameras as camera_calibration saves, or ``ros2 topic echo`` prints it."""
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        *(LEFT_K, LEFT_D, RIGHT_K, RIGHT_D, (WIDTH, HEIGHT), ROTATION, TRANSLATION_M), alpha=0
    )
    write = _message_text if as_message else _saved_text
    return {
        "left.yaml": write("left", LEFT_K, LEFT_D, R1, P1),
        "right.yaml": write("right", RIGHT_K, RIGHT_D, R2, P2),
    }


def _saved_text(name: str, K: np.ndarray, D: np.ndarray, R: np.ndarray, P: np.ndarray) -> str:
    matrices = {
        "camera_matrix": (3, 3, K),
        "distortion_coefficients": (1, 5, D),
        "rectification_matrix": (3, 3, R),
        "projection_matrix": (3, 4, P),
    }
    text = f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_name: narrow_stereo/{name}\n"
    for key, (rows, columns, values) in matrices.items():
        if key == "distortion_coefficients":
            text += "distortion_model: plumb_bob\n"
        text += f"{key}:\n  rows: {rows}\n  cols: {columns}\n  data: {_rows(values)}\n"
    return text


def _message_text(name: str, K: np.ndarray, D: np.ndarray, R: np.ndarray, P: np.ndarray) -> str:
    stamp = "  stamp:\n    sec: 1700000000\n    nanosec: 12"
    lists = {"d": D, "k": K, "r": R, "p": P}
    text = f"header:\n{stamp}\n  frame_id: {name}_optical\nheight: {HEIGHT}\nwidth: {WIDTH}\n"
    text += "distortion_model: plumb_bob\n"
    for key, values in lists.items():
        text += f"{key}:\n" + "".join(f"- {value!r}\n" for value in values.ravel().tolist())
    roi = "roi:\n  x_offset: 0\n  y_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false"
    message = f"{text}binning_x: 0\nbinning_y: 0\n{roi}\n---\n"
    return message + message  # The topic is printed until it is interrupted.


def aliased_text() -> str:
    """Return a pair of equal cameras as ``yaml.dump`` writes it, with aliases for the lists of the right one."""
    K, D = LEFT_K.tolist(), LEFT_D.tolist()
    pair = {"K1": K, "K2": K, "D1": D, "D2": D, "R": ROTATION.tolist(), "T": TRANSLATION_M.tolist()}
    return str(yaml.dump(pair))
