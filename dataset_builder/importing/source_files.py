"""Readers of files of other programs: depth maps, labels and matrices."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Shaped, UInt16
from numpy import ndarray

from dataset_builder.importing.import_layout import DepthTable, MatricesTable, PosesTable
from rebar_depth_bench.base.errors import (
    EntryError,
    InputError,
    Problem,
    escape_text,
    format_shape,
    library_message,
)
from rebar_depth_bench.base.limits import CELL_BYTES, TOML_BYTES
from rebar_depth_bench.base.reading import decode_text, parse_json, read_file
from rebar_depth_bench.base.validation import UNITS_M, short_repr
from rebar_depth_bench.captures.calibration import Calibration, StereoCalibration
from rebar_depth_bench.captures.images import check_upright
from rebar_depth_bench.geometry.cameras import (
    inverse_rigid,
    is_rigid,
    nearest_rotation,
    pixel_rays,
    swap_camera_axes,
)
from rebar_depth_bench.submission.entries import FORMATS
from rebar_depth_bench.submission.maps import check_exr_windows, decode_exr, decode_npy, decode_npz, decode_png

Grid = tuple[int, int]
"""Height and width of an image, pixels."""

_IMAGE_FORMATS = {".tif": "TIFF", ".tiff": "TIFF", ".pfm": "PPM", ".png": "PNG"}
_PFM_OF_CR_LF = re.compile(rb"\A(Pf[ \t]*\r\n[^\r\n]*\r\n[^\r\n]*)\r\n")
"""Pillow's names of formats."""

DEPTH_SUFFIXES = (*FORMATS, *(suffix for suffix in _IMAGE_FORMATS if suffix not in FORMATS))
LABEL_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
MATRIX_SUFFIXES = (".txt", ".npy", ".json")

_MIN_DEPTH_M, _MAX_DEPTH_M = 1e-4, 1000.0
_TIFF_INTEGERS = ("L", "I;16", "I;16B", "I")
"""Pillow's modes of integers in TIFF files."""
_MAX_BAR_ID = np.iinfo(np.uint16).max
_ROUNDED_ROTATION = 1e-3
"""Largest deviation of ``R @ R.T`` from the identity in files with few digits; the rotation is made exact."""


@contextmanager
def _damage(path: Path, expected: str) -> Iterator[None]:
    """Convert the errors of decoders, many types that depend on the damage, to ``EntryError``."""
    try:
        yield
    except EntryError:
        raise
    except Exception as error:
        reason = library_message(error)
        raise EntryError(Problem("damaged", path.name, f"cannot be read: {reason}", expected)) from None


@dataclass
class DepthTally:
    """What is left out of depth maps: values of ``depth.invalid`` that occur, pixels beyond ``depth.max_m``."""

    invalid: set[float] = field(default_factory=set)
    beyond_px: int = 0


def read_depth(path: Path, grid: Grid, table: DepthTable, tally: DepthTally) -> Float64[ndarray, "h w"]:
    """Return the values of a depth map of ``grid`` in units of the file; NaN where there is none.

    Values of ``depth.invalid`` are rounded to the type of the file before they are compared, and the values that
    occur are added to ``tally``. Raises ``EntryError`` for a damaged file, for a map of another size, and for the
    largest value of an integer type or of half floats, which marks pixels without depth, unless it is one of the
    invalid values; with ``depth.max_m``, the largest half float is left out.
    """
    suffix, content = path.suffix.lower(), read_file(path, CELL_BYTES, "a depth map", InputError)
    check_upright(io.BytesIO(content), path.name)
    if suffix == ".exr" and table.channel is not None:
        values = _exr_channel(path, table.channel)
    elif suffix == ".exr":
        values = decode_exr(path.name, memoryview(content), grid)
    elif suffix == ".png":
        values = decode_png(path.name, memoryview(content), grid).astype(np.uint16)
    elif suffix in (".npy", ".npz"):
        decode = decode_npy if suffix == ".npy" else decode_npz
        values = decode(path.name, memoryview(content), grid, ints=True)
    else:
        values = _pixels(path, content, is_depth=True)
    _check_grid(path, values, grid)
    is_integer = values.dtype.kind in "iu"
    if is_integer or (values.dtype == np.float16 and table.max_m is None):
        largest = np.iinfo(values.dtype).max if is_integer else int(np.finfo(np.float16).max)
        count = int(np.count_nonzero(values == largest))
        if count and float(largest) not in table.invalid:
            found = f"{count} pixels have {largest}, the largest value of {values.dtype}, which marks no depth"
            remedy = f"depth.invalid with {largest}" + ("" if is_integer else ", or depth.max_m")
            raise EntryError(Problem("invalid", path.name, found, remedy))
    with np.errstate(invalid="ignore", over="ignore"):  # A damaged file may hold NaN that signal.
        units = values.astype(np.float64)
        marks = np.array(table.invalid, dtype=values.dtype if values.dtype.kind == "f" else np.float64)
    for value, mark in zip(table.invalid, marks.astype(np.float64).tolist(), strict=True):
        if (units == mark).any() or (np.isnan(mark) and np.isnan(units).any()):
            tally.invalid.add(value)
    units[~np.isfinite(units) | (units <= 0) | np.isin(units, marks)] = np.nan
    return units


