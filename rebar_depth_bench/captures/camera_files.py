"""Files that state the cameras of a capture, and ``cameras.toml``, which also states its board and its poses.

A folder holds ``cameras.toml``; or one file ``*.conf`` or ``calibration.toml`` (``captures.calibration_files``);
or one or two calibrations of OpenCV or ROS (``captures.programs``). docs/captures.md lists these files.

``cameras.toml`` has the keys of ``calibration.toml``, of one camera or of a pair, or names files in their place:

```toml
calibration = ["intrinsics.yml", "extrinsics.yml"]    # or one file; or [left], [right], [stereo]
unit = "mm"          # of lengths in files of OpenCV and ROS: "m" (default), "cm", "mm", "in" or "ft"
rectified = false    # true: the pictures are rectified and have the file's matrix P

[board]              # ArUco board; default: the A3 sheet with 6 markers of 50 mm
markers = 12
marker_side_m = 0.03

[[pose]]             # of all images or of none: x_cam = cam_from_world @ x_world, OpenCV axes, metres
image = "0001"
cam_from_world = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
```
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import Field, field_validator, model_validator

from rebar_depth_bench.base.errors import CalibrationError, EntryError, InputError, Problem
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.names import NAME_LETTERS, NAME_PATTERN
from rebar_depth_bench.base.reading import parse_toml, read_file
from rebar_depth_bench.base.validation import (
    UNITS_M,
    Expected,
    StrictModel,
    check_unique,
    field_error,
    one_of,
    text,
    validate_table,
)
from rebar_depth_bench.captures.calibration import (
    Calibration,
    Side,
    StereoCalibration,
    scaled_calibration,
    table_calibration,
)
from rebar_depth_bench.captures.calibration_files import check_image_size, own_calibration
from rebar_depth_bench.captures.documents import DOCUMENT_SUFFIXES, parse_document
from rebar_depth_bench.captures.fields import READABLE
from rebar_depth_bench.captures.programs import program_calibration
from rebar_depth_bench.data.schema import BoardTable
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import is_rigid

CAMERAS_FILE = "cameras.toml"
_CALIBRATION_FILES = ("calibration.conf", "calibration.toml")
_CALIBRATION_KEYS = ("width", "height", "left", "right", "stereo")

_FileName = Annotated[str, Field(pattern=f"^{NAME_PATTERN}$"), Expected(f"a file of the folder: {NAME_LETTERS}")]
_Row = Annotated[list[float], Field(min_length=4, max_length=4), Expected("4 numbers")]
_POSE = Expected(
    "4 rows of 4 numbers: a rotation, a translation in metres, 0 0 0 1", lambda rows: is_rigid(np.array(rows))
)


@dataclass(frozen=True, eq=False)
class CaptureCameras:
    """Cameras of a capture: calibration for its image size, its board, and poses by image name.

    ``board`` is None if no file states it. Without poses, ``cam_from_world`` is empty.
    """

    calibration: Calibration
    board: BoardSpec | None
    cam_from_world: Mapping[str, Float64[ndarray, "4 4"]]


class _PoseTable(StrictModel):
    image: Annotated[str, text(100)]
    cam_from_world: Annotated[list[_Row], Field(min_length=4, max_length=4), _POSE]


class _Board(BoardTable):
    """Board as a person states it."""

    @model_validator(mode="after")
    def _check_layout(self) -> Self:
        try:
            marker_corners_m(self.spec)
        except ValueError as error:
            raise field_error(str(error), "a board with room for its markers", "conflict") from None
        return self


class _CamerasTable(StrictModel):
    """Content of ``cameras.toml``; ``table_calibration`` reads the keys of ``calibration.toml``."""

    calibration: Annotated[
        _FileName | Annotated[list[_FileName], Field(min_length=1, max_length=2)] | None,
        Expected(f"the name of a file beside this one, or two, of {NAME_LETTERS}"),
    ] = None
    unit: Annotated[str, one_of(*UNITS_M)] = "m"
    rectified: bool | None = None
    board: _Board | None = None
    pose: tuple[_PoseTable, ...] = Field(default=(), strict=False)
    width: Any = None
    height: Any = None
    left: Any = None
    right: Any = None
    stereo: Any = None

    @field_validator("board", mode="before")
    @classmethod
    def _add_defaults(cls, fields: Any) -> Any:
        return {**asdict(BoardSpec()), **fields} if isinstance(fields, Mapping) else fields

    @field_validator("pose")
    @classmethod
    def _check_images(cls, poses: tuple[_PoseTable, ...]) -> tuple[_PoseTable, ...]:
        if poses:
            check_unique([pose.image for pose in poses], "image")
        return poses


def read_cameras(root: Path, images: Sequence[str], width: int, height: int, *, is_stereo: bool) -> CaptureCameras:
    """Return the cameras of the folder ``root`` with ``images`` of ``width`` x ``height`` pixels.

    Raises ``InputError`` if the folder states no cameras or states them twice, ``CalibrationError`` with the
    problems of its files, which name keys, and if a pair of images has the calibration of one camera.
    """
    path = root / CAMERAS_FILE
    if not path.exists():
        calibration = _file_calibration(_found_files(root), _CamerasTable(), width, height, is_stereo=is_stereo)
        return CaptureCameras(calibration, None, {})
    content = read_file(path, TOML_BYTES, "the cameras of a capture", CalibrationError)
    document, problems = parse_toml(content)
    if problems:
        raise CalibrationError.from_problems(path, problems)
    return cameras_of_table(path, document, images, width, height, is_stereo=is_stereo)


def cameras_of_table(
    path: Path,
    document: Mapping[str, Any],
    images: Sequence[str],
    width: Side,
    height: Side,
    *,
    is_stereo: bool,
    where: str = "",
) -> CaptureCameras:
    """Return the cameras that a table with the keys of ``cameras.toml`` states, of ``images`` as ``read_cameras``.

    The table is the file ``path`` or, if ``where`` is not empty, the one in it with this name. Files that it names
    are in the same folder. Raises ``CalibrationError`` as ``read_cameras``.
    """
    check_image_size(path, width, height)
    problems: list[Problem] = []
    rest = {key: document[key] for key in _CALIBRATION_KEYS if key in document}
    table = validate_table(_CamerasTable, document, problems)
    inline = None
    if table is not None and table.calibration is not None and rest:
        problems.append(Problem("conflict", "calibration", f"given beside {', '.join(rest)}", "one of them"))
    elif table is not None and table.calibration is None:
        inline = table_calibration(rest, width, height, problems, is_stereo=is_stereo)
        if table.rectified is not None:
            problems.append(
                Problem("conflict", "rectified", "given without calibration", "a file with the matrix P")
            )
    poses = {} if table is None else {pose.image: np.array(pose.cam_from_world) for pose in table.pose}
    if table is not None and poses and (missing := sorted(set(images) - poses.keys())):
        found = f"{len(missing)} images have none, such as {missing[0]}"
        problems.append(Problem("missing", "pose", found, "poses of all images, or none"))
    if table is None or problems:
        located = [replace(one, where=f"{where}.{one.where}") for one in problems] if where else problems
        raise CalibrationError.from_problems(path, located)
    if inline is not None:
        calibration = scaled_calibration(inline, path, width, height)
    else:
        names = [table.calibration] if isinstance(table.calibration, str) else list(table.calibration or ())
        paths = [path.parent / name for name in names]
        calibration = _file_calibration(paths, table, width, height, is_stereo=is_stereo)
    return CaptureCameras(calibration, None if table.board is None else table.board.spec, poses)


def _found_files(root: Path) -> list[Path]:
    """Return the calibration files of a folder. Raises ``InputError`` unless there is one, or a pair."""
    files = sorted(path for path in root.iterdir() if not path.name.startswith("."))
    own = [path for path in files if path.suffix.lower() == ".conf" or path.name in _CALIBRATION_FILES]
    others = [path for path in files if path.suffix.lower() in DOCUMENT_SUFFIXES]
    if len(own) == 1 and (own[0].name in _CALIBRATION_FILES or not others):
        return own
    if not own and 1 <= len(others) <= 2:
        return others
    found = ", ".join(path.name for path in (*own, *others)[:5]) or "none"
    expected = f"{CAMERAS_FILE} with the names of those to read, or {READABLE}"
    raise InputError(f"{root}: the calibration files are {found}, expected {expected}")


def _file_calibration(
    paths: Sequence[Path], stated: _CamerasTable, width: Side, height: Side, *, is_stereo: bool
) -> Calibration:
    """Return the calibration in one or two files, of the ``stated`` unit, scaled to the image size."""
    source = " and ".join(map(str, paths))
    problems: list[Problem] = []
    if len(paths) == 1 and paths[0].suffix.lower() in (".conf", ".toml"):
        if stated.rectified:
            expected = "a file with the matrix P of rectified pictures, of ROS or OpenCV"
            problem = Problem("missing", "", "has no matrix of rectified pictures", expected)
            raise CalibrationError.from_problems(paths[0], [problem])
        return own_calibration(paths[0], width, height, is_stereo=is_stereo)
    check_image_size(paths[0], width, height)
    documents = {}
    for path in paths:
        if path.suffix.lower() not in DOCUMENT_SUFFIXES:
            problem = Problem("unknown", path.name, f"the file suffix is {path.suffix!r}", READABLE)
            raise CalibrationError.from_problems(path.parent, [problem])
        content = read_file(path, TOML_BYTES, "a calibration file", CalibrationError)
        documents[path.name] = parse_document(path.name, content, problems)
    if problems:
        raise CalibrationError.from_problems(paths[0].parent, problems)
    unit_m = UNITS_M[stated.unit]
    try:
        calibration = program_calibration(documents, width, height, unit_m, rectified=stated.rectified)
    except EntryError as error:
        raise CalibrationError.from_problems(paths[0].parent, error.problems) from None
    if is_stereo and not isinstance(calibration, StereoCalibration):
        problem = Problem("missing", "", "describes one camera", "the left and the right one")
        raise CalibrationError.from_problems(source, [problem])
    return scaled_calibration(calibration, source, width, height)
