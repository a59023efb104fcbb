"""Ground truth of a KITTI image: its own laser scan, or the improved depth map of several scans.

- ``raw``: ``ROOT/<date>/<drive>/velodyne_points/data/<frame>.bin`` (float32 x y z reflectance) and the day's two
  calibration files; all 697 images of the list have one.
- ``improved``: ``proj_depth/groundtruth/image_02/<frame>.png`` of the drive (Uhrig et al., "Sparsity Invariant
  CNNs", 3DV 2017), below ``ROOT``, ``ROOT/train``, ``ROOT/val`` or either inside ``ROOT/data_depth_annotated``;
  16-bit, metres times 256, 0 where there is none; 652 images of the list have one.

KITTI's calibration of a day: where a laser point falls in a rectified colour picture.

Geiger et al., "Vision meets Robotics: The KITTI Dataset", IJRR 2013, equation 8:
``y = P_rect_i  R_rect_00  T_velo_to_cam  x``, homogeneous.
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
_LARGEST_SIDE = 8192


@dataclass(frozen=True, eq=False)
class KittiCamera:
    """One rectified colour camera: its picture's size and ``(u z, v z, z) = image_from_velo @ (x, y, z, 1)``.

    z on the left is planar depth; x, y, z on the right is a laser point; metres. ``kitti_truth.project_scan`` says
    which pixel u, v is.
    """

    width: int
    height: int
    image_from_velo: Float64[ndarray, "3 4"]


def read_camera(day: Path, camera: int) -> KittiCamera:
    """Read camera 2 or 3 from the two calibration files of a day's folder.

    Raises ``DatasetError`` naming the file and the key that is missing, has another count of numbers or a number
    that is none.
    """
    cam = _read_values(day / CAM_TO_CAM)
    velo = _read_values(day / VELO_TO_CAM)
    size = _numbers(cam, day / CAM_TO_CAM, f"S_rect_{camera:02d}", 2)
    projection = _numbers(cam, day / CAM_TO_CAM, f"P_rect_{camera:02d}", 12).reshape(3, 4)
    rectification, cam_from_velo = np.eye(4), np.eye(4)
    rectification[:3, :3] = _numbers(cam, day / CAM_TO_CAM, "R_rect_00", 9).reshape(3, 3)
    cam_from_velo[:3, :3] = _numbers(velo, day / VELO_TO_CAM, "R", 9).reshape(3, 3)
    cam_from_velo[:3, 3] = _numbers(velo, day / VELO_TO_CAM, "T", 3)
    width, height = (int(side) for side in size)
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise DatasetError(
            f"{day / CAM_TO_CAM}: S_rect_{camera:02d} is {width} x {height}, expected 1 to {_LARGEST_SIDE} each"
        )
    return KittiCamera(width, height, projection @ rectification @ cam_from_velo)


def _read_values(path: Path) -> dict[str, str]:
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not ASCII text"
        raise DatasetError(f"{path}: cannot be read: {reason}, expected KITTI's calibration of the day") from None
    pairs = (line.partition(":") for line in text.splitlines())
    return {key.strip(): value.strip() for key, colon, value in pairs if colon}


def _numbers(values: dict[str, str], path: Path, key: str, count: int) -> Float64[ndarray, " n"]:
    if key not in values:
        raise DatasetError(f"{path}: has no {key}, expected {count} numbers under that key")
    found = values[key].split()
    try:
        numbers = [float(part) for part in found]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise DatasetError(f"{path}: {key} is {values[key][:120]!r}, expected {count} finite numbers")
    return np.array(numbers)


GroundTruth = Literal["raw", "improved"]
LidarDepth = Literal["camera", "velodyne"]
EXPECTED_IMAGES: Mapping[GroundTruth, int] = {"raw": 697, "improved": 652}
PNG_SCALE = 1 / 256
_FOLDERS = (".", "train", "val", "data_depth_annotated/train", "data_depth_annotated/val")
_POINT_BYTES = 16
_LARGEST_SCAN_BYTES = 64_000_000


@dataclass(frozen=True)
class TruthFile:
    """Where an image's ground truth lies, and its (H, W); ``camera`` projects a raw scan."""

    image: KittiImage
    path: Path
    shape: tuple[int, int]
    camera: KittiCamera | None


