"""Readers of files of other programs: depth maps, labels, matrices and surveyed bars."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Shaped, UInt16
from numpy import ndarray

from dataset_builder.importing.import_layout import DepthTable, MatricesTable, PosesTable
from rebar_depth_bench.base.errors import (
    EntryError,
    InputError,
    Problem,
    escape_text,
    exception_summary,
    format_shape,
)
from rebar_depth_bench.base.limits import CELL_BYTES, TABLE_BYTES, TOML_BYTES
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import UNITS_M, short_repr
from rebar_depth_bench.captures.calibration import Calibration, StereoCalibration
from rebar_depth_bench.captures.images import check_upright
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.cameras import (
    inverse_rigid,
    is_rigid,
    nearest_rotation,
    pixel_rays,
    swap_camera_axes,
)
from rebar_depth_bench.submission.entries import FORMATS

Grid = tuple[int, int]
"""Height and width of an image, pixels."""

_IMAGE_FORMATS = {".tif": "TIFF", ".tiff": "TIFF", ".pfm": "PPM", ".png": "PNG"}
"""Pillow's names of formats."""

DEPTH_SUFFIXES = (*FORMATS, *(suffix for suffix in _IMAGE_FORMATS if suffix not in FORMATS))
LABEL_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
MATRIX_SUFFIXES = (".txt", ".npy", ".json")

_MAX_BAR_ID = np.iinfo(np.uint16).max
_ROUNDED_ROTATION = 1e-3
"""Largest deviation of ``R @ R.T`` from the identity in files with few digits; the rotation is made exact."""
_BAR_NUMBERS = ("diameter_m", "x_m", "y_m", "z_m")
_DEFAULT_ROLE = "surveyed"


@contextmanager
def _damage(path: Path, expected: str) -> Iterator[None]:
    """Convert the errors of decoders, many types that depend on the damage, to ``EntryError``."""
    try:
        yield
    except EntryError:
        raise
    except Exception as error:
        reason = escape_text(str(error) or type(error).__name__)
        raise EntryError(Problem("damaged", path.name, f"cannot be read: {reason}", expected)) from None


def read_depth(path: Path, grid: Grid, table: DepthTable, factor: float) -> Float64[ndarray, "h w"]:
    """Return the values of a depth map of ``grid`` times ``factor``; NaN where there is none.

    Raises ``EntryError`` for a damaged file, and for one of another size.
    """
    suffix = path.suffix.lower()
    content = read_file(path, CELL_BYTES, "a depth map", InputError)
    check_upright(io.BytesIO(content), path.name)
    if suffix == ".exr" and table.channel is not None:
        values = _exr_channel(path, table.channel)
    elif suffix in FORMATS:
        values = FORMATS[suffix].decode(path.name, memoryview(content), grid, 1.0)
    else:
        values = _pixels(path, content)
    _check_grid(path, values, grid)
    with np.errstate(invalid="ignore"):  # A damaged file may hold NaN that signal.
        units = values.astype(np.float64)
    units[~np.isfinite(units) | (units <= 0) | np.isin(units, table.invalid)] = np.nan
    with np.errstate(over="ignore"):
        return np.asarray(units * factor)


def planar_depth_m(
    values: Float64[ndarray, "h w"],
    kind: str,
    calibration: Calibration,
    K: Float64[ndarray, "3 3"],
    distortion: Float64[ndarray, " 5"],
) -> Float32[ndarray, "h w"]:
    """Return the values of a depth map as planar depth, metres, 0 without depth.

    Range is divided by the length of the ray (x, y, 1) of its pixel in the camera with ``K`` and ``distortion``.
    Disparity d is that of the left pixel to the right: z = fx B / (d + cx_right - cx_left). Raises ``InputError``
    as ``rectified_pair`` does, and ``EntryError`` for a lens model that cannot be inverted at a pixel.
    """
    if kind == "range":
        height, width = values.shape
        try:
            rays = pixel_rays(K, width, height, distortion)
        except ValueError as error:
            raise EntryError(Problem("invalid", "K", str(error), "a lens that sees every pixel")) from None
        values = values / np.linalg.norm(rays, axis=-1)
    if kind == "disparity":
        pair = rectified_pair(calibration)
        with np.errstate(divide="ignore", over="ignore"):
            offset_px = pair.right.cx - pair.left.cx
            values = pair.left.fx * -pair.translation_m[0] / (values + offset_px)
    with np.errstate(over="ignore"):
        stored = values.astype(np.float32)
    return np.where(np.isfinite(stored) & (stored > 0), stored, np.float32(0))


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


def _pixels(path: Path, content: bytes) -> Shaped[ndarray, "h w"]:
    """Return the values of a TIFF, PNG or PFM image with one channel. Raises ``EntryError`` for other images."""
    from PIL import Image

    image_format = _IMAGE_FORMATS[path.suffix.lower()]
    with _damage(path, image_format), warnings.catch_warnings():
        warnings.simplefilter("error")  # Pillow warns of huge images before it decodes them.
        with Image.open(io.BytesIO(content), formats=[image_format]) as image:
            values = np.asarray(image)
    if values.ndim != 2 or values.dtype.kind not in "buif":
        found = f"has values of type {values.dtype} and shape {values.shape}"
        raise EntryError(Problem("invalid", path.name, found, "one channel"))
    return values


