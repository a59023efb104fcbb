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
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.importing.import_layout import VIEW, Layout
from dataset_builder.importing.source_files import Grid, checked_pose
from rebar_depth_bench.base.errors import CalibrationError, EntryError, InputError, Problem, escape_text
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import UNITS_M, short_repr, with_lines
from rebar_depth_bench.captures.calibration import Calibration, scaled_calibration, table_calibration
from rebar_depth_bench.captures.fields import Field, FileFormat, plain_key
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import HALF_PIXEL

_UNIT = "depth_unit_scale_factor"
_LENS = "no other lens: undistort images and depth maps first, and state the new K"
_MODELS = ("OPENCV", "RADIAL", "SIMPLE_RADIAL", "PINHOLE", "SIMPLE_PINHOLE")

BOP = FileFormat(
    "BOP `scene_camera.json`",
    (
        Field("K", ("cam_K",), "used", "K row by row, pixels"),
        Field("unit", ("depth_scale",), "used", "millimetres of one unit of the depth map"),
        Field("rotation", ("cam_R_w2c",), "used", "rotation from the world to the camera, row by row"),
        Field("translation", ("cam_t_w2c",), "used", "translation from the world to the camera, millimetres"),
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
        Field("fx", ("fl_x",), "used", "focal length, pixels"),
        Field("fy", ("fl_y",), "used", "focal length, pixels; default: that of x"),
        Field("angle_x", ("camera_angle_x",), "used", "field of view, radians; checked beside `fl_x`"),
        Field("angle_y", ("camera_angle_y",), "used", "field of view, radians; left out beside `fl_y`"),
        Field("cx", ("cx",), "used", "principal point, pixels; default: the middle of the image"),
        Field("cy", ("cy",), "used", "principal point, pixels; default: the middle of the image"),
        *(Field(key, (key,), "used", "lens distortion of OpenCV") for key in ("k1", "k2", "p1", "p2", "k3")),
        *(Field(key, (key,), "used", "size of the images, that of the views") for key in ("w", "h")),
        Field("model", ("camera_model",), "used", f"{', '.join(_MODELS)}; {_LENS}"),
        Field(
            "lens", ("k4", "k5", "k6", "is_fisheye", "ftheta_p0", "latlong", "equirectangular"), "checked", _LENS
        ),
        Field("fov", ("x_fov", "y_fov"), "checked", "fl_x and fl_y in its place"),
        Field("shutter", ("rolling_shutter", "transform_matrix_start"), "checked", "one pose for each image"),
        Field("axes", ("from_na", "normal_mts_args"), "checked", "none: OpenGL axes"),
        Field("unit", (_UNIT, "integer_depth_scale"), "used", "metres of one unit of depth"),
        Field("depth", ("depth_file_path", "depth_path"), "used", "depth map with this unit"),
        Field("files", ("mask_path", "normal_file_path", "ply_file_path"), "harmless", "further files"),
        Field("splits", ("train_filenames", "val_filenames", "test_filenames", "n_frames"), "harmless", "subsets"),
        Field("region", ("aabb_scale", "aabb", "offset", "up", "orientation_override"), "harmless", "the scene"),
        Field("origin", ("sharpness", "colmap_im_id", "rotation", "time"), "harmless", "how an image was taken"),
    ),
)
_FACTORS = (1e-9, 1e6)
"""Smallest and largest factor of a length."""
_MAX_ANGLE_DEVIATION = 0.01
"""Largest relative deviation between the focal lengths of ``fl_x`` and of ``camera_angle_x``."""


@dataclass(frozen=True, eq=False)
class ViewCameras:
    """Cameras by view: calibrations for the image size, and poses and metres of one unit of depth, if stated.

    ``board`` is None if no file states it; ``notes`` say what was left out.
    """

    calibrations: Mapping[str, Calibration]
    cam_from_world: Mapping[str, Float64[ndarray, "4 4"]]
    depth_unit_m: Mapping[str, float]
    board: BoardSpec | None
    notes: tuple[str, ...]


class _Camera(NamedTuple):
    """Camera of a view; the unit is NaN if it is not stated, which may be fine. ``note`` may be empty."""

    calibration: Calibration
    cam_from_world: Float64[ndarray, "4 4"] | None
    depth_unit_m: float
    needs_unit: bool
    note: str = ""


