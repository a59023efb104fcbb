"""Reader of KITTI's calibration and ground-truth depth.

Two kinds of ground truth are supported:

- ``raw``, a single laser scan: ``ROOT/<date>/<drive>/velodyne_points/data/<frame>.bin`` (float32 x y z
  reflectance) and the two calibration files of the day; available for all 697 images of the Eigen split.
- ``improved``, accumulated from several scans: ``proj_depth/groundtruth/image_02/<frame>.png`` of the drive (Uhrig
  et al., "Sparsity Invariant CNNs", 3DV 2017), below ``ROOT``, ``ROOT/train``, ``ROOT/val``, or ``train`` or
  ``val`` inside ``ROOT/data_depth_annotated``; 16-bit PNG in metres times 256, in which pixels without depth
  are 0; available for 652 images of the Eigen split.

Laser points are projected into the rectified colour images as in Geiger et al., "Vision meets Robotics: The KITTI
Dataset", IJRR 2013, equation 8: ``y = P_rect_i  R_rect_00  T_velo_to_cam  x`` in homogeneous coordinates.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.studies.kitti.metrics import KittiImage
from rebar_depth_bench.submission import EntryError
from rebar_depth_bench.submission.image_formats import decode_png, max_png_bytes

CAM_TO_CAM, VELO_TO_CAM = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
_MAX_SIDE_PX = 8192


@dataclass(frozen=True, eq=False)
class KittiCamera:
    """Rectified colour camera: image size and projection from the laser scanner's frame.

    ``(u d, v d, d) = image_from_velo @ (x, y, z, 1)``, where (x, y, z) is a laser point in the scanner's frame and
    d its planar depth in the camera, both in metres. ``project_scan`` defines the conversion of (u, v) to pixel
    indices.
    """

    width: int
    height: int
    image_from_velo: Float64[ndarray, "3 4"]


def read_camera(day_folder: Path, camera: int) -> KittiCamera:
    """Return colour camera 2 or 3, read from the two calibration files in the folder of a day.

    Raises ``DatasetError`` naming the file and the key if the key is missing or does not have the expected count
    of finite numbers.
    """
    cam = _read_calibration_file(day_folder / CAM_TO_CAM)
    velo = _read_calibration_file(day_folder / VELO_TO_CAM)
    size = _parse_numbers(cam, day_folder / CAM_TO_CAM, f"S_rect_{camera:02d}", 2)
    projection = _parse_numbers(cam, day_folder / CAM_TO_CAM, f"P_rect_{camera:02d}", 12).reshape(3, 4)
    rectification, cam_from_velo = np.eye(4), np.eye(4)
    rectification[:3, :3] = _parse_numbers(cam, day_folder / CAM_TO_CAM, "R_rect_00", 9).reshape(3, 3)
    cam_from_velo[:3, :3] = _parse_numbers(velo, day_folder / VELO_TO_CAM, "R", 9).reshape(3, 3)
    cam_from_velo[:3, 3] = _parse_numbers(velo, day_folder / VELO_TO_CAM, "T", 3)
    width, height = (int(side) for side in size)
    if not (0 < width <= _MAX_SIDE_PX and 0 < height <= _MAX_SIDE_PX):
        raise DatasetError(
            f"{day_folder / CAM_TO_CAM}: S_rect_{camera:02d} is {width} x {height}, "
            f"expected 1 to {_MAX_SIDE_PX} each"
        )
    return KittiCamera(width, height, projection @ rectification @ cam_from_velo)


def _read_calibration_file(path: Path) -> dict[str, str]:
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not ASCII text"
        raise DatasetError(f"{path}: cannot be read: {reason}, expected KITTI's calibration of the day") from None
    pairs = (line.partition(":") for line in text.splitlines())
    return {key.strip(): value.strip() for key, colon, value in pairs if colon}


def _parse_numbers(values: dict[str, str], path: Path, key: str, count: int) -> Float64[ndarray, " n"]:
    if key not in values:
        raise DatasetError(f"{path}: has no {key}, expected {count} numbers under that key")
    parts = values[key].split()
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise DatasetError(f"{path}: {key} is {values[key][:120]!r}, expected {count} finite numbers")
    return np.array(numbers)


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
        if not path.is_file():
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

    Raises ``DatasetError`` if the file cannot be read, has an invalid size or contains non-finite coordinates.
    """
    data = _read_limited(path, _MAX_SCAN_BYTES)
    if not data or len(data) % _POINT_BYTES:
        raise DatasetError(
            f"{path}: has {len(data)} bytes, expected a multiple of {_POINT_BYTES} (float32 x y z reflectance)"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    if not np.isfinite(points[:, :3]).all():
        raise DatasetError(f"{path}: holds a coordinate that is not finite, expected metres")
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
    ahead = points[points[:, 0] >= 0].astype(np.float64)
    homogeneous = np.concatenate([ahead[:, :3], np.ones((len(ahead), 1))], axis=1)
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
        return decode_png(str(file.path), memoryview(data), file.shape, PNG_SCALE).astype(np.float32)
    except EntryError as error:
        raise DatasetError(str(error)) from None


def _png_shape(path: Path) -> tuple[int, int]:
    """Return (H, W) from the header of a PNG. Raises ``DatasetError`` if it is not a valid PNG header."""
    try:
        with path.open("rb") as stream:
            head = stream.read(24)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    width, height = struct.unpack(">2I", head[16:24]) if len(head) == 24 and head[12:16] == b"IHDR" else (0, 0)
    if not (0 < width <= _MAX_SIDE_PX and 0 < height <= _MAX_SIDE_PX):
        raise DatasetError(f"{path}: is {height} x {width} pixels, expected a PNG of 1 to {_MAX_SIDE_PX} each")
    return height, width


def _read_limited(path: Path, limit: int) -> bytes:
    try:
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    if len(data) > limit:
        raise DatasetError(f"{path}: is larger than {limit} bytes, expected a KITTI file")
    return data


def _raw_path(root: Path, image: KittiImage) -> Path:
    return root / image.date / image.drive / "velodyne_points" / "data" / f"{image.frame}.bin"


def _improved_path(root: Path, image: KittiImage) -> Path:
    """Return the first existing path of the improved depth map, or its path in ``train`` if there is none."""
    relative_path = (
        Path(image.drive) / "proj_depth" / "groundtruth" / f"image_{image.camera:02d}" / f"{image.frame}.png"
    )
    candidates = [root / folder / relative_path for folder in _IMPROVED_FOLDERS]
    return next((path for path in candidates if path.is_file()), root / "train" / relative_path)
