"""Cameras of all views from one file, BOP's ``scene_camera.json``.

The format (bop_toolkit, ``docs/bop_datasets_format.md``; BlenderProc's ``write_bop``) has one entry for each image
id, in OpenCV's axes and millimetres, with pixel centres at integers and without lens distortion.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.importing.import_layout import Layout
from dataset_builder.importing.source_files import Grid, checked_pose
from rebar_depth_bench.base.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import parse_json, read_file
from rebar_depth_bench.base.validation import UNITS_M, short_repr
from rebar_depth_bench.captures.calibration import Calibration, scaled_calibration, table_calibration
from rebar_depth_bench.captures.fields import RECTIFY_PAGE

_KNOWN = ("cam_K", "depth_scale", "cam_R_w2c", "cam_t_w2c", "cam_model", "elevation", "mode", "view_level")
_MAX_NAMED = 10


class ViewCamera(NamedTuple):
    """Camera of a view: calibration for its image size, and pose and metres of one unit of depth, if stated."""

    calibration: Calibration
    cam_from_world: Float64[ndarray, "4 4"] | None = None
    depth_unit_m: float | None = None


def read_view_cameras(
    path: Path, layout: Layout, names: Sequence[str], grid: Grid
) -> tuple[dict[str, ViewCamera], tuple[str, ...]]:
    """Return the cameras that a file states of the views ``names`` of a layout with images of ``grid``, and notes.

    An image id is the name of a view, both without leading zeros. Raises ``InputError`` for a file of another
    format, for a view without an entry or with several, for an entry that is no camera of the images, and for
    poses or units that contradict each other or the layout.
    """
    entries, problems = parse_json(read_file(path, JSON_BYTES, "the cameras of all views", InputError))
    is_table = isinstance(entries, dict)
    if not problems and not (entries and is_table and all(re.fullmatch("[0-9]+", key) for key in entries)):
        found = f"has the keys {escape_text(', '.join([*entries][:5]))}" if is_table else "is no table"
        problems.append(Problem("invalid", "", found, "BOP's scene_camera.json, whose keys are image ids"))
    if problems:
        raise InputError.from_problems(path, problems)
    ids = defaultdict[str, list[str]](list)
    for key in entries:
        ids[key.lstrip("0")].append(key)
    missing = [name for name in names if name.lstrip("0") not in ids]
    if missing:
        found = f"{len(missing)} of {len(names)} views have no entry, such as {missing[0]}"
        problems.append(Problem("missing", "", found, f"names as in the file, such as {next(iter(entries))}"))
    for name in names:
        if len(keys := ids[name.lstrip("0")]) > 1:
            found = f"view {name} has {len(keys)} entries: {', '.join(keys[:5])}"
            problems.append(Problem("duplicate", "", found, "one"))
    if problems:
        raise InputError.from_problems(path, problems)

    cameras = dict[str, ViewCamera]()
    for name in names:
        [key] = ids[name.lstrip("0")]
        try:
            cameras[name] = _camera(path, entries[key], layout, grid)
        except InputError as error:  # The other entries often have the same problems.
            located = [replace(one, where=f"{key}: {one.where}".removesuffix(": ")) for one in error.problems]
            raise InputError.from_problems(path, located) from None
    unposed = [name for name, camera in cameras.items() if camera.cam_from_world is None]
    if unposed and (layout.bars is not None or len(unposed) < len(cameras)):
        found = f"{len(unposed)} of {len(cameras)} views have no pose, such as {unposed[0]}"
        expected = "poses of all views, or of none in a layout without bars"
        raise InputError.from_problems(path, [Problem("missing", "", found, expected)])

    used = dict.fromkeys(key for name in names for key in entries[ids[name.lstrip("0")][0]])
    unknown = [escape_text(key) for key in used if key not in _KNOWN][:_MAX_NAMED]
    notes = []
    if unknown:
        notes.append(f"{path.name}: fields without a known meaning are left out: {', '.join(unknown)}")
    if len(entries) > len(names):
        notes.append(f"{path.name}: {len(entries) - len(names)} of {len(entries)} entries are those of no view")
    return cameras, tuple(notes)


def _camera(path: Path, entry: Any, layout: Layout, grid: Grid) -> ViewCamera:
    """Return the camera of an entry. Raises ``InputError`` with its problems."""
    if not isinstance(entry, dict) or "cam_K" not in entry:
        raise EntryError(Problem("invalid", "", f"got {short_repr(entry)}", "a table with cam_K"))
    values = {key: value for key, value in entry.items() if value is not None}
    if values.get("cam_model"):
        expected = f"no other lens: undistort images and depth maps first, {RECTIFY_PAGE}, and state the new K"
        raise EntryError(Problem("invalid", "cam_model", f"got {short_repr(values['cam_model'])}", expected))
    has_unit, is_stated = "depth_scale" in values, layout.depth.unit is not None or layout.depth.scale is not None
    if has_unit == is_stated:
        found = "given beside depth.unit or depth.scale" if has_unit else "missing"
        expected = "either it, or depth.unit or depth.scale in the layout"
        raise EntryError(Problem("conflict", "depth_scale", found, expected))
    unit_m = float(_numbers(values, "depth_scale", 1, 1e-9, 1e6)[0]) * UNITS_M["mm"] if has_unit else None
    pose = None
    if "cam_R_w2c" in values or "cam_t_w2c" in values:
        rotation, translation = _numbers(values, "cam_R_w2c", 9), _numbers(values, "cam_t_w2c", 3)
        pose = checked_pose(np.c_[rotation.reshape(3, 3), translation], "cam_R_w2c", unit_m=UNITS_M["mm"])
    height, width = grid
    K = _numbers(values, "cam_K", 9).reshape(3, 3).tolist()
    problems = list[Problem]()
    table = {"left": {"K": K, "distortion": [0.0] * 4}}
    calibration = table_calibration(table, width, height, problems, is_stereo=False)
    if calibration is None:
        raise InputError.from_problems(
            "", [replace(one, where=one.where.removeprefix("left.")) for one in problems]
        )
    return ViewCamera(scaled_calibration(calibration, path, width, height), pose, unit_m)


def _numbers(
    values: Mapping[str, Any], key: str, size: int, low: float = -1e9, high: float = 1e9
) -> Float64[ndarray, " n"]:
    """Return the numbers of a field row by row. Raises ``EntryError`` if it is missing or has another value."""
    try:
        numbers = np.array(values.get(key))
    except ValueError:  # The rows have several lengths.
        numbers = np.array(None)
    if numbers.dtype.kind not in "iuf" or numbers.size != size or numbers.min() < low or numbers.max() > high:
        found = f"got {short_repr(values[key])}" if key in values else "missing"
        expected = f"{size} numbers from {low:g} to {high:g}"
        raise EntryError(Problem("invalid" if key in values else "missing", key, found, expected))
    return numbers.astype(np.float64).ravel()
