"""Cameras of all views from one file: BOP's ``scene_camera.json`` or nerfstudio's ``transforms.json``.

BOP (bop_toolkit, ``docs/bop_datasets_format.md``; BlenderProc's ``write_bop``) has one entry for each image id, in
OpenCV's axes and millimetres, with pixel centres at integers. nerfstudio (its documentation, "Data conventions";
also instant-ngp, BlenderNeRF and NeRF's synthetic scenes) has one frame for each image, in OpenGL's axes; the
centre of the first pixel is (0.5, 0.5). Its intrinsics are those of the whole file or of each frame.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.importing.import_layout import VIEW, Layout
from dataset_builder.importing.source_files import Grid, checked_pose
from rebar_depth_bench.base.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import UNITS_M, short_repr
from rebar_depth_bench.captures.calibration import Calibration, scaled_calibration, table_calibration
from rebar_depth_bench.captures.fields import LENS_TERMS, RECTIFY_PAGE, unknown_keys_notes
from rebar_depth_bench.geometry.cameras import HALF_PIXEL

_UNIT = "depth_unit_scale_factor"
_LENS = f"no other lens: undistort images and depth maps first, {RECTIFY_PAGE}, and state the new K"
_MODELS = ("OPENCV", "RADIAL", "SIMPLE_RADIAL", "PINHOLE", "SIMPLE_PINHOLE")
_OTHER_LENS = ("k4", "k5", "k6", "is_fisheye", "ftheta_p0", "latlong", "equirectangular")
_OTHERS = ("x_fov", "y_fov", "rolling_shutter", "from_na", "integer_depth_scale")
_FURTHER = (
    *("mask_path", "normal_file_path", "ply_file_path", "train_filenames", "val_filenames", "test_filenames"),
    *("n_frames", "aabb_scale", "aabb", "offset", "up", "orientation_override"),
    *("sharpness", "colmap_im_id", "rotation", "time"),
)


@dataclass(frozen=True)
class Field:
    """Field of a format.

    ``use`` is "used" if the value becomes part of the result, "checked" if a file is refused unless the value is
    as ``meaning`` says, and "harmless" if it changes no number.
    """

    name: str
    keys: tuple[str, ...]
    use: Literal["used", "checked", "harmless"]
    meaning: str


@dataclass(frozen=True)
class FileFormat:
    """Format of a file of another program."""

    title: str
    fields: tuple[Field, ...]


BOP = FileFormat(
    "BOP `scene_camera.json`",
    (
        Field("K", ("cam_K",), "used", "K row by row, pixels"),
        Field("unit", ("depth_scale",), "used", "millimetres of one unit of the depth map"),
        Field("pose", ("cam_R_w2c", "cam_t_w2c"), "used", "from the world to the camera, millimetres"),
        Field("lens", ("cam_model",), "checked", _LENS),
        Field("sampling", ("elevation", "mode", "view_level"), "harmless", "how the view was chosen"),
    ),
)
NERFSTUDIO = FileFormat(
    "nerfstudio `transforms.json`",
    (
        Field("frames", ("frames",), "used", "a table for each image"),
        Field("image", ("file_path",), "used", "its stem is that of the view or of one of its files"),
        Field("pose", ("transform_matrix",), "used", "from the camera, in OpenGL axes, to the world"),
        Field("scale", ("applied_scale",), "used", "divides the translations, which gives metres"),
        Field("motion", ("applied_transform",), "used", "moved the world; refused beside surveyed bars"),
        Field("focal", ("fl_x", "fl_y"), "used", "focal length, pixels; that of y is by default that of x"),
        Field("angle", ("camera_angle_x", "camera_angle_y"), "used", "field of view, radians, instead of `fl_x`"),
        Field("centre", ("cx", "cy"), "used", "principal point, pixels; default: the middle"),
        Field("distortion", LENS_TERMS, "used", "lens distortion of OpenCV"),
        Field("size", ("w", "h"), "used", "size, which is that of the images"),
        Field("model", ("camera_model",), "used", f"{', '.join(_MODELS)}; {_LENS}"),
        Field("lens", _OTHER_LENS, "checked", _LENS),
        Field(
            "others", _OTHERS, "checked", f"only fl_x, fl_y, one pose for each image in OpenGL axes, and {_UNIT}"
        ),
        Field("unit", (_UNIT,), "used", "metres of one unit of depth"),
        Field("depth", ("depth_file_path",), "used", "depth map with this unit"),
        Field("further", _FURTHER, "harmless", "further files, subsets, region, and how an image was taken"),
    ),
)
_FACTORS = (1e-9, 1e6)
"""Smallest and largest factor of a length."""
_MAX_ANGLE_DEVIATION = 0.01
"""Largest relative deviation between the focal lengths of ``fl_x`` and of ``camera_angle_x``."""


class ViewCamera(NamedTuple):
    """Camera of a view: calibration for its image size, and pose and metres of one unit of depth, if stated."""

    calibration: Calibration
    cam_from_world: Float64[ndarray, "4 4"] | None = None
    depth_unit_m: float | None = None


def read_view_cameras(
    path: Path, layout: Layout, names: Sequence[str], grid: Grid
) -> tuple[dict[str, ViewCamera], tuple[str, ...]]:
    """Return the cameras that a file states of the views ``names`` of a layout with images of ``grid``, and notes.

    Raises ``InputError`` for a file of another format, for a view without an entry or with several, for an entry
    that is no camera of the images, and for poses or units that contradict each other or the layout.
    """
    content = read_file(path, JSON_BYTES, "the cameras of all views", InputError)
    document, problems = parse_json(content)
    entries = {} if problems else _entries(document, problems)
    is_bop = entries is document
    places = {} if problems else _places(entries, layout, names, problems)
    file_format, whole = (BOP, {}) if is_bop or problems else (NERFSTUDIO, {**document, "frames": None})
    cameras, height, width = dict[str, ViewCamera](), *grid
    for name, where in places.items():
        found = list[Problem]()
        try:
            values = _values(file_format, whole, entries[where])
            lens, pose, unit_m = _bop(values, layout) if is_bop else _nerfstudio(values, layout, name, grid)
            calibration = table_calibration({"left": lens}, width, height, found, is_stereo=False)
            if calibration is not None:
                cameras[name] = ViewCamera(scaled_calibration(calibration, path, width, height), pose, unit_m)
        except InputError as error:
            found += error.problems
        if found:  # The other entries often have the same problems.
            located = [f"{where}: {one.where.removeprefix('left.')}".removesuffix(": ") for one in found]
            problems = [replace(one, where=place) for one, place in zip(found, located, strict=True)]
            break
    unposed = [name for name, camera in cameras.items() if camera.cam_from_world is None]
    if unposed and not problems and (layout.bars is not None or len(unposed) < len(cameras)):
        reason = f"{len(unposed)} of {len(cameras)} views have no pose, such as {unposed[0]}"
        problems.append(Problem("missing", "", reason, "poses of all views, or of none in a layout without bars"))
    if problems:
        raise InputError.from_problems(path, problems)
    keys = dict.fromkeys([*whole, *(key for where in places.values() for key in entries[where])])
    known = [key for field in file_format.fields for key in field.keys]
    notes = unknown_keys_notes(path.name, keys, known)
    if _UNIT in keys and any(camera.depth_unit_m is None for camera in cameras.values()):
        notes.append(f"{path.name}: {_UNIT} is that of other depth maps, depth_file_path; [depth] states the unit")
    if len(entries) > len(names):
        notes.append(f"{path.name}: {len(entries) - len(names)} of {len(entries)} entries are those of no view")
    return cameras, tuple(notes)


def _entries(document: Any, problems: list[Problem]) -> dict[str, Any]:
    """Return the entries by their location in the file; problems are added to ``problems``."""
    entries, needed = document if isinstance(document, dict) else {}, "cam_K"
    if isinstance(entries.get("frames"), list):
        entries, needed = {f"frames {n}": one for n, one in enumerate(entries["frames"], start=1)}, "file_path"
    elif not all(re.fullmatch("[0-9]+", key) for key in entries):
        entries = {}
    if not entries:
        keys = ", ".join(map(escape_text, [*document][:5])) if isinstance(document, dict) else ""
        expected = "BOP's scene_camera.json, whose keys are image ids, or nerfstudio's transforms.json with frames"
        problems.append(Problem("invalid", "", f"has the keys {keys or 'of no table'}", expected))
    for where, entry in entries.items():
        if not isinstance(entry, dict) or needed not in entry:
            problems.append(Problem("invalid", where, f"got {short_repr(entry)}", f"a table with {needed}"))
    return entries


def _places(
    entries: Mapping[str, Any], layout: Layout, names: Sequence[str], problems: list[Problem]
) -> dict[str, str]:
    """Return the location of the entry of each view; problems are added to ``problems``.

    An image id is the name of a view, both without leading zeros. The name or the stem of ``file_path`` is the
    name of a view or the stem of one of its files.
    """
    locations = defaultdict[str, set[str]](set)
    for where, entry in entries.items():
        image = PureWindowsPath(str(entry.get("file_path", where.lstrip("0"))))  # It reads both separators.
        locations[image.name].add(where)
        locations[image.stem].add(where)
    stems = [VIEW, *(PurePosixPath(pattern).stem for pattern in layout.files.patterns.values())]
    places = {}
    for name in names:
        keys = {stem.replace(VIEW, name) for stem in stems if VIEW in stem}
        if "frames 1" not in entries:
            keys = {key.lstrip("0") for key in keys}
        places[name] = sorted(set().union(*(locations.get(key, ()) for key in keys)))
    missing = [name for name, found in places.items() if not found]
    if missing:
        reason = f"{len(missing)} of {len(names)} views have no entry, such as {missing[0]}"
        expected = f"names as in the file, such as {escape_text(next(iter(locations)) or '0')}"
        problems.append(Problem("missing", "", reason, expected))
    for name, found in places.items():
        if len(found) > 1:
            reason = f"view {name} has {len(found)} entries: {', '.join(found[:5])}"
            problems.append(Problem("duplicate", "", reason, "one"))
    return {} if problems else {name: found[0] for name, found in places.items()}


def _values(file_format: FileFormat, whole: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the whole file and of an entry, without null.

    Raises ``EntryError`` for a field that must not be there, and for values that differ between both tables.
    """
    values = {key: value for key, value in {**whole, **entry}.items() if value is not None}
    for field in file_format.fields:
        for key in filter(values.__contains__, field.keys):
            value, other = values[key], whole.get(key)
            if field.use == "checked" and (any(value) if isinstance(value, list) else value):
                raise EntryError(Problem("invalid", key, f"got {short_repr(value)}", field.meaning))
            if field.use == "used" and other is not None and other != value:
                found = f"got {short_repr(other)} and {short_repr(value)}"
                raise EntryError(Problem("conflict", key, found, "one value, of the file or of the frame"))
    return values


