"""Reader of KITTI's ground-truth depth.

Two kinds of ground truth are supported:

- ``raw``, a single laser scan: ``ROOT/<date>/<drive>/velodyne_points/data/<frame>.bin`` (float32 x y z
  reflectance) and the two calibration files of the day; available for all 697 images of the Eigen split.
- ``improved``, accumulated from several scans: ``proj_depth/groundtruth/image_02/<frame>.png`` of the drive (Uhrig
  et al., "Sparsity Invariant CNNs", 3DV 2017), below ``ROOT``, ``ROOT/train``, ``ROOT/val``, or ``train`` or
  ``val`` inside ``ROOT/data_depth_annotated``; 16-bit PNG in metres times 256, in which pixels without depth
  are 0; available for 652 images of the Eigen split.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from rebar_depth_bench.captures.image_header import read_image_shape
from rebar_depth_bench.captures.kitti_calibration import MAX_SIDE_PX, KittiCamera, read_camera
from rebar_depth_bench.captures.kitti_images import KittiImage
from rebar_depth_bench.errors import DatasetError, Problem, format_shape
from rebar_depth_bench.reading import open_regular
from rebar_depth_bench.submission import EntryError
from rebar_depth_bench.submission.image_formats import decode_png, max_png_bytes

GroundTruthKind = Literal["raw", "improved"]
"""A single projected laser scan, or the improved depth map of several scans."""
LidarDepthConvention = Literal["camera", "velodyne"]
"""Depth of a laser point: planar z in the camera, or x in the scanner's frame (see ``project_scan``)."""
EXPECTED_IMAGES: Mapping[GroundTruthKind, int] = {"raw": 697, "improved": 652}
"""Number of images of the Eigen split with ground truth of each kind."""
PNG_SCALE = 1 / 256
"""Metres per unit of a 16-bit PNG depth map."""
_IMPROVED_FOLDERS = (".", "train", "val", "data_depth_annotated/train", "data_depth_annotated/val")
_POINT_BYTES = 16
_MAX_SCAN_BYTES = 64_000_000
_MAX_DISTANCE_M = 10_000
"""Largest magnitude of a laser point's coordinate, far beyond the range of a scanner."""


@dataclass(frozen=True)
class TruthFile:
    """Ground-truth file of an image.

    ``shape`` is the (H, W) of the depth map. ``camera`` projects a raw scan and is None for an improved depth map.
    """

    image: KittiImage
    path: Path
    shape: tuple[int, int]
    camera: KittiCamera | None


def find_truth(
    root: Path, images: tuple[KittiImage, ...], kind: GroundTruthKind
) -> tuple[list[TruthFile], list[str]]:
    """Return the ground-truth files of the images, and the names of the images without one.

    Raises ``DatasetError`` if no image has ground truth, or if a calibration file or PNG header is damaged.
    """
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder, expected one with KITTI's {kind} data")
    truths: list[TruthFile] = []
    missing: list[str] = []
    cameras: dict[tuple[str, int], KittiCamera] = {}
    for image in images:
        path = _raw_path(root, image) if kind == "raw" else _improved_path(root, image)
        if not path.exists():
            missing.append(image.name)
        elif kind == "improved":
            truths.append(TruthFile(image, path, _png_shape(path), None))
        else:
            key = (image.date, image.camera)
            if key not in cameras:
                cameras[key] = read_camera(root / image.date, image.camera)
            truths.append(TruthFile(image, path, (cameras[key].height, cameras[key].width), cameras[key]))
    if not truths:
        example = _raw_path(Path(), images[0]) if kind == "raw" else _improved_path(Path(), images[0])
        raise DatasetError(f"{root}: has no {kind} ground truth, expected files such as {example}")
    return truths, missing


def read_truth(file: TruthFile, lidar_depth: LidarDepthConvention = "camera") -> Float32[ndarray, "h w"]:
    """Return the ground-truth depth of an image in metres; pixels without ground truth are 0.

    Raises ``DatasetError`` if the file cannot be read.
    """
    if file.camera is None:
        return _improved_depth(file)
    return project_scan(read_scan(file.path), file.camera, lidar_depth)