def _exr_channel(path: Path, channel: str) -> Shaped[ndarray, "h w"]:
    """Return one channel of an EXR file with several. Raises ``EntryError`` if it has no such channel."""
    import OpenEXR

    with _damage(path, "EXR"), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels()
        if channel in channels:
            return np.asarray(channels[channel].pixels)
    found = f"has the channels {', '.join(map(escape_text, list(channels)[:10]))}"
    raise EntryError(Problem("missing", path.name, found, channel))


def _read_matrix(path: Path, key: str | None, shape: tuple[int, int]) -> Float64[ndarray, "n m"]:
    """Return the matrix in a file, of ``shape`` or, for poses, without its last row.

    ``key`` is that of a JSON object. Raises ``EntryError`` for anything but finite numbers.
    """
    content, suffix = read_file(path, TOML_BYTES, "a matrix", InputError), path.suffix.lower()
    with _damage(path, "numbers"):
        if suffix == ".npy":
            numbers: object = _npy(path, content)
        elif suffix == ".json":
            numbers = _json_value(content, key)
        else:
            numbers = np.loadtxt(io.StringIO(content.decode().replace(",", " ")), ndmin=2)
        values = np.asarray(numbers, dtype=np.float64)
    if values.size == 12 and shape == (4, 4):
        shape = 3, 4
    if values.size != shape[0] * shape[1] or not np.isfinite(values).all():
        found = f"holds {values.size} numbers"
        raise EntryError(Problem("invalid", path.name, found, f"{shape[0]} x {shape[1]} finite numbers"))
    return values.reshape(shape)


def _json_value(content: bytes, key: str | None) -> object:
    """Return the value of a JSON object at a key, whose parts are joined by dots."""
    value, problems = parse_json(content)
    if problems:
        raise EntryError(problems[0])
    for part in key.split(".") if key is not None else ():
        if not isinstance(value, dict) or part not in value:
            raise ValueError(f"it has no key {key}")
        value = value[part]
    return value


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


def read_bars_file(path: Path) -> tuple[Bar, ...]:
    """Return the bars of a CSV file with the columns bar_id, diameter_m, x_m, y_m, z_m and, if wanted, role.

    Each line is a point of an axis, in order. Raises ``InputError`` with all problems, which name the line.
    """
    import pandas as pd

    content = read_file(path, TABLE_BYTES, "a CSV file of bars", InputError)
    try:
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False, skipinitialspace=True)
    except ValueError as error:  # Errors of pandas' parser and of decoding are ValueErrors.
        problem = Problem("syntax", "", f"no CSV file: {escape_text(exception_summary(error))}")
        raise InputError.from_problems(path, [problem]) from None
    problems = [
        Problem("missing", name, "missing", "a column") for name in ("bar_id", *_BAR_NUMBERS) if name not in table
    ]
    if problems:
        raise InputError.from_problems(path, problems)
    numbers = table[["bar_id", *_BAR_NUMBERS]].apply(pd.to_numeric, errors="coerce").to_numpy(np.float64)
    ids, sizes = numbers[:, 0], numbers[:, 1:]
    sound_id = np.isfinite(ids) & (ids == np.round(ids)) & (ids >= 1) & (ids <= _MAX_BAR_ID)
    sound = sound_id & np.isfinite(sizes).all(axis=1) & (sizes[:, 0] > 0) & (np.abs(sizes) < 1e6).all(axis=1)
    for row in np.flatnonzero(~sound):
        expected = f"a bar_id from 1 to {_MAX_BAR_ID}, a diameter above 0 and finite coordinates"
        found = f"line {row + 2}: got {escape_text(','.join(table.iloc[row]))}"
        problems.append(Problem("invalid", "", found, expected))
    roles = table.get("role")
    bars = []
    for bar_id in [] if problems else np.unique(ids).astype(int).tolist():
        rows = np.flatnonzero(ids == bar_id)
        role = _DEFAULT_ROLE if roles is None else roles.iloc[rows[0]]
        bars.append(_bar(bar_id, role, sizes[rows], problems))
    if not problems and not bars:
        problems.append(Problem("missing", "", "has no bars", "one or more"))
    if problems:
        raise InputError.from_problems(path, problems)
    return tuple(bars)


def _bar(bar_id: int, role: str, sizes: Float64[ndarray, "n 4"], problems: list[Problem]) -> Bar:
    """Return a bar of the diameter and the points in ``sizes``; problems are added to ``problems``."""
    diameters_m, axis_m = sizes[:, 0], sizes[:, 1:]
    if len(set(diameters_m.tolist())) > 1:
        problems.append(Problem("conflict", f"bar {bar_id}", "has several diameters", "one"))
    if len(axis_m) < 2 or not np.diff(axis_m, axis=0).any(axis=1).all():
        problems.append(
            Problem("invalid", f"bar {bar_id}", f"has {len(axis_m)} points", "two or more, no two the same")
        )
    points = tuple((float(x), float(y), float(z)) for x, y, z in axis_m)
    return Bar(bar_id, role, float(diameters_m[0]), points)