def planar_depth_m(
    units: Float64[ndarray, "h w"],
    factor: float,
    kind: str,
    calibration: Calibration,
    K: Float64[ndarray, "3 3"],
    distortion: Float64[ndarray, " 5"],
) -> Float64[ndarray, "h w"]:
    """Return the values of a depth map times ``factor`` as planar depth, metres, NaN without depth.

    Range is divided by the length of the ray (x, y, 1) of its pixel in the camera with ``K`` and ``distortion``.
    Disparity d is measured from the left pixel to the right one: z = fx B / (d + cx_right - cx_left). Raises
    ``InputError`` as ``rectified_pair`` does.
    """
    with np.errstate(over="ignore"):
        values = units * factor
    if kind == "range":
        height, width = values.shape
        values = values / np.linalg.norm(pixel_rays(K, width, height, distortion), axis=-1)
    if kind == "disparity":
        pair = rectified_pair(calibration)
        with np.errstate(divide="ignore", over="ignore"):
            offset_px = pair.right.cx - pair.left.cx
            values = pair.left.fx * -pair.translation_m[0] / (values + offset_px)
    return values


def limited_depth_m(
    path: Path,
    units: Float64[ndarray, "h w"],
    depth_m: Float64[ndarray, "h w"],
    table: DepthTable,
    tally: DepthTally,
) -> Float32[ndarray, "h w"]:
    """Return planar depth as it is stored, 0 without depth; pixels beyond ``max_m`` are left out and counted.

    Raises ``EntryError`` for depth that no camera measures, below ``_MIN_DEPTH_M`` or, without ``max_m``, beyond
    ``_MAX_DEPTH_M``: the most frequent value of these pixels is named.
    """
    beyond = depth_m > (_MAX_DEPTH_M if table.max_m is None else table.max_m)
    if table.max_m is not None:
        tally.beyond_px += int(np.count_nonzero(beyond))
        depth_m, beyond = np.where(beyond, np.nan, depth_m), np.zeros_like(beyond)
    for outside, what in ((beyond, f"beyond {_MAX_DEPTH_M:g} m"), (depth_m < _MIN_DEPTH_M, "below 0.1 mm")):
        outside &= depth_m > 0
        if outside.any():
            values, counts = np.unique(units[outside], return_counts=True)
            value = float(values[counts.argmax()])
            with np.errstate(over="ignore"):
                named = f"{value:.9g}" if float(np.float32(value)) == value else repr(value)
            found = f"{outside.sum()} pixels have depth {what}, most often the value {named}"
            unit = "depth.scale" if table.kind == "disparity" else 'depth.unit (for example "mm")'
            remedy = f"{unit}, or depth.invalid = [{named}] if it marks no depth"
            remedy += ", or depth.max_m" if outside is beyond else ""
            raise EntryError(Problem("invalid", path.name, found, remedy))
    return np.where(depth_m > 0, depth_m, 0).astype(np.float32)


def rectified_pair(calibration: Calibration) -> StereoCalibration:
    """Return the calibration of a rectified pair, to which disparity refers. Raises ``InputError`` for others."""
    if isinstance(calibration, StereoCalibration) and calibration.is_rectified:
        return calibration
    raise InputError("depth.kind is disparity, which needs cameras of a rectified pair")