def read_scan(path: Path) -> Float32[ndarray, "n 4"]:
    """Return a laser scan with the columns x forward, y left, z up (metres) and reflectance.

    Raises ``DatasetError`` if the file cannot be read, has an invalid size or contains a coordinate that is not
    finite or beyond any scanner's range.
    """
    data = _read_limited(path, _MAX_SCAN_BYTES)
    if not data or len(data) % _POINT_BYTES:
        expected = f"a multiple of {_POINT_BYTES} (float32 x y z reflectance)"
        problem = Problem("size", "", f"it has {len(data)} bytes", expected)
        raise DatasetError.from_problems(path, [problem])
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    near = np.abs(points[:, :3]).max(axis=1) <= _MAX_DISTANCE_M  # False for NaN.
    if not near.all():
        index = int(np.argmin(near))
        found = f"the coordinates are {points[index, :3].tolist()}"
        problem = Problem("invalid", f"point {index + 1}", found, f"metres, up to {_MAX_DISTANCE_M}")
        raise DatasetError.from_problems(path, [problem])
    return points


def project_scan(
    points: Float32[ndarray, "n 4"], camera: KittiCamera, lidar_depth: LidarDepthConvention = "camera"
) -> Float32[ndarray, "h w"]:
    """Return the sparse depth map of a scan in metres; pixels without a laser point are 0.

    If several points fall on one pixel, the nearest is kept. The pixel indices, counted from 0, are
    ``round(u) - 1, round(v) - 1`` with halves rounded to even, as in Monodepth (Godard et al., CVPR 2017), which
    follows KITTI's MATLAB code. Points behind the scanner (x < 0) or behind the camera are dropped.

    With ``lidar_depth="camera"``, depth is planar z in the rectified camera. With ``"velodyne"``, it is the
    point's x in the scanner's frame, about 0.27 m larger, which Monodepth and its successors score against. When
    searching for the nearest point, their code merges the first and last columns of the image; this function does
    not. The Garg and Eigen crops exclude both columns.
    """
    ahead = points[points[:, 0] >= 0, :3].astype(np.float64)
    homogeneous = np.concatenate([ahead, np.ones((len(ahead), 1))], axis=1)
    projected: Float64[ndarray, "n 3"] = homogeneous @ camera.image_from_velo.T
    front = projected[:, 2] > 0
    ahead, projected = ahead[front], projected[front]
    u, v = (np.rint(projected[:, axis] / projected[:, 2]) - 1 for axis in (0, 1))
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    depth_m = projected[:, 2] if lidar_depth == "camera" else ahead[:, 0]
    pixels = v[inside].astype(np.int64) * camera.width + u[inside].astype(np.int64)
    nearest_m = np.full(camera.height * camera.width, np.inf)
    np.minimum.at(nearest_m, pixels, depth_m[inside])
    nearest_m[np.isinf(nearest_m)] = 0.0
    return nearest_m.astype(np.float32).reshape(camera.height, camera.width)


def _improved_depth(file: TruthFile) -> Float32[ndarray, "h w"]:
    data = _read_limited(file.path, max_png_bytes(file.shape))
    try:
        return decode_png("", memoryview(data), file.shape, PNG_SCALE).astype(np.float32)
    except EntryError as error:
        raise DatasetError.from_problems(file.path, error.problems) from None


def _png_shape(path: Path) -> tuple[int, int]:
    """Return (H, W) from the header of a PNG. Raises ``DatasetError`` if it is not that of a KITTI depth map."""
    try:
        shape = read_image_shape(path)
    except EntryError as error:
        raise DatasetError.from_problems(path, error.problems) from None
    if max(shape) > MAX_SIDE_PX:
        problem = Problem("size", "", f"the image is {format_shape(shape)} (H x W)", f"up to {MAX_SIDE_PX} each")
        raise DatasetError.from_problems(path, [problem])
    return shape


def _read_limited(path: Path, limit: int) -> bytes:
    try:
        with open_regular(path) as stream:
            data = stream.read(limit + 1)
    except OSError as error:
        problem = Problem("unreadable", "", f"cannot be read: {error.strerror}")
        raise DatasetError.from_problems(path, [problem]) from None
    if len(data) > limit:
        problem = Problem("size", "", f"it has more than {limit} bytes", "a KITTI file")
        raise DatasetError.from_problems(path, [problem])
    return data


def _raw_path(root: Path, image: KittiImage) -> Path:
    return root / image.date / image.drive / "velodyne_points" / "data" / f"{image.frame}.bin"


def _improved_path(root: Path, image: KittiImage) -> Path:
    """Return the first existing path of the improved depth map, or its path in ``train`` if there is none."""
    relative_path = (
        Path(image.drive) / "proj_depth" / "groundtruth" / f"image_{image.camera:02d}" / f"{image.frame}.png"
    )
    candidates = [root / folder / relative_path for folder in _IMPROVED_FOLDERS]
    return next((path for path in candidates if path.exists()), root / "train" / relative_path)