def read_view_cameras(path: Path, layout: Layout, names: Sequence[str], grid: Grid) -> ViewCameras:
    """Return the cameras of the views ``names`` of a layout, with images of ``grid``, that a file states.

    Raises ``InputError`` for a file of another format, for a view without an entry or with several, for an entry
    that is no camera of the images, and for poses or units that contradict each other or the layout.
    """
    content = read_file(path, JSON_BYTES, "the cameras of all views", InputError)
    document, problems = parse_json(content)
    where = ""
    try:
        if problems:
            raise EntryError(problems[0])
        entries = _entries(document)
        matches, cameras = _matches(entries, layout, names), dict[str, _Camera]()
        is_bop = "frames" not in document
        file_format, whole = (BOP, {}) if is_bop else (NERFSTUDIO, {**document, "frames": None})
        for name, place in matches.items():
            where = place
            values = _values(file_format, whole, entries[where])
            cameras[name] = _bop_camera(values, grid) if is_bop else _frame_camera(values, grid, layout, name)
        where = ""
        _check_together(cameras, layout, file_format.keys("unit")[0])
    except InputError as error:
        found = [replace(one, where=": ".join(filter(None, (where, one.where)))) for one in error.problems]
        raise InputError.from_problems(path, with_lines(found, content)) from None
    keys = dict.fromkeys([*whole, *(key for where in matches.values() for key in entries[where])])
    notes = [*file_format.notes(path.name, keys), *dict.fromkeys(one.note for one in cameras.values() if one.note)]
    if others := len(entries) - len(names):
        notes.append(f"{path.name}: {others} of {len(entries)} entries are those of no view")
    return ViewCameras(
        {name: one.calibration for name, one in cameras.items()},
        {name: one.cam_from_world for name, one in cameras.items() if one.cam_from_world is not None},
        {name: one.depth_unit_m for name, one in cameras.items() if not math.isnan(one.depth_unit_m)},
        None,
        tuple(notes),
    )


def _entries(document: Any) -> dict[str, Any]:
    """Return the entries by their location in the file. Raises ``EntryError`` for a file of another format."""
    entries = document if isinstance(document, dict) else {}
    needed = "cam_K"
    if isinstance(entries.get("frames"), list):
        entries, needed = {f"frames {n}": frame for n, frame in enumerate(entries["frames"], start=1)}, "file_path"
    elif not all(re.fullmatch("[0-9]+", key) for key in entries):
        entries = {}
    if not entries:
        keys = ", ".join(map(escape_text, [*document][:5])) if isinstance(document, dict) else ""
        expected = "BOP's scene_camera.json, whose keys are image ids, or nerfstudio's transforms.json with frames"
        raise EntryError(Problem("invalid", "", f"has the keys {keys or 'of no table'}", expected))
    for where, entry in entries.items():
        if not isinstance(entry, dict) or not isinstance(entry.get(needed), list if needed == "cam_K" else str):
            raise EntryError(Problem("invalid", where, f"got {short_repr(entry)}", f"a table with {needed}"))
    return entries


def _matches(entries: Mapping[str, Any], layout: Layout, names: Sequence[str]) -> dict[str, str]:
    """Return the location of the entry of each view. Raises ``EntryError`` if a view has none, or several.

    An image id is the name of a view, both without leading zeros. The name or the stem of ``file_path`` is the
    name of a view or the stem of one of its files.
    """
    locations, is_bop = defaultdict[str, list[str]](list), "frames 1" not in entries
    for where, entry in entries.items():
        image = PureWindowsPath("" if is_bop else entry["file_path"])  # It reads both separators.
        for key in {where.lstrip("0")} if is_bop else {image.name, image.stem}:
            locations[key].append(where)
    stems = [VIEW, *(PurePosixPath(pattern).stem for pattern in layout.files.patterns.values())]
    found = {}
    for name in names:
        keys = dict.fromkeys(stem.replace(VIEW, name) for stem in stems if VIEW in stem)
        places = [where for key in keys for where in locations.get(key.lstrip("0") if is_bop else key, ())]
        found[name] = sorted(set(places))
    for name, places in found.items():
        if len(places) > 1:
            problem = f"view {name} has {len(places)} entries: {', '.join(places[:5])}"
            raise EntryError(Problem("duplicate", "", problem, "one"))
    if missing := [name for name, places in found.items() if not places]:
        problem = f"{len(missing)} of {len(names)} views have no entry, such as {missing[0]}"
        expected = f"names as in the file, such as {escape_text(next(iter(locations)) or '0')}"
        raise EntryError(Problem("missing", "", problem, expected))
    return {name: places[0] for name, places in found.items()}


