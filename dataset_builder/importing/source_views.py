"""Views of a layout: their names and files, and the decoded images, depth maps and cameras of each."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset_builder.importing.import_layout import VIEW, Layout
from dataset_builder.importing.source_files import (
    DEPTH_SUFFIXES,
    LABEL_SUFFIXES,
    MATRIX_SUFFIXES,
    DepthTally,
    bar_ids,
    cam_from_world,
    intrinsics,
    limited_depth_m,
    planar_depth_m,
    read_depth,
    read_labels,
    rectified_pair,
)
from dataset_builder.importing.view_cameras import ViewCamera, read_view_cameras
from rebar_depth_bench.base.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.base.names import NAME_LETTERS, NAME_PATTERN
from rebar_depth_bench.captures.calibration import Lens, MonoCalibration, camera_columns, scaled_calibration
from rebar_depth_bench.captures.camera_files import cameras_of_table
from rebar_depth_bench.captures.images import IMAGE_SUFFIXES, common_shape, read_image
from rebar_depth_bench.data.schema import EYES, column_kind
from rebar_depth_bench.geometry.aruco_board import BoardSpec

_SUFFIXES: Mapping[str, tuple[str, ...]] = {
    "rgb": IMAGE_SUFFIXES,
    "depth": DEPTH_SUFFIXES,
    "mask": LABEL_SUFFIXES,
    "bars": LABEL_SUFFIXES,
}
"""Suffixes of the files of each kind of column; matrices are no columns."""


@dataclass(frozen=True, eq=False)
class SourceViews:
    """Checked views of a layout: names, files by column, image size (height, width), cameras by view, board.

    ``notes`` say what was left out of the files of cameras. Without poses, ``has_poses`` is False and the world
    frame of a view is its left camera.
    """

    root: Path
    layout: Layout
    names: tuple[str, ...]
    grid: tuple[int, int]
    cameras: Mapping[str, ViewCamera]
    board: BoardSpec | None
    notes: tuple[str, ...]

    @property
    def has_poses(self) -> bool:
        """Whether the views have poses in one world frame."""
        return self.layout.poses is not None or self.cameras[self.names[0]].cam_from_world is not None

    @property
    def files(self) -> list[Path]:
        """Files of all views, and the file of their cameras."""
        files = [self.file(pattern, name) for pattern in _patterns(self.layout).values() for name in self.names]
        return files if self.layout.views is None else [*files, self.root / self.layout.views]

    def file(self, pattern: str, name: str) -> Path:
        """Return the file of a view."""
        return self.root / pattern.replace(VIEW, name)

    def decode(self, name: str, tally: DepthTally | None = None) -> dict[str, Any]:
        """Return the arrays of a view by column; columns that the layout does not have are left out.

        What is left out of the depth maps is added to ``tally``. Raises ``InputError`` with the problems of the
        view's files.
        """
        try:
            return self._decoded(name, DepthTally() if tally is None else tally)
        except EntryError as error:
            raise InputError.from_problems(f"{self.root}: view {name}", error.problems) from None

    def _decoded(self, name: str, tally: DepthTally) -> dict[str, Any]:
        layout, (calibration, pose, unit_m) = self.layout, self.cameras[name]
        if layout.poses is not None:
            pose = cam_from_world(self.file(layout.poses.file, name), layout.poses)
        columns = camera_columns(calibration, np.eye(4) if pose is None else pose)
        if layout.intrinsics is not None:
            path = self.file(layout.intrinsics.file, name)
            K = columns["left_K"] = intrinsics(path, layout.intrinsics)
            lens = Lens(K[0, 0], K[1, 1], K[0, 2], K[1, 2], calibration.left.distortion)
            height, width = self.grid
            scaled_calibration(MonoCalibration(width, height, lens), path, width, height)
        if not layout.files.has_right:
            columns = {column: cell for column, cell in columns.items() if column.startswith("left_")}
        for column, pattern in layout.files.patterns.items():
            path, kind, eye = self.file(pattern, name), column_kind(column), column.partition("_")[0]
            if kind == "rgb":
                columns[column] = read_image(path, self.grid)
            elif kind == "depth":
                table, factor = layout.depth, layout.depth.factor if unit_m is None else unit_m
                units = read_depth(path, self.grid, table, tally)
                K, distortion = columns[f"{eye}_K"], columns[f"{eye}_distortion"]
                depth_m = planar_depth_m(units, factor, table.kind, calibration, K, distortion)
                columns[column] = limited_depth_m(path, units, depth_m, table, tally)
            elif kind == "mask":
                values, steel = read_labels(path, self.grid), layout.masks.values
                columns[column] = np.isin(values, steel) if steel else values != 0
            else:
                columns[column] = bar_ids(path, read_labels(path, self.grid))
        for eye in EYES:
            if f"{eye}_bars" in columns:
                has_id = columns[f"{eye}_bars"] > 0
                outside = int(np.count_nonzero(has_id & ~columns.setdefault(f"{eye}_mask", has_id)))
                if outside:
                    found = f"{outside} pixels have a bar id and are no steel in the mask"
                    raise EntryError(Problem("conflict", f"{eye}_bars", found, "bar ids on steel only"))
        return columns


def open_views(path: Path, layout: Layout) -> SourceViews:
    """Return the views of a layout file, after checking that all files are there.

    Sizes of images are compared by their headers. Raises ``InputError`` with all problems.
    """
    root, patterns, problems = path.parent, _patterns(layout), list[Problem]()
    for key, pattern in patterns.items():
        suffixes = _SUFFIXES.get(column_kind(key), MATRIX_SUFFIXES)
        if Path(pattern).suffix.lower() not in suffixes:
            problems.append(
                Problem("invalid", key, f"got {escape_text(pattern)}", f"a name ending in {', '.join(suffixes)}")
            )
    before, _, after = layout.files.left_depth.partition(VIEW)
    match = re.compile(f"{re.escape(before)}({NAME_PATTERN}){re.escape(after)}")
    names = []
    for file in sorted(root.glob(layout.files.left_depth.replace(VIEW, "*"))):
        if matched := match.fullmatch(file.relative_to(root).as_posix()):
            names.append(matched[1])
        else:
            found = f"got {escape_text(file.relative_to(root).as_posix())}"
            problems.append(Problem("name", "files.left_depth", found, f"views named by {NAME_LETTERS}"))
    names.sort()
    if not names and not problems:
        problems.append(Problem("missing", "files.left_depth", "no file has this name", layout.files.left_depth))
    files = {key: [pattern.replace(VIEW, name) for name in names] for key, pattern in patterns.items()}
    for key, of_views in files.items():
        missing = [file for file in of_views if not (root / file).is_file()]
        if missing:
            found = f"{missing[0]} is missing, as for {len(missing)} of {len(names)} views"
            problems.append(Problem("missing", key, found))
    if problems:
        raise InputError.from_problems(path, problems)
    images = [root / file for key in ("left_rgb", "right_rgb") for file in files.get(key, ())]
    grid = common_shape(images, problems)
    stated = (layout.height, layout.width)
    if grid is not None and None not in stated and grid != stated:
        problems.append(
            Problem("conflict", "width", f"the images are {grid[1]} x {grid[0]}", "their width and height")
        )
    if problems:
        raise InputError.from_problems(path, problems)
    height, width = grid if grid is not None else (layout.height or 0, layout.width or 0)
    if layout.views is not None:
        by_view, notes = read_view_cameras(root / layout.views, layout, names, (height, width))
        return SourceViews(root, layout, tuple(names), (height, width), by_view, None, notes)
    cameras = cameras_of_table(
        path, layout.cameras, names, width, height, is_stereo=layout.files.has_right, where="cameras"
    )
    if layout.depth.kind == "disparity":
        rectified_pair(cameras.calibration)
    by_view = {name: ViewCamera(cameras.calibration, cameras.cam_from_world.get(name)) for name in names}
    notes = cameras.calibration.notes
    return SourceViews(root, layout, tuple(names), (height, width), by_view, cameras.board, notes)


def _patterns(layout: Layout) -> dict[str, str]:
    """Return all patterns of files of single views, by column or key."""
    matrices = {"poses": layout.poses, "intrinsics": layout.intrinsics}
    return {
        **layout.files.patterns,
        **{f"{key}.file": table.file for key, table in matrices.items() if table is not None},
    }
