"""Calibrations as OpenCV, ROS, Kalibr and Middlebury write them; ``captures.program_formats`` has their fields.

- OpenCV's FileStorage has no fixed names. Those of its stereo sample (M1, D1, M2, D2, R, T), of its calibration
  sample (camera_matrix, distortion_coefficients, image_width), and their common spellings are known. The unit of T
  is that of the calibration target's squares: metres unless another unit is stated.
- ROS: ``camera_info`` as camera_calibration writes it (camera_matrix, ...) or as a printed message (K or k, ...).
  The motion of a pair follows from the rectification of both cameras: x_rectified = R_i x_i, P[0, 3] = -fx B.
  K and P are those of the full sensor; the pictures may be a region of it, divided by the binning (REP 104).
- Kalibr: a camera chain with cam0 and, for a pair, cam1 with T_cn_cnm1 = cam1_from_cam0.
- Middlebury and ETH3D: ``calib.txt`` of a rectified pair, whose baseline is in millimetres.

Pictures are those of the camera, with its matrix and distortion, unless they are stated to be rectified: they have
the projection matrix P then, no distortion, and for a pair the baseline that P states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import Problem, ProblemCode
from rebar_depth_bench.base.reading import parse_number
from rebar_depth_bench.base.validation import format_location, short_repr
from rebar_depth_bench.captures.calibration import Calibration, table_calibration
from rebar_depth_bench.captures.fields import DISTORTION_TERMS, OTHER_LENS, FileFormat, lens_problem, plain_key
from rebar_depth_bench.captures.program_formats import CAMERA, KALIBR, MIDDLEBURY, MIDDLEBURY_RIGHT, PAIR
from rebar_depth_bench.geometry.cameras import is_rotation, nearest_rotation, rotation_matrix

Document = Mapping[str, Any]
Values = Float64[ndarray, "..."]

_CAMERAS = ("left", "right")
_OF_EACH_EYE = ("matrix", "distortion", "rectification", "projection")
"""Fields that a pair states for each camera."""
_OF_ANY_EYE = ("distortion model", "camera model", "other lenses")
"""Fields that a pair states for each camera or for both."""
_REGION = ("x_offset", "y_offset", "width", "height")
_MAX_NUMBERS = 100
_MAX_MAGNITUDE = 1e9
_ROUNDED_ROTATION = 1e-4
"""Largest deviation of ``R @ R.T`` from the identity in a file with few digits; it is made exact."""
_ROUNDED_PX = 0.01
"""Largest difference of K and P that is due to the digits of a file, pixels."""


@dataclass(frozen=True)
class _Reader:
    """Values of a document ``name``; problems are added to ``problems``, in place of which zeros are returned.

    Notes are added to ``notes``. ``sources`` names the files of the keys of a document that was put together from
    several; of a document of a pair, ``eyes`` are the spellings of one of its cameras.
    """

    name: str
    document: Document
    problems: list[Problem]
    notes: list[str]
    fields: FileFormat
    eyes: tuple[str, ...] = ("",)
    sources: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def _keys(self) -> Mapping[str, str]:
        return {plain_key(str(key)): key for key in self.document}

    def keys(self, name: str) -> list[str]:
        """Return the keys of a field in the document."""
        eyes = self._eyes(name)
        spellings = (text for key in self.fields.keys(name) for eye in eyes for text in (key + eye, eye + key))
        return list(dict.fromkeys(self._keys[key] for key in map(plain_key, spellings) if key in self._keys))

    def _eyes(self, name: str) -> tuple[str, ...]:
        """Return what may be before or after the keys of a field."""
        shared = (*self.eyes, "") if name in _OF_ANY_EYE else ("",)
        return self.eyes if name in _OF_EACH_EYE else shared

    def key(self, name: str) -> str | None:
        """Return the first key of a field in the document, None if it has none."""
        return next(iter(self.keys(name)), None)

    def numbers(self, name: str, *shapes: tuple[int, ...], default: Values | None = None) -> Values:
        """Return the numbers of a field, in one of ``shapes``; a side that is -1 may have any length."""
        key, zeros = self.key(name), np.zeros([max(side, 0) for side in shapes[0]])
        texts = [" x ".join("n" if side < 0 else str(side) for side in shape) for shape in shapes]
        expected = f"numbers of shape {' or '.join(texts)}"
        if key is None and default is None:
            self.problem("missing", name, "missing", expected)
            return zeros
        values = [self.document[key] for key in self.keys(name)] or [[]]
        flats = [list(flat_numbers(one.get("data") if isinstance(one, dict) else one)) for one in values]
        value, flat = values[0], flats[0]
        if any(len(other) == len(flat) and other != flat for other in flats):
            self.problem("conflict", name, f"differs from that in {self.keys(name)[-1]}", "one value")
        if not flat and default is not None:
            return default
        if flat and len(flat) <= _MAX_NUMBERS and np.isfinite(flat).all():
            for shape in shapes:
                if -1 in shape or math.prod(shape) == len(flat):
                    return np.array(flat, np.float64).reshape(shape)
        self.problem("invalid", name, f"got {short_repr(value)}", expected)
        return zeros

    @cached_property
    def matrix(self) -> Values:
        """Pinhole matrix of the camera."""
        if self.fields is KALIBR:
            fx, fy, cx, cy = self.numbers("matrix", (4,)).tolist()
            return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        matrix = self.numbers("matrix", (3, 3))
        if not matrix[:2, 2].any() and matrix[2, :2].any():
            expected = "rows of [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            self.problem("invalid", "matrix", f"the rows of {matrix.tolist()} are columns", expected)
        return matrix

    @cached_property
    def projection(self) -> Values | None:
        """Matrix P of the rectified camera, 3 x 4 or 3 x 3; None if the document has none or zeros."""
        projection = self.numbers("projection", (3, 4), (3, 3), default=np.zeros((3, 4)))
        return projection if projection.any() else None

    @cached_property
    def distortion(self) -> list[float]:
        """Terms k1 k2 p1 p2 k3, after the check that they describe the lens."""
        terms = self.numbers("distortion", (-1,), default=np.zeros(DISTORTION_TERMS)).tolist()
        models = {key: self.document[key] for key in self.keys("camera model")}
        others = {key: self.document[key] for key in self.keys("other lenses")}
        ignored = self.keys("details") + self.keys("distortion model")
        texts = {key: text for key, text in self.document.items() if key not in ignored}
        alone = {
            **models,
            **{key: value for key, value in others.items() if any(flat_numbers(value))},
            **{key: text for key, text in texts.items() if isinstance(text, str) and OTHER_LENS.search(text)},
        }
        found = [lens_problem(self.key_place(key), {key: value}) for key, value in alone.items()]
        if not any(found):
            models |= {key: self.document[key] for key in self.keys("distortion model")}
            found = [lens_problem(self.name, models, terms)]
        self.problems.extend(problem for problem in found if problem is not None and problem not in self.problems)
        return [*terms[:DISTORTION_TERMS], *[0.0] * (4 - len(terms))]

    def on_pictures(self, matrix: Values, width: int, height: int) -> tuple[Values, dict[str, float]]:
        """Return a matrix of the sensor on pictures of ``width`` x ``height``, and the image size that it is for.

        By REP 104 ``roi`` is in pixels of the sensor, and the pictures show it divided by the binning. Pixel
        centres are at integers: cx' = (cx - x + 0.5) / binning - 0.5; ROS' image_geometry leaves out the halves.
        Pictures of the full size are not cropped; without ``roi``, those of another size show all of the sensor.
        """
        size, pictures = self.size(), [width, height]
        sensor = list(size.values())
        bin_x, bin_y = (max(1.0, self.numbers(f"binning {axis}", (1,), default=np.zeros(1))[0]) for axis in "xy")
        roi = self.document.get(self.key("region") or "", {})
        region = list(flat_numbers([roi.get(name, 0) for name in _REGION] if isinstance(roi, dict) else roi))
        if len(region) != 4 or not all(value >= 0 and value.is_integer() for value in (*region, bin_x, bin_y)):
            self.problem("invalid", "region", f"got {short_repr(roi)}", f"whole numbers {', '.join(_REGION)}")
            return matrix, size
        if not sensor and max(bin_x, bin_y) > 1:
            self.problem("missing", "width", "missing beside binning", "width and height of the full sensor")
            return matrix, size
        x, y, *sides = region if any(region) else [0.0, 0.0, *sensor]
        is_whole = [x, y, *sides] == [0, 0, *sensor]
        is_inside = all(sides) and (not sensor or (x + sides[0] <= sensor[0] and y + sides[1] <= sensor[1]))
        shown = [side // bin for side, bin in zip(sides, (bin_x, bin_y), strict=False)]
        if not is_inside:
            found = f"{sides[0]:g} x {sides[1]:g} pixels at ({x:g}, {y:g}) are not inside width x height"
            expected = (
                "a part of the full sensor, which width, height and K are for (REP 104); or a roi of zeros, "
            )
            self.problem("conflict", "region", found, f"{expected}and K of the pictures")
        elif shown == pictures and not (is_whole and bin_x == bin_y == 1):
            corner = np.array([[0, 0, x - 0.5], [0, 0, y - 0.5], [0, 0, 0]])
            half_pixel = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
            matrix = np.diag([1 / bin_x, 1 / bin_y, 1.0]) @ (matrix - corner) - half_pixel
            size = {"width": width, "height": height}
        elif not is_whole and sensor != pictures:
            expected = f"{shown[0]:g} x {shown[1]:g}, or the size of the full sensor"
            self.problem("conflict", "region", f"the pictures have {width} x {height} pixels", expected)
        elif not is_whole or max(bin_x, bin_y) > 1:
            self.notes.append(f"{self.name}: the pictures show all of the sensor; roi and binning are left out")
        return matrix, size

    def size(self) -> dict[str, float]:
        """Return width and height, from one field with both or from two; nothing if the document has none."""
        if self.key("size"):
            width, height = self.numbers("size", (2,)).tolist()
        elif self.key("width") and self.key("height"):
            width, height = (float(self.numbers(name, (1,))[0]) for name in ("width", "height"))
        else:
            return {}
        sides_px = {"width": width, "height": height}
        return {key: int(side_px) if side_px.is_integer() else side_px for key, side_px in sides_px.items()}

    def rotation(self, name: str) -> Values:
        """Return a rotation matrix, which the file may also hold as a rotation vector."""
        rotation = self.numbers(name, (3, 3), (3,))
        return rotation_matrix(rotation) if rotation.ndim == 1 else rotation

    def problem(self, code: ProblemCode, name: str, found: str, expected: str) -> None:
        """Add a problem of a field."""
        self.problems.append(Problem(code, self.place(name), found, expected))

    def place(self, name: str) -> str:
        """Return the location of a field."""
        return self.key_place(self.key(name) or (*self.fields.keys(name), name)[0] + self._eyes(name)[0])

    def key_place(self, key: str) -> str:
        """Return the location of a key."""
        name = self.sources.get(key, self.name)
        return format_location(name if ": " in name else f"{name}:", key)


def program_calibration(
    documents: Mapping[str, Document],
    width: int,
    height: int,
    unit_m: float,
    problems: list[Problem],
    *,
    rectified: bool | None,
) -> Calibration | None:
    """Return the calibration in one or two documents, by file name; of two, the left camera is the first.

    ``unit_m`` is the unit of lengths in the documents, metres; ``width`` and ``height`` are the size of the
    pictures, ``rectified`` whether they are rectified, None if that is not stated. The calibration is for the size
    that the documents state, or else for the pictures. Problems are added to ``problems``; the result is None if
    there are any.
    """
    notes: list[str] = []
    cameras, find_motion = _cameras(documents, problems, notes)
    is_rectified = _is_rectified(cameras, rectified, notes)
    table: dict[str, Any] = {}
    sizes = []
    for eye, camera in zip(_CAMERAS, cameras, strict=False):
        matrix = camera.projection[:, :3] if is_rectified and camera.projection is not None else camera.matrix
        matrix, size = camera.on_pictures(matrix, width, height)
        table[eye] = {"K": matrix.tolist(), "distortion": [0.0] * 4 if is_rectified else camera.distortion}
        sizes.append(size)
    table |= sizes[0]
    if len(cameras) == 2:
        find_motion = _rectified_motion if is_rectified else find_motion
        rotation, translation_m = find_motion(cameras[0], cameras[1], unit_m)
        if not is_rotation(rotation) and is_rotation(rotation, _ROUNDED_ROTATION):
            rotation = nearest_rotation(rotation)
        table["stereo"] = {"rotation": rotation.tolist(), "translation_m": translation_m.tolist()}
    if problems:
        return None
    table_problems: list[Problem] = []
    calibration = table_calibration(table, width, height, table_problems, is_stereo=len(cameras) == 2)
    for problem in table_problems:
        eye, _, key = problem.where.partition(".")
        place = cameras[eye == _CAMERAS[1]].place("projection" if is_rectified else "matrix")
        problems.append(replace(problem, where=place, found=f"{key or eye}: {problem.found}"))
    if calibration is not None and sizes[0] and sizes[-1] and sizes[0] != sizes[-1]:
        left, right = (" x ".join(map(str, size.values())) for size in sizes)
        cameras[1].problem("conflict", "size", f"width x height is {right}", f"that of the left camera, {left}")
    return None if calibration is None or problems else replace(calibration, notes=tuple(dict.fromkeys(notes)))


_Motion = Callable[[_Reader, _Reader, float], tuple[Values, Values]]


def _cameras(
    documents: Mapping[str, Document], problems: list[Problem], notes: list[str]
) -> tuple[list[_Reader], _Motion]:
    """Return the readers of the cameras in the documents, and the function for the motion of a pair."""
    cameras = [_Reader(name, document, problems, notes, CAMERA) for name, document in documents.items()]
    if len(cameras) == 2 and any(camera.key("matrix") and camera.key("projection") for camera in cameras):
        for camera in cameras:
            notes += CAMERA.notes(camera.name, camera.document)
        return cameras, _ros_motion
    merged, name = _merged(cameras), " and ".join(documents)
    if isinstance(merged.document.get("cam0"), list):
        notes += MIDDLEBURY.notes(name, merged.document)
        pair = [replace(merged, fields=fields) for fields in (MIDDLEBURY, MIDDLEBURY_RIGHT)]
        return pair, _middlebury_motion
    if "cam0" in merged.document:
        cameras = _kalibr_cameras(merged)
        keys = [*merged.document, *(key for camera in cameras for key in camera.document)]
        notes += KALIBR.notes(name, dict.fromkeys(keys))
        return cameras, _kalibr_motion
    fields = replace(PAIR, fields=PAIR.fields + CAMERA.fields)
    pair = [replace(merged, fields=fields, eyes=eyes) for eyes in (("1", "left", "l"), ("2", "right", "r"))]
    right = pair[1].key("matrix")
    if right is None or not isinstance(merged.document[right], dict | list):
        notes += CAMERA.notes(name, merged.document)
        return [merged], _opencv_motion
    listed = {key for camera in pair for one in fields.fields for key in camera.keys(one.name)}
    notes += PAIR.notes(name, (key for key in merged.document if key not in listed))
    return pair, _opencv_motion


def _merged(readers: Sequence[_Reader]) -> _Reader:
    """Return the reader of all keys of the documents; a key with two values adds a problem."""
    merged: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for reader in readers:
        for key, value in reader.document.items():
            if key in merged and value != merged[key]:
                found = f"differs from that in {sources[key]}"
                reader.problems.append(Problem("duplicate", reader.key_place(key), found, "one value"))
            merged.setdefault(key, value)
            sources.setdefault(key, reader.name)
    return replace(readers[0], document=merged, sources=sources)


def _is_rectified(cameras: Sequence[_Reader], rectified: bool | None, notes: list[str]) -> bool:
    """Return whether the pictures have the matrices P; if that is not stated, they have the cameras', with a note.

    Adds a problem if P is stated and missing, or if nothing but P tells that the pictures may be rectified.
    """
    if cameras[0].fields is MIDDLEBURY:  # It has no other matrices.
        return False
    for camera in cameras:
        P = camera.projection
        if rectified is None and P is not None:
            unlike = np.abs(P[:, :3] - camera.matrix).max() > _ROUNDED_PX
            rotation = camera.numbers("rectification", (3, 3), (3,), default=np.eye(3))
            if unlike and not any(camera.distortion) and np.allclose(rotation, np.eye(3)):
                found = "differs from the camera's matrix without distortion: the pictures may be rectified"
                expected = "rectified = true (they have P) or rectified = false beside calibration in cameras.toml"
                camera.problem("conflict", "projection", found, expected)
            elif unlike or any(camera.distortion):
                found = "the pictures are taken as not rectified, with the camera's own matrix and distortion"
                remedy = "if they are rectified, state rectified = true in cameras.toml"
                notes.append(f"{camera.name}: {found}; {remedy}")
        elif rectified and P is None:
            camera.problem("missing", "projection", "missing", "the matrix P of rectified pictures")
        if rectified is not True and camera.key("distortion") is None:
            notes.append(f"{camera.name}: no distortion is stated, taken as 0")
    return rectified is True


def _rectified_motion(left: _Reader, right: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T`` of rectified cameras."""
    x_m = []
    for camera in (left, right):
        row = np.zeros(4) if camera.projection is None else camera.projection[0]
        x_m.append(row[3] / row[0] * unit_m if len(row) == 4 and row[0] > 0 else math.nan)
    if not x_m[1] < min(x_m[0], 0):
        expected = "fx above 0 and P[0, 3] = -fx * baseline, of the right camera of a calibrated pair"
        row = [] if right.projection is None else right.projection[0].tolist()
        right.problem("invalid", "projection", f"got {short_repr(row)}", expected)
        return np.eye(3), np.zeros(3)
    return np.eye(3), np.array([x_m[1] - x_m[0], 0.0, 0.0])


