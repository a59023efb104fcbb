"""A COLMAP text model of true cameras: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

Source: COLMAP's documentation, "Output Format" and "Camera Models". COLMAP's camera axes are OpenCV's, its first
pixel centre is (0.5, 0.5) where ours is (0, 0): cx and cy grow by ``HALF_PIXEL``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.rigs import Camera
from dataset_builder.export.views import CameraView
from dataset_builder.scene.model import Bar
from dataset_builder.scene.shapes.bending import resampled_m

HALF_PIXEL = 0.5
POINTS_WANTED = 10_000
_SHORTEST_STEP_M = 0.001
_GREY = "128 128 128"
_NO_ERROR = "0"


def cameras_txt(views: Sequence[CameraView]) -> str:
    """Return ``cameras.txt``: each distinct camera once, numbered from 1.

    A grid without distortion is PINHOLE (fx fy cx cy), any other FULL_OPENCV (fx fy cx cy k1 k2 p1 p2 k3 0 0 0).
    """
    lines = [
        f"{camera_id} {camera_line}" for camera_line, camera_id in _camera_ids(views).items()
    ]  # a camera is its own line's text
    return _text("CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", lines)


def images_txt(views: Sequence[CameraView]) -> str:
    """Return ``images.txt``: both eyes of every view, with ``cam_from_world`` as quaternion and translation.

    An image's second line would list its feature points and is empty. Names are those below ``images/``.
    """
    camera_ids = _camera_ids(views)
    lines: list[str] = []
    for view in views:
        for eye, camera in view.cameras.items():
            pose = camera.cam_from_world
            numbers = _numbers([*quaternion_wxyz(pose[:3, :3]), *pose[:3, 3]])
            image_id = len(lines) // 2 + 1
            lines += [f"{image_id} {numbers} {camera_ids[_camera_line(camera)]} {view.stem(eye)}.png", ""]
    return _text("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] as (X Y POINT3D_ID)", lines)


def points_txt(bars: Sequence[Bar]) -> str:
    """Return ``points3D.txt``: about ``POINTS_WANTED`` grey points on the bars' centrelines, seen by no image.

    Some tools (Gaussian splatting among them) start from points and refuse a model that has none.
    """
    points_m = axis_points_m(bars)
    lines = [f"{number} {_numbers(point)} {_GREY} {_NO_ERROR}" for number, point in enumerate(points_m, start=1)]
    return _text("POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)", lines)


def axis_points_m(bars: Sequence[Bar]) -> Float64[ndarray, "n 3"]:
    """Return points spread evenly over each bar's centreline, its ends included; world frame, metres."""
    axes_m = [np.array(bar.axis_m, dtype=np.float64) for bar in bars]
    length_m = sum(float(np.linalg.norm(np.diff(axis_m, axis=0), axis=1).sum()) for axis_m in axes_m)
    step_m = max(length_m / POINTS_WANTED, _SHORTEST_STEP_M)
    return np.concatenate([np.empty((0, 3)), *(resampled_m(axis_m, step_m) for axis_m in axes_m)])


def quaternion_wxyz(rotation: Float64[ndarray, "3 3"]) -> Float64[ndarray, " 4"]:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    The row of 4 q q^T with the largest diagonal is a multiple of q, however the rotation turns
    (Shepperd, "Quaternion from rotation matrix", 1978).
    """
    r = rotation
    outer = np.array(
        [
            [1 + r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1 - r[0, 0] + r[1, 1] - r[2, 2], r[1, 2] + r[2, 1]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1 - r[0, 0] - r[1, 1] + r[2, 2]],
        ]
    )
    quaternion = outer[np.argmax(np.diag(outer))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return np.asarray(-quaternion if quaternion[0] < 0 else quaternion)


def _camera_ids(views: Iterable[CameraView]) -> dict[str, int]:
    """Return the number of each distinct camera by its line of ``cameras.txt``, in order of appearance."""
    lines = dict.fromkeys(_camera_line(camera) for view in views for camera in view.cameras.values())
    return {line: number for number, line in enumerate(lines, start=1)}


def _camera_line(camera: Camera) -> str:
    """Return a camera's model, size and parameters as COLMAP writes them."""
    K = camera.K
    parameters = [K[0, 0], K[1, 1], K[0, 2] + HALF_PIXEL, K[1, 2] + HALF_PIXEL]
    model = "PINHOLE"
    if np.any(camera.distortion):
        model = "FULL_OPENCV"
        parameters += [*camera.distortion, 0.0, 0.0, 0.0]
    return f"{model} {camera.width} {camera.height} {_numbers(parameters)}"


def _numbers(values: Iterable[float]) -> str:
    """Return numbers with all the digits that bring the same float64 back."""
    return " ".join(repr(float(value)) for value in values)


def _text(columns: str, lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in (f"# {columns}", *lines))
