"""Layout ``kitti``: raw data of KITTI with rectified colour images, and its depth maps.

A config of one scene, or a scene of another, is one day with one drive. The depth maps are those of KITTI's depth
prediction benchmark: 16-bit PNG of metres times 256, 0 without depth. Laser scans are not written. ``images.txt``
lists the images for ``rebar-bench predict --images`` and ``rebar-bench study kitti --images``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from dataset_builder.export.calibration_text import kitti_cam_to_cam, kitti_velo_to_cam
from dataset_builder.export.images import plain_png
from dataset_builder.export.layout import ExportedConfig, ImageFile, Layout
from dataset_builder.export.rig import check_layout, shared_calibration
from dataset_builder.export.views import CameraView
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.errors import InputError

DATE = "2000_01_01"
_DRIVE = f"{DATE}_drive_0001_sync"
_DEPTH = f"{_DRIVE}/proj_depth/groundtruth/image_02"
_UNITS_PER_METRE = 256
_LARGEST = np.iinfo(np.uint16).max


class KittiLayout(Layout):
    """Folder that ``rebar-bench predict --data`` and ``rebar-bench study kitti --kitti`` read."""

    def check(self, config: DatasetConfig) -> None:
        """Raise ``InputError`` for a config without colour or on the raw grid: KITTI's images are rectified."""
        check_layout(config, "kitti")
        if config.scene.rig is not None and config.scene.rig.grid == "raw":
            raise InputError(
                f"{config.root}: config {config.name} is on the raw grid, expected rectified images for "
                "--layout kitti"
            )

    def folders(self, config: DatasetConfig) -> Iterable[str]:
        """Return the folders with files."""
        del config
        return (".", DATE, *(f"{DATE}/{_DRIVE}/{name}" for name in ("image_02/data", "image_03/data")), _DEPTH)

    def images(self, config: DatasetConfig, view: CameraView) -> Iterable[ImageFile]:
        """Return the images of both cameras, and the depth map of the left one."""
        del config
        frame = f"{_frame(view)}.png"
        return [
            ImageFile(f"{DATE}/{_DRIVE}/image_02/data/{frame}", "left_rgb", plain_png),
            ImageFile(f"{DATE}/{_DRIVE}/image_03/data/{frame}", "right_rgb", plain_png),
            ImageFile(f"{_DEPTH}/{frame}", "left_depth", kitti_depth_png),
        ]

    def texts(self, exported: ExportedConfig) -> Mapping[str, str]:
        """Return the calibration of the day and the list of images."""
        calibration = shared_calibration(exported.config, exported.views)
        return {
            f"{DATE}/calib_cam_to_cam.txt": kitti_cam_to_cam(calibration),
            f"{DATE}/calib_velo_to_cam.txt": kitti_velo_to_cam(),
            "images.txt": "".join(f"{DATE}/{_DRIVE} {_frame(view)} l\n" for view in exported.views),
        }


def kitti_depth_png(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode planar depth as 16-bit PNG of metres times 256, rounded to the nearest.

    0 where there is no surface, or where it is farther than 255.996 m; surfaces nearer than 4 mm have 1.
    """
    units = np.rint(depth_m.astype(np.float64) * _UNITS_PER_METRE)
    units = np.where(depth_m > 0, np.maximum(units, 1), 0)
    return plain_png(np.where(units <= _LARGEST, units, 0).astype(np.uint16))


def _frame(view: CameraView) -> str:
    """Return the frame's number: that of the view in its full protocol."""
    return view.index.zfill(10)