def _numbers(
    values: Mapping[str, Any], key: str, sizes: Sequence[int], low: float = -1e9, high: float = 1e9
) -> Float64[ndarray, " n"]:
    """Return the numbers of a field row by row. Raises ``EntryError`` if it is missing or has another value."""
    try:
        numbers = np.array(values.get(key))
    except ValueError:  # The rows have several lengths.
        numbers = np.array(None)
    is_sound = numbers.dtype.kind in "iuf" and numbers.size in sizes
    if not is_sound or numbers.min() < low or numbers.max() > high:
        found = f"got {short_repr(values[key])}" if key in values else "missing"
        expected = f"{' or '.join(map(str, sizes))} numbers from {low:g} to {high:g}"
        raise EntryError(Problem("invalid" if key in values else "missing", key, found, expected))
    return numbers.astype(np.float64).ravel()


def _number(values: Mapping[str, Any], key: str, default: float, low: float = -1e9, high: float = 1e9) -> float:
    """Return the number of a field, or the default without it. Raises ``EntryError`` as ``_numbers``."""
    return float(_numbers(values, key, (1,), low, high)[0]) if key in values else default


def _unit(values: Mapping[str, Any], key: str, layout: Layout, *, is_needed: bool) -> float | None:
    """Return the unit of depth at a key, or None. Raises ``EntryError`` for one beside the layout's, or none."""
    is_stated = layout.depth.unit is not None or layout.depth.scale is not None
    if is_stated and key in values:
        expected = f"one of them: remove depth.unit and depth.scale from the layout, or {key} here"
        raise EntryError(Problem("conflict", key, "given beside depth.unit or depth.scale", expected))
    if is_needed and not is_stated and key not in values:
        raise EntryError(Problem("missing", key, "missing", "it, or depth.unit or depth.scale in the layout"))
    return _number(values, key, 1.0, *_FACTORS) if key in values else None


