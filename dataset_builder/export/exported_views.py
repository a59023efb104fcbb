"""Views of an export: their cameras, and the image files of each eye with their encoders."""

from __future__ import annotations

import io
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Bool, Float32
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.names import scene_of
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import camera_from_row, decode_row, truth_columns, truth_from_row
from rebar_depth_bench.data.schema import EYES, ViewRecord
from rebar_depth_bench.data.shards import encoded_rows
from rebar_depth_bench.geometry.cameras import Camera

_COLUMNS = ("view_id", "baseline_m", *(name for eye in EYES for name in (f"{eye}_rgb", *truth_columns(eye))))


@dataclass(frozen=True, eq=False)
class CameraView:
    """Cameras of one stereo view by eye, without images: they are held for all views of a config at once."""

    view_id: str
    baseline_m: float
    cameras: Mapping[str, Camera]

    def stem(self, eye: str) -> str:
        """Return the common file name of one eye's files, without folder and suffix, e.g. ``0000_left``.

        It begins with the number of the view in the full trajectory of its scene, with the digits of its id.
        """
        return f"{self.view_id.removeprefix(scene_of(self.view_id))}_{eye}"


def stored_views(config: DatasetConfig, wanted: Collection[str]) -> Iterator[tuple[CameraView, Mapping[str, Any]]]:
    """Yield the wanted views of a config in the folder's order, with their rows, whose images are encoded.

    Raises ``DatasetError`` for shards that cannot be read or lack a wanted view.
    """
    for row in encoded_rows(config, _COLUMNS, wanted):
        yield _camera_view(row, config), row


def decoded_row(config: DatasetConfig, record: ViewRecord, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the decoded row of a view (see ``rebar_depth_bench.load``), checked against its record.

    Raises ``DatasetError``, naming the view, if an image cannot be decoded or the digest of the ground truth
    differs from the manifest.
    """
    decoded = decode_row(config, row)
    for eye in config.truth_eyes:
        digest, expected = truth_from_row(decoded, eye).digest(), getattr(record, eye)
        if digest != expected:
            raise DatasetError(
                f"{config.root}: view {record.view_id}: the {eye} ground truth has digest {digest[:16]}, expected "
                f"{expected[:16]} as in the manifest"
            )
    return decoded


def _camera_view(row: Mapping[str, Any], config: DatasetConfig) -> CameraView:
    try:
        cameras = {eye: camera_from_row(row, eye, config.grid) for eye in EYES}
        return CameraView(row["view_id"], float(row["baseline_m"]), cameras)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{config.root}: view {row['view_id']}: a camera is damaged: {error}") from error


_PNG_LEVEL = 1
"""Compression level: three times faster than the default 6, files a fifth larger."""

_EXR_CHANNEL = "Y"
"""Channel name: OpenCV reads a single channel Y or R correctly, but one named Z silently as zeros."""

MILLIMETRE_M = 0.001
"""One millimetre in metres."""

_LARGEST_MM = np.iinfo(np.uint16).max
"""Largest depth that a 16-bit PNG can store, millimetres."""


def plain_png(pixels: ndarray) -> bytes:
    """Encode 8-bit colour, 8-bit grey or 16-bit grey pixels as PNG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG", compress_level=_PNG_LEVEL)
    return stream.getvalue()


def mask_png(mask: Bool[ndarray, "h w"]) -> bytes:
    """Encode a mask as 8-bit grey PNG, 255 where true, which all common mask readers accept."""
    return plain_png(np.where(mask, np.uint8(255), np.uint8(0)))


def depth_exr(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth, metres, as a single-channel OpenEXR image, losslessly (ZIP compression)."""
    stream = io.BytesIO()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {_EXR_CHANNEL: np.ascontiguousarray(depth_m)}).write(stream)
    return stream.getvalue()


def depth_npy(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode float32 planar depth, metres, as a NumPy file, losslessly."""
    stream = io.BytesIO()
    np.save(stream, depth_m, allow_pickle=False)
    return stream.getvalue()


def depth_mm_png(depth_m: Float32[ndarray, "h w"]) -> bytes:
    """Encode planar depth as 16-bit grey PNG in whole millimetres, rounded to the nearest.

    The value is 0 where there is no surface, or where the surface is farther than 65.535 m.
    """
    depth_mm = np.rint(depth_m.astype(np.float64) / MILLIMETRE_M)
    return plain_png(np.where(depth_mm <= _LARGEST_MM, depth_mm, 0).astype(np.uint16))


@dataclass(frozen=True)
class ExportFile:
    """One file per eye of a view: its folder and suffix, the dataset column it contains, and its encoder."""

    folder: str
    suffix: str
    column: str
    encode: Callable[[Any], bytes]

    def path(self, stem: str) -> str:
        """Return the path of the file in the config's folder."""
        return f"{self.folder}/{stem}{self.suffix}"


EXPORT_FILES: Mapping[str, ExportFile] = {
    "image": ExportFile("images", ".png", "rgb", plain_png),
    "depth": ExportFile("depth", ".exr", "depth", depth_exr),
    "depth_mm": ExportFile("depth_mm", ".png", "depth", depth_mm_png),
    "mask": ExportFile("masks", ".png", "mask", mask_png),
    "bars": ExportFile("bars", ".png", "bars", plain_png),
}
"""Files of the format ``plain`` for each eye, by their key in ``cameras.json``."""

ULTRALYTICS_FILES = (EXPORT_FILES["image"], ExportFile("depth", ".npy", "depth", depth_npy))
"""Files for Ultralytics; its ``DepthDataset`` reads ``depth/NAME.npy``, unless ``depth/NAME.png`` exists."""


def exported_files(config: DatasetConfig) -> Mapping[str, ExportFile]:
    """Return the files of the format ``plain`` for each eye of a config, by key; without colour, no image."""
    return {name: file for name, file in EXPORT_FILES.items() if config.colour is not None or file.column != "rgb"}
