"""KITTI's raw data as views: the rectified colour images of a list, by day and camera.

::

    ROOT/<date>/calib_cam_to_cam.txt
    ROOT/<date>/<drive>/image_02/data/<frame>.png    left colour camera (.png, .jpg or .jpeg)
    ROOT/<date>/<drive>/image_03/data/<frame>.png    right colour camera

The id of a view is ``kitti/<drive>_<frame>_<side>``, as ``rebar-bench study kitti`` expects. Images of the side
``l`` have the image of camera 3 as their right one; those of the side ``r``, of camera 3, have none.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.captures.image_files import IMAGE_SUFFIXES, common_shape
from rebar_depth_bench.captures.kitti_calibration import CAM_TO_CAM, read_pair
from rebar_depth_bench.captures.kitti_images import CONFIG_NAME, KittiImage
from rebar_depth_bench.captures.views import ImageViews
from rebar_depth_bench.errors import DatasetError, Problem
from rebar_depth_bench.geometry.stereo_calibration import Calibration, MonoCalibration

_DAY = re.compile(r"\d{4}_\d\d_\d\d")
_RIGHT_CAMERA = 3


def is_kitti(root: str | Path) -> bool:
    """Return whether a folder has a day of KITTI's raw data."""
    folder = Path(root)
    days = [entry for entry in folder.iterdir() if _DAY.fullmatch(entry.name)] if folder.is_dir() else []
    return any((day / CAM_TO_CAM).is_file() for day in days)


def open_kitti(root: str | Path, images: Sequence[KittiImage]) -> list[ImageViews]:
    """Return the views of those of the images that are below ``root``, for each day and side.

    Raises ``DatasetError`` if there are none, for problems of the calibration, and for images of another size.
    """
    folder = Path(root)
    by_day: dict[tuple[str, str], list[KittiImage]] = {}
    for image in images:
        if _image_file(folder, image, image.camera) is not None:
            by_day.setdefault((image.date, image.side), []).append(image)
    if not by_day:
        example = folder / images[0].date / images[0].drive / f"image_{images[0].camera:02d}" / "data"
        raise DatasetError(
            f"{root}: has none of the {len(images)} images of the list, expected for example "
            f"{example / images[0].frame}.png"
        )
    return [_day_views(folder, date, side, found) for (date, side), found in sorted(by_day.items())]


def _day_views(root: Path, date: str, side: str, images: Sequence[KittiImage]) -> ImageViews:
    pair = read_pair(root / date)
    calibration: Calibration = pair
    left = {image.view_id: file for image in images if (file := _image_file(root, image, image.camera))}
    right = {}
    if side == "l":
        right = {image.view_id: file for image in images if (file := _image_file(root, image, _RIGHT_CAMERA))}
    if side == "r" or len(right) < len(left):  # Without all right images, these are images of one camera.
        right = {}
        calibration = MonoCalibration(pair.width, pair.height, pair.left if side == "l" else pair.right)
    problems: list[Problem] = []
    shape = common_shape([*left.values(), *right.values()], problems)
    if shape is not None and shape != (pair.height, pair.width):
        expected = f"{pair.width} x {pair.height} as in {CAM_TO_CAM}"
        problems.append(Problem("conflict", "", f"the images are {shape[1]} x {shape[0]}", expected))
    if problems:
        raise DatasetError.from_problems(root / date, problems)
    return ImageViews(root, f"{CONFIG_NAME}-{date}-{side}", left, right, calibration)


def _image_file(root: Path, image: KittiImage, camera: int) -> Path | None:
    """Return the file of an image of a colour camera, or None if there is none."""
    folder = root / image.date / image.drive / f"image_{camera:02d}" / "data"
    files = (folder / f"{image.frame}{suffix}" for suffix in IMAGE_SUFFIXES)
    return next((file for file in files if file.exists()), None)