_Parts = tuple[dict[str, Any], Float64[ndarray, "4 4"] | None, float | None]
"""Table ``[left]`` of a calibration, pose, and unit of depth of a view."""


def _bop(values: Mapping[str, Any], layout: Layout) -> _Parts:
    """Return the parts of a camera by BOP's values. Raises ``EntryError``."""
    pose, unit_mm = None, _unit(values, "depth_scale", layout, is_needed=True)
    if "cam_R_w2c" in values or "cam_t_w2c" in values:
        rotation, translation = _numbers(values, "cam_R_w2c", (9,)), _numbers(values, "cam_t_w2c", (3,))
        pose = checked_pose(np.c_[rotation.reshape(3, 3), translation], "cam_R_w2c", unit_m=UNITS_M["mm"])
    lens = {"K": _numbers(values, "cam_K", (9,)).reshape(3, 3).tolist(), "distortion": [0.0] * 4}
    return lens, pose, None if unit_mm is None else unit_mm * UNITS_M["mm"]


def _nerfstudio(values: Mapping[str, Any], layout: Layout, name: str, grid: Grid) -> _Parts:
    """Return the parts of a camera by nerfstudio's values. Raises ``EntryError``."""
    if (model := values.get("camera_model", _MODELS[0])) not in _MODELS:
        expected = f"{', '.join(_MODELS)}; {_LENS}"
        raise EntryError(Problem("invalid", "camera_model", f"got {short_repr(model)}", expected))
    lens: dict[str, Any] = {"distortion": [_number(values, key, 0.0) for key in LENS_TERMS]}
    for axis, side, side_px in (("x", "w", grid[1]), ("y", "h", grid[0])):
        if _number(values, side, side_px) != side_px:
            expected = f"{side_px} as the images: scale them, or w, h, fl_x, fl_y, cx and cy"
            raise EntryError(Problem("size", side, f"got {short_repr(values[side])}", expected))
        by_angle = side_px / 2 / math.tan(_number(values, f"camera_angle_{axis}", math.nan, 0.001, 3.14) / 2)
        focal = _number(values, f"fl_{axis}", by_angle)
        if axis == "x" and abs(focal - by_angle) > _MAX_ANGLE_DEVIATION * by_angle:
            found = f"got {focal:g}, and {by_angle:g} by camera_angle_x"
            raise EntryError(Problem("conflict", "fl_x", found, "the same focal length: remove the wrong key"))
        lens[f"f{axis}"] = lens["fx"] if axis == "y" and math.isnan(focal) else focal
        lens[f"c{axis}"] = _number(values, f"c{axis}", side_px / 2) - HALF_PIXEL
    if math.isnan(lens["fx"]):
        raise EntryError(Problem("missing", "fl_x", "missing", "fl_x, or camera_angle_x"))
    moved = _numbers({"applied_transform": np.eye(4), **values}, "applied_transform", (12, 16)).reshape(-1, 4)
    if layout.bars is not None and not np.array_equal(moved[:3], np.eye(4)[:3]):
        expected = "surveyed bars in the moved world: move them by it, then remove the key"
        raise EntryError(Problem("conflict", "applied_transform", "the world was moved", expected))
    pose = None
    if "transform_matrix" in values:
        matrix = _numbers(values, "transform_matrix", (12, 16)).reshape(-1, 4)
        unit_m = 1 / _number(values, "applied_scale", 1.0, *_FACTORS)
        pose = checked_pose(matrix, "transform_matrix", "world_from_cam", "opengl", unit_m)
    depth_file = PurePosixPath(layout.files.left_depth.replace(VIEW, name)).name
    if PureWindowsPath(str(values.get("depth_file_path", depth_file))).name != depth_file:
        return lens, pose, None
    return lens, pose, _unit(values, _UNIT, layout, is_needed="depth_file_path" in values)
