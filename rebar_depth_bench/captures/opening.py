"""Views of any data that methods predict on: a dataset, a capture, an image folder or KITTI's raw data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.captures.camera_files import CAMERAS_FILE
from rebar_depth_bench.captures.folder import is_capture, open_capture
from rebar_depth_bench.captures.kitti import is_kitti, open_kitti
from rebar_depth_bench.captures.kitti_images import read_images
from rebar_depth_bench.captures.views import ImageViews
from rebar_depth_bench.data.manifest import MANIFEST_FILE
from rebar_depth_bench.errors import InputError


def open_images(data: str | Path, images: Path | None = None) -> Sequence[ImageViews] | None:
    """Return the views of images that are no dataset folder, or None for a dataset folder or a Hub repository.

    ``images`` lists images of KITTI (default: the Eigen test split). Raises ``InputError`` as ``open_capture`` and
    ``open_kitti`` do, if ``images`` is given for other data, and for a folder that is none of these.
    """
    folder = Path(data)
    is_dataset = not folder.is_dir() or (folder / MANIFEST_FILE).exists()
    if not is_dataset and is_kitti(folder):
        return open_kitti(folder, read_images(images))
    if images is not None:
        raise InputError(f"{data}: --images {images} is given, which is for KITTI's raw data only")
    if is_dataset:
        return None
    if is_capture(folder):
        return [open_capture(folder)]
    raise InputError(
        f"{data}: has no {MANIFEST_FILE}, no left/, no images with {CAMERAS_FILE} or a calibration, and no days "
        "of KITTI, expected a complete dataset folder written by rebar-build, or images with their cameras"
    )