def find_truth(root: Path, images: tuple[KittiImage, ...], kind: GroundTruth) -> tuple[list[TruthFile], list[str]]:
    """Return the images' ground truth files, and the names of those that have none.

    Raises ``DatasetError`` where there is none at all, or a calibration or a PNG header is damaged.
    """
    if not root.is_dir():
        raise DatasetError(f"{root}: no such folder, expected one with KITTI's {kind} data")
    found: list[TruthFile] = []
    missing: list[str] = []
    cameras: dict[tuple[str, int], KittiCamera] = {}
    for image in images:
        path = _raw_path(root, image) if kind == "raw" else _improved_path(root, image)
        if not path.is_file():
            missing.append(image.name)
        elif kind == "improved":
            found.append(TruthFile(image, path, _png_shape(path), None))
        else:
            key = (image.date, image.camera)
            if key not in cameras:
                cameras[key] = read_camera(root / image.date, image.camera)
            found.append(TruthFile(image, path, (cameras[key].height, cameras[key].width), cameras[key]))
    if not found:
        example = _raw_path(Path(), images[0]) if kind == "raw" else _improved_path(Path(), images[0])
        raise DatasetError(f"{root}: has the {kind} ground truth of no image, expected files such as {example}")
    return found, missing


def read_truth(file: TruthFile, lidar_depth: LidarDepth = "camera") -> Float32[ndarray, "h w"]:
    """Return the ground truth of an image: depth in metres, 0 where there is none. Raises ``DatasetError``."""
    if file.camera is None:
        return _improved_depth(file)
    return project_scan(read_scan(file.path), file.camera, lidar_depth)


def read_scan(path: Path) -> Float32[ndarray, "n 4"]:
    """Return a laser scan: x forward, y left, z up in metres, reflectance. Raises ``DatasetError``."""
    data = _read(path, _LARGEST_SCAN_BYTES)
    if not data or len(data) % _POINT_BYTES:
        raise DatasetError(
            f"{path}: has {len(data)} bytes, expected a multiple of {_POINT_BYTES} (float32 x y z reflectance)"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)
    if not np.isfinite(points[:, :3]).all():
        raise DatasetError(f"{path}: holds a coordinate that is not finite, expected metres")
    return points


def project_scan(
    points: Float32[ndarray, "n 4"], camera: KittiCamera, lidar_depth: LidarDepth = "camera"
) -> Float32[ndarray, "h w"]:
    """Return a scan as a sparse depth map, metres, 0 where no point falls; of several points the nearest wins.

    The pixel, counted from 0, is ``round(u) - 1, round(v) - 1`` with halves rounded to even, as in Monodepth
    (Godard et al., CVPR 2017), which follows KITTI's MATLAB code. Points behind the scanner (x < 0) or the camera
    are dropped. ``camera`` depth is planar z in the rectified camera; ``velodyne`` is the point's own x, about
    0.27 m more, which Monodepth and its successors score against. Their code takes the picture's first and last
    columns for one when it looks for the nearest point; this does not (the Garg and Eigen crops leave both out).
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
    data = _read(file.path, max_png_bytes(file.shape))
    try:
        return decode_png(str(file.path), memoryview(data), file.shape, PNG_SCALE).astype(np.float32)
    except EntryError as error:
        raise DatasetError(error.problem) from None


def _png_shape(path: Path) -> tuple[int, int]:
    """Return (H, W) from a PNG's first bytes."""
    try:
        with path.open("rb") as stream:
            head = stream.read(24)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    width, height = struct.unpack(">2I", head[16:24]) if len(head) == 24 and head[12:16] == b"IHDR" else (0, 0)
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise DatasetError(f"{path}: says {height} x {width} pixels, expected a PNG of 1 to {_LARGEST_SIDE} each")
    return height, width


def _read(path: Path, limit: int) -> bytes:
    try:
        with path.open("rb") as stream:
            data = stream.read(limit + 1)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}") from None
    if len(data) > limit:
        raise DatasetError(f"{path}: is larger than {limit} bytes, expected a file of KITTI")
    return data


def _raw_path(root: Path, image: KittiImage) -> Path:
    return root / image.date / image.drive / "velodyne_points" / "data" / f"{image.frame}.bin"


def _improved_path(root: Path, image: KittiImage) -> Path:
    """Return the first place where the map lies, else the place in ``train``."""
    inside = Path(image.drive) / "proj_depth" / "groundtruth" / f"image_{image.camera:02d}" / f"{image.frame}.png"
    places = [root / folder / inside for folder in _FOLDERS]
    return next((place for place in places if place.is_file()), root / "train" / inside)