def read_labels(path: Path, grid: Grid) -> Shaped[ndarray, "h w"]:
    """Return the values of an image of labels, a steel mask or bar ids, of ``grid``.

    Raises ``EntryError`` for a damaged file, another size, and values that are not whole numbers.
    """
    content = read_file(path, CELL_BYTES, "an image of labels", InputError)
    check_upright(io.BytesIO(content), path.name)
    values = _npy(path, content) if path.suffix.lower() == ".npy" else _pixels(path, content)
    _check_grid(path, values, grid)
    if values.dtype.kind not in "bui":
        raise EntryError(Problem("invalid", path.name, f"has values of type {values.dtype}", "whole numbers"))
    return values


def bar_ids(path: Path, values: Shaped[ndarray, "h w"]) -> UInt16[ndarray, "h w"]:
    """Return labels as bar ids. Raises ``EntryError`` for values outside of 0 to 65535."""
    if values.min() < 0 or values.max() > _MAX_BAR_ID:
        found = f"has ids from {values.min()} to {values.max()}"
        raise EntryError(Problem("invalid", path.name, found, f"0 to {_MAX_BAR_ID}"))
    return values.astype(np.uint16)


def _check_grid(path: Path, values: ndarray, grid: Grid) -> None:
    """Raise ``EntryError`` if the image has another size than ``grid``."""
    if values.shape != grid:
        found = f"is {' x '.join(map(str, values.shape))} (H x W)"
        raise EntryError(Problem("size", path.name, found, f"{format_shape(grid)} as the first image"))


def _npy(path: Path, content: bytes) -> ndarray:
    with _damage(path, "an array"):
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))


def _pixels(path: Path, content: bytes, *, is_depth: bool = False) -> Shaped[ndarray, "h w"]:
    """Return the values of a TIFF, PNG or PFM image with one channel, in the type of the file.

    Raises ``EntryError`` for other images. As depth, pictures of a palette or of single bits are refused too.
    """
    from PIL import Image, UnidentifiedImageError

    # Pillow would take the line feed of the last line end for the first byte of the values.
    content = _PFM_OF_CR_LF.sub(rb"\1\n", content)
    image_format = _IMAGE_FORMATS[path.suffix.lower()]
    expected = f"{image_format} of float32 or of integers up to 32 bits, or .npy"
    with _damage(path, expected), warnings.catch_warnings():
        warnings.simplefilter("error")  # Pillow warns of huge images before it decodes them.
        try:
            with Image.open(io.BytesIO(content), formats=[image_format]) as image:
                tags, values, mode = dict(getattr(image, "tag_v2", {})), np.asarray(image), image.mode
                stored = _tiff_type(tags) if tags and mode in _TIFF_INTEGERS else values.dtype.newbyteorder("=")
        except UnidentifiedImageError:
            raise ValueError(f"no {image_format} image of a type that Pillow knows") from None
    if values.ndim != 2 or values.dtype.kind not in "buif" or (is_depth and mode in ("1", "P")):
        found = f"has values of type {values.dtype} and shape {values.shape}, Pillow's mode {mode}"
        raise EntryError(Problem("invalid", path.name, found, "one channel of numbers"))
    values = values.astype(values.dtype.newbyteorder("="))
    # Pillow has signed integers of 32 bits for unsigned ones and for those of 16 bits, and bytes for signed ones.
    return values.view(stored) if stored.itemsize == values.itemsize else values.astype(stored)


def _tiff_type(tags: Mapping[int, Any]) -> np.dtype[Any]:
    """Return the type of the values of a TIFF image by its tags BitsPerSample (258) and SampleFormat (339)."""
    bits, sample_format = tags.get(258, (1,))[0], tags.get(339, (1,))[0]
    if bits < 8 or (bits == 8 and tags.get(262) == 0):  # Pillow stretches or inverts them.
        raise ValueError(f"it has grey shades of {bits} bits, expected numbers")
    kind = {1: "u", 2: "i", 3: "f"}.get(sample_format)
    if kind is None:
        raise ValueError(f"its values have the SampleFormat {sample_format}, expected 1, 2 or 3")
    return np.dtype(f"{kind}{2 ** (bits - 1).bit_length() // 8}")  # 12 bits are read as 16.