def _ros_motion(left: _Reader, right: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    left_rotation, right_from_rectified = left.rotation("rectification"), right.rotation("rectification").T
    _, offset_m = _rectified_motion(left, right, unit_m)
    return right_from_rectified @ left_rotation, right_from_rectified @ offset_m


def _kalibr_cameras(chain: _Reader) -> list[_Reader]:
    cameras = []
    for name in ("cam0", "cam1"):
        if name in chain.document:
            table, place = chain.document[name], chain.key_place(name)
            if not isinstance(table, dict):
                chain.problems.append(Problem("invalid", place, f"got {short_repr(table)}", "a table"))
                table = {}
            cameras.append(_Reader(place, table, chain.problems, chain.notes, KALIBR))
    return cameras


def _kalibr_motion(_: _Reader, right: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    right_from_left = right.numbers("motion", (4, 4))
    return right_from_left[:3, :3], unit_m * right_from_left[:3, 3]


def _middlebury_motion(left: _Reader, right: _Reader, _: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    offset_px = right.matrix[0, 2] - left.matrix[0, 2]
    stated_px = left.numbers("offset", (1,), default=np.array([offset_px]))[0]
    if abs(stated_px - offset_px) > _ROUNDED_PX:
        left.problem("conflict", "offset", f"got {stated_px}", f"cx of cam1 minus cx of cam0, {offset_px:.3f}")
    return np.eye(3), np.array([-left.numbers("baseline", (1,))[0] / 1000, 0.0, 0.0])


def _opencv_motion(left: _Reader, _: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    return left.rotation("rotation"), unit_m * left.numbers("translation", (3,))


def flat_numbers(value: Any) -> Iterable[float]:
    """Yield the numbers in nested lists; NaN for anything else."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from flat_numbers(item)
    else:
        number = parse_number(value) if isinstance(value, str) else value
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        yield float(number) if is_number and abs(number) <= _MAX_MAGNITUDE else math.nan