def _values(file_format: FileFormat, *tables: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the whole file and of an entry by the first key of their fields, without null.

    Raises ``EntryError`` for a field that must not be there, and for values that differ between both tables.
    """
    values: dict[str, Any] = {}
    for table in tables:
        plain = {plain_key(key): value for key, value in table.items() if value is not None}
        for field in file_format.fields:
            for key in [key for key in field.keys if plain_key(key) in plain]:
                value = plain[plain_key(key)]
                if field.use == "checked" and (any(value) if isinstance(value, list) else value):
                    raise EntryError(Problem("invalid", key, f"got {short_repr(value)}", field.meaning))
                if field.use == "used" and values.setdefault(field.keys[0], value) != value:
                    found = f"got {short_repr(values[field.keys[0]])} and {short_repr(value)}"
                    raise EntryError(Problem("conflict", key, found, "one value, of the file or of the frame"))
    return values


def _numbers(
    values: Mapping[str, Any], key: str, sizes: Sequence[int], low: float = -1e9, high: float = 1e9
) -> Float64[ndarray, " n"] | None:
    """Return the numbers of a field row by row, or None without it. Raises ``EntryError`` for any other value."""
    if key not in values:
        return None
    try:
        numbers = np.array(values[key])
    except ValueError:  # The rows have several lengths.
        numbers = np.array(None)
    if (
        numbers.dtype.kind not in "iuf"
        or numbers.size not in sizes
        or not ((low <= numbers) & (numbers <= high)).all()
    ):
        expected = f"{' or '.join(map(str, sizes))} numbers from {low:g} to {high:g}"
        raise EntryError(Problem("invalid", key, f"got {short_repr(values[key])}", expected))
    return numbers.astype(np.float64).ravel()


def _number(
    values: Mapping[str, Any], key: str, default: float = math.nan, low: float = -1e9, high: float = 1e9
) -> float:
    """Return the number of a field, or the default. Raises ``EntryError`` as ``_numbers``."""
    numbers = _numbers(values, key, (1,), low, high)
    return default if numbers is None else float(numbers[0])


def _bop_camera(values: Mapping[str, Any], grid: Grid) -> _Camera:
    """Return the camera of BOP's values. Raises ``InputError``."""
    K = _numbers(values, "cam_K", (9,))
    rotation, translation = _numbers(values, "cam_R_w2c", (9,)), _numbers(values, "cam_t_w2c", (3,))
    if (rotation is None) != (translation is None):
        raise EntryError(Problem("missing", "", "has one of cam_R_w2c and cam_t_w2c", "both, or none"))
    pose = None
    if rotation is not None and translation is not None:
        pose = checked_pose(np.c_[rotation.reshape(3, 3), translation], "cam_R_w2c", unit_m=UNITS_M["mm"])
    lens = {"K": None if K is None else K.reshape(3, 3).tolist(), "distortion": [0.0] * 4}
    unit_m = _number(values, "depth_scale", math.nan, *_FACTORS) * UNITS_M["mm"]
    return _Camera(_calibration(lens, grid), pose, unit_m, needs_unit=True)


def _frame_camera(values: Mapping[str, Any], grid: Grid, layout: Layout, name: str) -> _Camera:
    """Return the camera of nerfstudio's values for a view of a layout. Raises ``InputError``."""
    if (model := values.get("camera_model", _MODELS[0])) not in _MODELS:
        raise EntryError(
            Problem("invalid", "camera_model", f"got {short_repr(model)}", f"{', '.join(_MODELS)}: {_LENS}")
        )
    lens: dict[str, Any] = {"distortion": [_number(values, key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]}
    for axis, side, side_px in (("x", "w", grid[1]), ("y", "h", grid[0])):
        if _number(values, side, side_px) != side_px:
            expected = f"{side_px} as the images: scale them, or w, h, fl_x, fl_y, cx and cy"
            raise EntryError(Problem("size", side, f"got {short_repr(values[side])}", expected))
        by_angle = side_px / 2 / math.tan(_number(values, f"camera_angle_{axis}", math.nan, 0.001, 3.14) / 2)
        focal = _number(values, f"fl_{axis}", by_angle)
        if axis == "x" and abs(focal - by_angle) > _MAX_ANGLE_DEVIATION * abs(by_angle):
            found = f"got {focal:g}, and {by_angle:g} by camera_angle_x"
            raise EntryError(Problem("conflict", "fl_x", found, "the same focal length: remove the wrong key"))
        lens[f"f{axis}"] = lens["fx"] if math.isnan(focal) and axis == "y" else focal
        lens[f"c{axis}"] = _number(values, f"c{axis}", side_px / 2) - HALF_PIXEL
    if math.isnan(lens["fx"]):
        raise EntryError(Problem("missing", "fl_x", "missing", "fl_x, or camera_angle_x"))
    moved, numbers = (_numbers(values, key, (12, 16)) for key in ("applied_transform", "transform_matrix"))
    if layout.bars is not None and moved is not None and not np.array_equal(moved[:12], np.eye(4).ravel()[:12]):
        expected = "surveyed bars in the moved world: move them by it, then remove the key"
        raise EntryError(Problem("conflict", "applied_transform", "the world was moved", expected))
    pose = None
    if numbers is not None:
        unit = 1 / _number(values, "applied_scale", 1.0, *_FACTORS)
        pose = checked_pose(numbers.reshape(-1, 4), "transform_matrix", "world_from_cam", "opengl", unit)
    unit_m, depth_file = _number(values, _UNIT, math.nan, *_FACTORS), layout.files.left_depth.replace(VIEW, name)
    stated = values.get("depth_file_path", depth_file)
    if not isinstance(stated, str) or PureWindowsPath(stated).name == PurePosixPath(depth_file).name:
        return _Camera(_calibration(lens, grid), pose, unit_m, needs_unit="depth_file_path" in values)
    note = "" if math.isnan(unit_m) else f"{_UNIT} is that of {escape_text(stated)}, not of {depth_file}"
    return _Camera(_calibration(lens, grid), pose, math.nan, needs_unit=False, note=note)


def _calibration(lens: Mapping[str, Any], grid: Grid) -> Calibration:
    """Return the calibration of a table ``[left]`` for images of ``grid``. Raises ``CalibrationError``."""
    problems: list[Problem] = []
    height, width = grid
    calibration = table_calibration({"left": lens}, width, height, problems, is_stereo=False)
    if calibration is None:
        raise CalibrationError.from_problems("", problems)
    return scaled_calibration(calibration, "", width, height)


def _check_together(cameras: Mapping[str, _Camera], layout: Layout, unit_key: str) -> None:
    """Raise ``EntryError`` if poses or units of views contradict each other or the layout."""
    unposed = [name for name, one in cameras.items() if one.cam_from_world is None]
    if unposed and (layout.bars is not None or len(unposed) < len(cameras)):
        found = f"{len(unposed)} of {len(cameras)} views have no pose, such as {unposed[0]}"
        raise EntryError(Problem("missing", "", found, "poses of all views, or of none in a layout without bars"))
    has_unit = layout.depth.unit is not None or layout.depth.scale is not None
    if has_unit and not all(math.isnan(one.depth_unit_m) for one in cameras.values()):
        expected = f"one of them: remove depth.unit and depth.scale from the layout, or {unit_key}"
        raise EntryError(Problem("conflict", unit_key, "given beside depth.unit or depth.scale", expected))
    lacking = [name for name, one in cameras.items() if one.needs_unit and math.isnan(one.depth_unit_m)]
    if lacking and not has_unit:
        found = f"missing for {len(lacking)} of {len(cameras)} views, such as {lacking[0]}"
        raise EntryError(Problem("missing", unit_key, found, "it, or depth.unit or depth.scale in the layout"))
