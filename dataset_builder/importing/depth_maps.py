"""Depth maps of other programs: files of any common format, and their conversion to planar depth in metres."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Shaped
from numpy import ndarray

from dataset_builder.importing.layout import DepthTable
from rebar_depth_bench.errors import EntryError, InputError, Problem, escape_text, format_shape
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.geometry.stereo_calibration import (
    Calibration,
    Lens,
    StereoCalibration,
    lens_distortion,
    lens_K,
)
from rebar_depth_bench.limits import CELL_BYTES
from rebar_depth_bench.reading import read_file
from rebar_depth_bench.submission.formats import FORMATS

Grid = tuple[int, int]
_PILLOW_FORMATS = {".tif": "TIFF", ".tiff": "TIFF", ".pfm": "PPM", ".png": "PNG"}
DEPTH_SUFFIXES = (*FORMATS, *(suffix for suffix in _PILLOW_FORMATS if suffix not in FORMATS))


def read_depth(path: Path, grid: Grid, table: DepthTable) -> Float64[ndarray, "h w"]:
    """Return the values of a depth map of ``grid`` (height, width) times its factor; NaN where there is none.

    Raises ``EntryError`` for a damaged file, and for one of another size.
    """
    suffix = path.suffix.lower()
    content = read_content(path, "a depth map")
    if suffix == ".exr" and table.channel is not None:
        values = _exr_channel(path, table.channel)
    elif suffix in FORMATS:
        values = FORMATS[suffix].decode(path.name, memoryview(content), grid, 1.0)
    else:
        values = read_pixels(path, content, _PILLOW_FORMATS[suffix])
    check_grid(path, values, grid)
    with np.errstate(invalid="ignore"):  # A damaged file may hold NaN that signal.
        units = values.astype(np.float64)
    units[~np.isfinite(units) | (units <= 0) | np.isin(units, table.invalid)] = np.nan
    with np.errstate(over="ignore"):
        return np.asarray(units * table.factor)


def depth_converter(
    table: DepthTable, calibration: Calibration
) -> Callable[[Float64[ndarray, "h w"], str], Float32[ndarray, "h w"]]:
    """Return the function that converts values of a depth map of an eye to planar depth, metres, 0 without depth.

    Range is divided by the length of the ray (x, y, 1) of its pixel. Disparity d is that of the left pixel to the
    right: z = fx B / (d + cx_right - cx_left). Raises ``InputError`` for disparity of cameras that are not
    rectified.
    """
    lenses = {"left": calibration.left}
    if isinstance(calibration, StereoCalibration):
        lenses["right"] = calibration.right
    if table.kind == "range":
        lengths = {eye: _ray_lengths(lens, calibration) for eye, lens in lenses.items()}
        return lambda values, eye: _stored(values / lengths[eye])
    if table.kind == "z":
        return lambda values, _: _stored(values)
    if not isinstance(calibration, StereoCalibration) or not _is_rectified(calibration):
        raise InputError("depth.kind is disparity, which needs cameras of a rectified pair")
    baseline_m, offset_px = -calibration.translation_m[0], calibration.right.cx - calibration.left.cx
    product = calibration.left.fx * baseline_m

    def from_disparity(values: Float64[ndarray, "h w"], _: str) -> Float32[ndarray, "h w"]:
        with np.errstate(divide="ignore", over="ignore"):
            return _stored(product / (values + offset_px))

    return from_disparity


def _stored(depth_m: Float64[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    with np.errstate(over="ignore"):
        stored = depth_m.astype(np.float32)
    return np.where(np.isfinite(stored) & (stored > 0), stored, np.float32(0))


def _ray_lengths(lens: Lens, calibration: Calibration) -> Float64[ndarray, "h w"]:
    rays = pixel_rays(lens_K(lens), calibration.width, calibration.height, lens_distortion(lens))
    return np.asarray(np.linalg.norm(rays, axis=-1))


def _is_rectified(calibration: StereoCalibration) -> bool:
    left, right = calibration.left, calibration.right
    moved = (*calibration.rotation_rad, *calibration.translation_m[1:], *left.distortion, *right.distortion)
    return (left.fx, left.fy, left.cy) == (right.fx, right.fy, right.cy) and not any(moved)


def read_content(path: Path, expected: str) -> bytes:
    """Return the content of a file. Raises ``InputError`` if it is missing, no regular file or too large."""
    return read_file(path, CELL_BYTES, expected, InputError)


def read_pixels(path: Path, content: bytes, image_format: str) -> Shaped[ndarray, "h w"]:
    """Return the values of a TIFF, PNG or PFM image with one channel. Raises ``EntryError`` for other images."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Pillow warns of huge images before it decodes them.
            with Image.open(io.BytesIO(content), formats=[image_format]) as image:
                values = np.asarray(image)
    except Exception as error:  # Pillow raises many types, which depend on the damage.
        reason = escape_text(str(error) or type(error).__name__)
        raise EntryError(Problem("damaged", path.name, f"cannot be decoded: {reason}", image_format)) from None
    if values.ndim != 2 or values.dtype.kind not in "buif":
        found = f"has values of type {values.dtype} and shape {values.shape}"
        raise EntryError(Problem("invalid", path.name, found, "one channel"))
    return values


def check_grid(path: Path, values: ndarray, grid: Grid) -> None:
    """Raise ``EntryError`` if the image has another size than ``grid`` (height, width)."""
    if values.shape != grid:
        found = f"is {' x '.join(map(str, values.shape))} (H x W)"
        raise EntryError(Problem("size", path.name, found, f"{format_shape(grid)} as the first image"))


def _exr_channel(path: Path, channel: str) -> Shaped[ndarray, "h w"]:
    """Return one channel of an EXR file with several."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels: Mapping[str, OpenEXR.Channel] = file.channels()
            names, pixels = list(channels), channels[channel].pixels if channel in channels else None
    except Exception as error:  # OpenEXR raises RuntimeError and others.
        reason = escape_text(str(error) or type(error).__name__)
        raise EntryError(Problem("damaged", path.name, f"cannot be decoded: {reason}", "EXR")) from None
    if pixels is None:
        found = f"has the channels {', '.join(map(escape_text, names[:10]))}"
        raise EntryError(Problem("missing", path.name, found, channel))
    return np.asarray(pixels)
