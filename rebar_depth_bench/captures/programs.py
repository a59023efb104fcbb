"""Calibrations as OpenCV and ROS write them.

- OpenCV's FileStorage has no fixed names. Those of its stereo sample (M1, D1, M2, D2, R, T), of its calibration
  sample (camera_matrix, distortion_coefficients, image_width), and their common spellings are known. The unit of T
  is that of the calibration target's squares: metres unless another unit is stated.
- ROS: ``camera_info`` as camera_calibration writes it (camera_matrix, ...) or as a printed message (K or k, ...).
  The motion of a pair follows from the rectification of both cameras: x_rectified = R_i x_i, P[0, 3] = -fx B.
  K and P refer to the full sensor; the pictures may be a region of it, divided by the binning (REP 104).

Pictures are those of the camera, with its matrix and distortion, unless they are stated to be rectified: they have
the projection matrix P then, no distortion, and for a pair the baseline that P states.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import EntryError, Problem, ProblemCode
from rebar_depth_bench.base.reading import parse_number
from rebar_depth_bench.base.validation import format_location, short_repr
from rebar_depth_bench.captures.calibration import Calibration, Side, table_calibration
from rebar_depth_bench.captures.fields import (
    DISTORTION_TERMS,
    OTHER_LENS,
    READABLE,
    lens_problem,
    plain_key,
    unknown_keys_notes,
)
from rebar_depth_bench.geometry.cameras import is_rotation, nearest_rotation, rotation_matrix

Document = Mapping[str, Any]
Values = Float64[ndarray, "..."]

KEYS: Mapping[str, tuple[str, ...]] = {
    "matrix": ("camera_matrix", "M", "K", "intrinsics", "intrinsic_matrix", "mtx", "cam_matrix"),
    "distortion": (
        *("distortion_coefficients", "D", "distortion", "distortion_coeffs"),
        *("dist", "dist_coeffs", "dist_coeff"),
    ),
    "distortion model": ("distortion_model",),
    "camera model": (
        *("camera_model", "model", "model_type", "camera_type", "lens_model", "projection_model"),
        *("fisheye_model", "fisheye", "is_fisheye"),
    ),
    "other lenses": ("xi", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y"),
    "rectification": ("rectification_matrix", "R"),
    "projection": ("projection_matrix", "P", "new_camera_matrix", "optimal_camera_matrix", "newcameramtx"),
    "size": ("image_size", "size", "camera_resolution", "resolution"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "region": ("roi",),
    "binning x": ("binning_x",),
    "binning y": ("binning_y",),
    "rotation": ("R", "rotation", "rotation_matrix", "rmat"),
    "translation": ("T", "translation", "translation_vector", "tvec"),
    "flags": ("flags",),
    "ignored": (
        *("header", "comment", "description", "camera_name", "camera_id", "calibration_time"),
        *("calibration_date", "date", "nframes", "nr_of_frames", "board_width", "board_height", "square_size"),
        *("marker_size", "aspectRatio", "fix_aspect_ratio", "avg_reprojection_error", "reprojection_error"),
        *("rms", "rms_error", "ret", "per_view_reprojection_errors", "extrinsic_parameters", "image_points"),
        *("grid_points", "rvecs", "tvecs", "E", "F", "essential_matrix", "fundamental_matrix", "Q"),
        *("disparity_to_depth_matrix", "roi1", "roi2", "valid_roi1", "valid_roi2"),
    ),
}
"""Known keys of each field, without regard to case and punctuation."""
_EYES = (("1", "left", "l"), ("2", "right", "r"))
"""What is before or after the keys of each camera of a pair, such as ``M1`` and ``left_K``."""
_OF_EACH_EYE = ("matrix", "distortion", "rectification", "projection")
"""Fields that a pair states for each camera."""
_OF_ANY_EYE = ("distortion model", "camera model", "other lenses")
"""Fields that a pair states for each camera or for both."""
_OF_PAIR = ("rotation", "translation")
_REGION = ("x_offset", "y_offset", "width", "height")
_MAX_NUMBERS = 100
_MAX_MAGNITUDE = 1e9
_ROUNDED_ROTATION = 1e-4
"""Largest deviation of ``R @ R.T`` from the identity in a file with few digits; it is made exact."""
ROUNDED_PX = 0.01
"""Largest difference of K and P that is due to the digits of a file, pixels."""


def program_calibration(
    documents: Mapping[str, Document], width: Side, height: Side, unit_m: float, *, rectified: bool | None
) -> Calibration:
    """Return the calibration in one or two documents, by file name; of two, the left camera is the first.

    ``unit_m`` is the unit of lengths in the documents, metres; ``width`` and ``height`` are the size of the
    pictures, ``rectified`` whether they are rectified, None if that is not stated. The calibration is for the size
    that the documents state, or else for the pictures. Raises ``EntryError`` for the first problem.
    """
    notes: list[str] = []
    cameras = [_camera(name, document) for name, document in documents.items()]
    is_ros_pair = len(cameras) == 2 and any(one.fields["matrix"] and one.fields["projection"] for one in cameras)
    if not is_ros_pair:
        cameras = _opencv_cameras(documents)
    for name, document in {one.name: one.document for one in cameras}.items():
        known = [
            key for one in cameras if one.document is document for keys in one.fields.values() for key in keys
        ]
        notes += unknown_keys_notes(name, document, known)
    table: dict[str, Any] = {}
    sizes = []
    for eye, camera in zip(("left", "right"), cameras, strict=False):
        if rectified:
            if camera.projection is None:
                raise camera.error("missing", "projection", "missing", "the matrix P of rectified pictures")
            matrix, distortion = camera.projection[:, :3], [0.0] * 4
        else:
            matrix, distortion = camera.matrix, camera.distortion
            notes += _check_not_rectified(camera, is_stated=rectified is False)
        matrix, size = _on_pictures(camera, matrix, width, height, notes)
        table[eye] = {"K": matrix.tolist(), "distortion": distortion}
        sizes.append(size)
    table |= sizes[0]
    if len(cameras) == 2:
        left, right = cameras
        if rectified:
            rotation, translation_m = np.eye(3), _rectified_offset_m(left, right, unit_m)
        elif is_ros_pair:
            left_rotation, right_from_rectified = left.rotation("rectification"), right.rotation("rectification").T
            rotation = right_from_rectified @ left_rotation
            translation_m = right_from_rectified @ _rectified_offset_m(left, right, unit_m)
        else:
            rotation, translation_m = left.rotation("rotation"), unit_m * left.numbers("translation", 3)
        if not is_rotation(rotation) and is_rotation(rotation, _ROUNDED_ROTATION):
            rotation = nearest_rotation(rotation)
        table["stereo"] = {"rotation": rotation.tolist(), "translation_m": translation_m.tolist()}
    problems: list[Problem] = []
    calibration = table_calibration(table, width, height, problems, is_stereo=len(cameras) == 2)
    if calibration is None:
        eye, _, key = problems[0].where.partition(".")
        name, found = "projection" if rectified else "matrix", f"{key or eye}: {problems[0].found}"
        expected = problems[0].expected
        if problems[0].code == "missing":  # Only the size can be missing in the table.
            name, expected = "width", "image_width and image_height, or width and height in [rig]"
        raise cameras[eye == "right"].error(problems[0].code, name, found, expected)
    if sizes[0] and sizes[-1] and sizes[0] != sizes[-1]:
        left_size, right_size = (" x ".join(map(str, size.values())) for size in sizes)
        found, expected = f"width x height is {right_size}", f"that of the left camera, {left_size}"
        raise cameras[1].error("conflict", "size", found, expected)
    return replace(calibration, notes=tuple(dict.fromkeys(notes)))


@dataclass(frozen=True)
class _Camera:
    """Camera in a document ``name``, with the values of each field of ``KEYS`` by key.

    The keys of a pair in one document have ``eye`` at an end.
    """

    name: str
    document: Document
    fields: Mapping[str, Mapping[str, Any]]
    eye: str

    def numbers(self, name: str, *counts: int, default: Values | None = None) -> Values:
        """Return the numbers of a field, as many as one of ``counts`` or any number; raise ``EntryError``."""
        values = list(self.fields[name].values())
        flats = [list(flat_numbers(one.get("data") if isinstance(one, dict) else one)) for one in values]
        expected = f"{' or '.join(map(str, counts))} numbers" + (f" in {READABLE}" if name == "matrix" else "")
        if default is not None and not any(flats):
            return default
        if not flats:
            raise self.error("missing", name, "missing", expected)
        if any(len(other) == len(flats[0]) and other != flats[0] for other in flats):
            raise self.error("conflict", name, f"differs from that in {list(self.fields[name])[-1]}", "one value")
        count = len(flats[0])
        if not 0 < count <= _MAX_NUMBERS or (counts and count not in counts) or not np.isfinite(flats[0]).all():
            raise self.error("invalid", name, f"got {short_repr(values[0])}", expected)
        return np.array(flats[0], np.float64)

    @property
    def matrix(self) -> Values:
        """Pinhole matrix of the camera."""
        matrix = self.numbers("matrix", 9).reshape(3, 3)
        if not matrix[:2, 2].any() and matrix[2, :2].any():
            expected = "rows of [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            raise self.error("invalid", "matrix", f"the rows of {matrix.tolist()} are columns", expected)
        return matrix

    @property
    def projection(self) -> Values | None:
        """Matrix P of the rectified camera, 3 x 4 or 3 x 3; None if the document has none or zeros."""
        projection = self.numbers("projection", 12, 9, default=np.zeros(12)).reshape(3, -1)
        return projection if projection.any() else None

    @property
    def distortion(self) -> list[float]:
        """Terms k1 k2 p1 p2 k3, after the check that they describe the lens."""
        terms = self.numbers("distortion", default=np.zeros(DISTORTION_TERMS)).tolist()
        models, stated = self.fields["camera model"], self.fields["distortion model"]
        alone = dict(models)
        alone |= {key: value for key, value in self.fields["other lenses"].items() if any(flat_numbers(value))}
        for key, text in self.document.items():
            is_free_text = key in self.fields["ignored"] or key in stated
            if isinstance(text, str) and OTHER_LENS.search(text) and not is_free_text:
                alone[key] = text
        found = [lens_problem(format_location(f"{self.name}:", key), {key: value}) for key, value in alone.items()]
        for problem in (*found, lens_problem(self.name, {**models, **stated}, terms)):
            if problem is not None:
                raise EntryError(problem)
        return [*terms[:DISTORTION_TERMS], *[0.0] * (4 - len(terms))]

    @property
    def size(self) -> dict[str, float]:
        """Width and height, from one field with both or from two; nothing if the document has none."""
        if self.fields["size"]:
            sides_px = self.numbers("size", 2).tolist()
        elif self.fields["width"] and self.fields["height"]:
            sides_px = [float(self.numbers(name, 1)[0]) for name in ("width", "height")]
        else:
            return {}
        whole = [int(side_px) if side_px.is_integer() else side_px for side_px in sides_px]
        return dict(zip(("width", "height"), whole, strict=True))

    def rotation(self, name: str) -> Values:
        """Return a rotation matrix, which the file may also hold as a rotation vector."""
        rotation = self.numbers(name, 9, 3)
        return rotation_matrix(rotation) if rotation.size == 3 else rotation.reshape(3, 3)

    def error(self, code: ProblemCode, name: str, found: str, expected: str) -> EntryError:
        """Return the error of a field."""
        eye = self.eye if name in _OF_EACH_EYE else ""
        key = next(iter(self.fields[name]), KEYS[name][0] + eye)
        return EntryError(Problem(code, format_location(f"{self.name}:", key), found, expected))


def _camera(name: str, document: Document, eyes: Sequence[str] = ("",)) -> _Camera:
    """Return a camera in a document; ``eyes`` are the spellings of one of a pair."""
    keys = {plain_key(key): key for key in document}
    fields = {}
    for field, names in KEYS.items():
        marks = eyes if field in _OF_EACH_EYE else (*eyes, "") if field in _OF_ANY_EYE else ("",)
        if field in _OF_PAIR and len(eyes) == 1:
            marks = ()
        spellings = (plain_key(text) for one in names for eye in marks for text in (one + eye, eye + one))
        fields[field] = {keys[text]: document[keys[text]] for text in spellings if text in keys}
    return _Camera(name, document, fields, eyes[0])


def _opencv_cameras(documents: Mapping[str, Document]) -> list[_Camera]:
    """Return the one or two cameras that the documents describe together. Raises ``EntryError``."""
    merged: dict[str, Any] = {}
    for name, document in documents.items():
        for key, value in document.items():
            if key in merged and value != merged[key]:
                place = format_location(f"{name}:", key)
                raise EntryError(Problem("duplicate", place, "differs from that in the other file", "one value"))
            merged[key] = value
    name = " and ".join(documents)
    left, right = (_camera(name, merged, eyes) for eyes in _EYES)
    # A single number is a term of the distortion, such as k2, and not the matrix K of camera 2.
    is_pair = isinstance(next(iter(right.fields["matrix"].values()), None), dict | list)
    return [left, right] if is_pair else [_camera(name, merged)]


def _check_not_rectified(camera: _Camera, *, is_stated: bool) -> list[str]:
    """Return notes on what is assumed of pictures that are not stated to be rectified.

    Raises ``EntryError`` if nothing but P tells that they may be.
    """
    notes, P, is_distorted = [], camera.projection, any(camera.distortion)
    if P is not None and not is_stated:
        unlike = np.abs(P[:, :3] - camera.matrix).max() > ROUNDED_PX
        rotation = camera.numbers("rectification", 9, 3, default=np.eye(3)).reshape(-1, 3)
        if unlike and not is_distorted and np.allclose(rotation, np.eye(3)):
            found = "differs from the camera's matrix without distortion: the pictures may be rectified"
            expected = "rectified = true (they have P) or rectified = false beside calibration in cameras.toml"
            raise camera.error("conflict", "projection", found, expected)
        if unlike or is_distorted:
            found = "the pictures are taken as not rectified, with the camera's own matrix and distortion"
            notes.append(f"{camera.name}: {found}; if they are rectified, state rectified = true in cameras.toml")
    if not camera.fields["distortion"]:
        notes.append(f"{camera.name}: no distortion is stated, taken as 0")
    return notes


def _on_pictures(
    camera: _Camera, matrix: Values, width: Side, height: Side, notes: list[str]
) -> tuple[Values, dict[str, float]]:
    """Return a matrix of the sensor on pictures of ``width`` x ``height``, and the image size that it is for.

    By REP 104 ``roi`` is in pixels of the sensor, and the pictures show it divided by the binning. Pixel centres
    are at integers: cx' = (cx - x + 0.5) / binning - 0.5; ROS' image_geometry leaves out the halves. Pictures of
    the full size are not cropped; without ``roi``, those of another size show all of the sensor. Raises
    ``EntryError`` for a region that cannot be that of the pictures.
    """
    size = camera.size
    sensor = list(size.values())
    bin_x, bin_y = (max(1.0, camera.numbers(f"binning {axis}", 1, default=np.zeros(1))[0]) for axis in "xy")
    roi: Any = next(iter(camera.fields["region"].values()), {})
    region = list(flat_numbers([roi.get(name, 0) for name in _REGION] if isinstance(roi, dict) else roi))
    if len(region) != 4 or not all(value >= 0 and value.is_integer() for value in (*region, bin_x, bin_y)):
        raise camera.error("invalid", "region", f"got {short_repr(roi)}", f"whole numbers {', '.join(_REGION)}")
    if not sensor and max(bin_x, bin_y) > 1:
        expected = "width and height of the full sensor"
        raise camera.error("missing", "width", "missing beside binning", expected)
    x, y, *sides = region if any(region) else [0.0, 0.0, *sensor]
    is_whole = [x, y, *sides] == [0, 0, *sensor]
    is_inside = all(sides) and (not sensor or (x + sides[0] <= sensor[0] and y + sides[1] <= sensor[1]))
    shown = [side // bin for side, bin in zip(sides, (bin_x, bin_y), strict=False)]
    if not is_inside:
        found = f"{sides[0]:g} x {sides[1]:g} pixels at ({x:g}, {y:g}) are not inside width x height"
        expected = "a part of the full sensor, which width, height and K are for (REP 104); or a roi of zeros, "
        raise camera.error("conflict", "region", found, f"{expected}and K of the pictures")
    pictures = shown if width is None or height is None else [width, height]
    if shown == pictures and not (is_whole and bin_x == bin_y == 1):
        corner = np.array([[0, 0, x - 0.5], [0, 0, y - 0.5], [0, 0, 0]])
        half_pixel = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        matrix = np.diag([1 / bin_x, 1 / bin_y, 1.0]) @ (matrix - corner) - half_pixel
        return matrix, {"width": int(pictures[0]), "height": int(pictures[1])}
    if not is_whole and sensor != pictures:
        expected = f"{shown[0]:g} x {shown[1]:g}, or the size of the full sensor"
        raise camera.error("conflict", "region", f"the pictures have {width} x {height} pixels", expected)
    if not is_whole or max(bin_x, bin_y) > 1:
        notes.append(f"{camera.name}: the pictures show all of the sensor; roi and binning are left out")
    return matrix, size


def _rectified_offset_m(left: _Camera, right: _Camera, unit_m: float) -> Values:
    """Return the translation of ``x_right = x_left + T`` of rectified cameras, metres."""
    x_m = list[float]()
    for camera in (left, right):
        row = np.zeros(4) if camera.projection is None else camera.projection[0]
        if len(row) != 4 or row[0] <= 0 or (x_m and not row[3] / row[0] * unit_m < min(x_m[0], 0)):
            expected = "fx above 0 and P[0, 3] = -fx * baseline, of the right camera of a calibrated pair"
            raise camera.error("invalid", "projection", f"got {short_repr(row.tolist())}", expected)
        x_m.append(row[3] / row[0] * unit_m)
    return np.array([x_m[1] - x_m[0], 0.0, 0.0])


def flat_numbers(value: Any) -> Iterable[float]:
    """Yield the numbers in nested lists; NaN for anything else."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from flat_numbers(item)
    else:
        number = parse_number(value) if isinstance(value, str) else value
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        yield float(number) if is_number and abs(number) <= _MAX_MAGNITUDE else math.nan