def _exr_channel(path: Path, channel: str) -> Shaped[ndarray, "h w"]:
    """Return one channel of an EXR file with several.

    Raises ``EntryError`` if it has no such channel, and as ``check_exr_windows``.
    """
    import OpenEXR

    with _damage(path, "EXR"), OpenEXR.File(str(path), separate_channels=True) as file:
        channels, header = file.channels(), file.header()
        check_exr_windows(path.name, *(np.ravel(header[key]).tolist() for key in ("dataWindow", "displayWindow")))
        if channel in channels:
            return np.asarray(channels[channel].pixels)
    found = f"has the channels {', '.join(map(escape_text, list(channels)[:10]))}"
    raise EntryError(Problem("missing", path.name, found, channel))


def _read_matrix(path: Path, key: str | None, shape: tuple[int, int]) -> Float64[ndarray, "n m"]:
    """Return the matrix in a file, of ``shape`` or, for poses, without its last row.

    ``key`` has the keys of JSON objects, joined by dots. Raises ``EntryError`` for anything but finite numbers.
    """
    content, suffix = read_file(path, TOML_BYTES, "a matrix", InputError), path.suffix.lower()
    with _damage(path, "numbers with decimal points between blanks or commas"):
        if suffix == ".npy":
            numbers: Any = _npy(path, content)
        elif suffix == ".json":
            numbers, problems = parse_json(content)
            if problems:
                raise EntryError(problems[0])
            for part in key.split(".") if key is not None else ():
                if not isinstance(numbers, dict) or part not in numbers:
                    raise ValueError(f"it has no key {key}")
                numbers = numbers[part]
        else:
            text, problems = decode_text(content, path.name)
            if problems:
                raise EntryError(problems[0])
            numbers = np.loadtxt(io.StringIO(text.replace(",", " ")), ndmin=2)
        values = np.asarray(numbers, dtype=np.float64)
    if values.size == 12 and shape == (4, 4):
        shape = 3, 4
    if values.size != shape[0] * shape[1] or not np.isfinite(values).all():
        found = f"holds {values.size} numbers"
        raise EntryError(Problem("invalid", path.name, found, f"{shape[0]} x {shape[1]} finite numbers"))
    return values.reshape(shape)


def intrinsics(path: Path, table: MatricesTable) -> Float64[ndarray, "3 3"]:
    """Return the pinhole matrix K of a view, pixels. Raises ``EntryError`` for any other matrix."""
    K = _read_matrix(path, table.key, (3, 3))
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[0, 1] == K[1, 0] == 0 and (K[2] == (0, 0, 1)).all()):
        found = f"holds {short_repr(K.tolist())}"
        raise EntryError(Problem("invalid", path.name, found, "fx 0 cx, 0 fy cy, 0 0 1 with fx and fy above 0"))
    return K


def cam_from_world(path: Path, table: PosesTable) -> Float64[ndarray, "4 4"]:
    """Return a pose in OpenCV axes and metres. Raises ``EntryError`` for a matrix that is no rigid pose."""
    matrix = _read_matrix(path, table.key, (4, 4))
    return checked_pose(matrix, path.name, table.kind, table.axes, UNITS_M[table.unit])


def checked_pose(
    matrix: Float64[ndarray, "n 4"],
    where: str,
    kind: str = "cam_from_world",
    axes: str = "opencv",
    unit_m: float = 1.0,
) -> Float64[ndarray, "4 4"]:
    """Return a pose of 3 or 4 rows, whose kind and axes ``PosesTable`` names, in OpenCV axes and metres.

    Raises ``EntryError`` for a matrix that is no rigid pose.
    """
    pose = np.vstack([matrix, [0, 0, 0, 1]])[:4]
    if not is_rigid(pose, _ROUNDED_ROTATION):
        found = f"holds {short_repr(pose.tolist())}"
        raise EntryError(Problem("invalid", where, found, "a rotation, a translation, and 0 0 0 1"))
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    pose[:3, 3] *= unit_m
    if kind == "world_from_cam":
        pose = inverse_rigid(pose)
    return swap_camera_axes(pose) if axes == "opengl" else pose
